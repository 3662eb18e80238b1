"""Residuals of the simulated robot find odometry that is scaled or late, and only that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Status
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.sim.disturbances import Disturber, parse_disturbance
from amberbox.sim.robot import START_NS, Message, Robot
from tests.sim.monitored import find, plan_of

SECONDS, WRONG_S = 40.0, 20.0
TOPICS = ("wheels", "odom", "imu", "bus")
MODES = {"odometry": {"speed", "turning"}, "imu": {"turning"}}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> MonitoringPlan:
    """Return the monitors of residuals alone."""
    whole, problems = plan_of(tmp_path_factory.mktemp("residuals") / "robot")
    assert not [problem for problem in problems if problem.is_error]
    components = [
        replace(one, modes=tuple(mode for mode in one.modes if mode.id in MODES[one.id]))
        for one in whole.components
        if one.id in MODES
    ]
    return replace(whole, components=tuple(components))


@cache
def drive(scenario: str) -> Sequence[Message]:
    messages = Robot(11, scenario=scenario).step_until(SECONDS)
    return [message for message in messages if message[0] in TOPICS]


def bad(plan: MonitoringPlan, messages: Sequence[Message]) -> dict[str, float]:
    """Return the outputs that were false, with the second in which they were first."""
    found: dict[str, float] = {}
    for one in find(plan, messages, SECONDS):
        if isinstance(one, Status) and one.mode:
            for name, value in one.outputs.items():
                if value is False:
                    at_s = (one.measured_ns - START_NS) / NS
                    found.setdefault(f"{one.component}/{one.mode}/{name}", at_s)
    return found


@pytest.mark.parametrize("scenario", ["transport", "shift", "shuttle", "charging", "standing"])
def test_a_sound_robot_has_no_violation(plan: MonitoringPlan, scenario: str) -> None:
    assert bad(plan, drive(scenario)) == {}


@pytest.mark.parametrize(
    ("disturbance", "wanted"),
    [
        ("scale:odom.twist.linear.x=1.3", "odometry/speed/as_the_wheels"),
        ("delay:odom=0.4", "odometry/speed/on_time"),
        ("scale:odom.twist.angular.z=1.3", "odometry/turning/as_the_wheels"),
        ("scale:imu.angular_velocity.z=1.3", "imu/turning/as_the_units"),
        ("delay:imu=0.4", "imu/turning/on_time"),
    ],
)
def test_what_is_wrong_is_found(plan: MonitoringPlan, disturbance: str, wanted: str) -> None:
    disturber = Disturber([parse_disturbance(f"{disturbance}@{WRONG_S:g}s")], START_NS)
    end_ns = START_NS + round(SECONDS * NS)
    found = bad(plan, list(disturber.feed(drive("transport"), end_ns)))
    assert WRONG_S < found[wanted] < SECONDS
    component = wanted.partition("/")[0]
    assert {name.partition("/")[0] for name in found} == {component}
