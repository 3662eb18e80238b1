"""Monitors of the simulated robot: complete, quiet while all is well, right about faults."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.plugins import find as find_plugins
from amberbox.core.types import Status, Symptom
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import Robot
from tests.sim.monitored import FAULT_S, alarms, failures, find, plan_of, with_fault

INITIALISED_S = 11.0  # the residual of the gyroscope looks back for 10 s
SAMPLE = {  # fault: seconds until its component must have an alarm
    "wheel_rear_left_phase_open": 20.0,
    "wheel_front_right_encoder_stuck": 3.0,
    "wheel_front_left_power_stage_trips": 3.0,
    "wheel_rear_right_bus_disconnected": 3.0,
    "laser_front_frozen": 3.0,
    "imu_mount_loose": 20.0,
    "battery_charger_contact": 6.0,
    "localisation_shift": 2.0,
    "wifi_congested": 8.0,
    "task_executor_crash": 7.0,
    "host_clock_jump": 3.0,
    "e_stop_line_loose": 3.0,
}


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> MonitoringPlan:
    loaded, problems = plan_of(tmp_path_factory.mktemp("robot") / "r")
    assert problems == []
    return loaded


def test_the_configuration_is_complete_and_asks_no_probe(plan: MonitoringPlan) -> None:
    outputs = [o for _, mode in plan.modes() for m in mode.mappings for o in m.outputs]
    assert len(outputs) >= 40 and not plan.probes()
    assert not [mode.problem for _, mode in plan.modes() if mode.problem]
    assert {fault.component for fault in catalogue().values()} <= {c.id for c in plan.components}
    assert all(component.modes and component.description for component in plan.components)
    assert all(mode.description for _, mode in plan.modes())


def test_every_alarm_says_what_to_do_or_what_it_is(plan: MonitoringPlan) -> None:
    silent = [
        f"{component.id}/{mode.id}/{output.name}"
        for component, mode in plan.modes()
        for mapping in mode.mappings
        for output in mapping.outputs
        if output.type == "bool" and not (output.hint or output.description or mode.description)
    ]
    assert silent == []


def test_it_shows_a_good_part_of_the_modes(plan: MonitoringPlan) -> None:
    used = {Path(str(mode.module.__file__)).stem for _, mode in plan.modes() if mode.module}
    known = set(find_plugins("amberbox.monitoring.modes", defines=("Config", "evaluate")))
    assert used <= known
    assert len(used) >= 12, f"not shown: {sorted(known - used)}"


@pytest.mark.parametrize(
    ("scenario", "seed", "seconds"),
    [("transport", 7, 240.0), ("charging", 5, 40.0), ("standing", 5, 30.0)],
)
def test_nothing_is_wrong_with_a_sound_robot(
    plan: MonitoringPlan, scenario: str, seed: int, seconds: float
) -> None:
    messages = list(Robot(seed, scenario=scenario).step_until(seconds))
    findings = find(plan, messages, seconds - 1)
    assert alarms(findings) == {}
    assert [transition.text for transition in failures(findings)] == []
    statuses = {s.component: s for s in findings if isinstance(s, Status) and not s.mode}
    assert {s.level for s in statuses.values()} == {"ok"} and len(statuses) == len(plan.components)
    assert all(s.since_ns - messages[0][1] <= INITIALISED_S * 1e9 for s in statuses.values())
    symptoms = [s for s in findings if isinstance(s, Symptom)]
    assert len({s.id for s in symptoms}) == len(symptoms) > 100, "each says once that all is well"
    assert {(s.state, s.blocked_by) for s in symptoms} == {("absent", ())}


@pytest.mark.parametrize("fault", SAMPLE)
def test_a_fault_is_found_where_it_is(plan: MonitoringPlan, fault: str) -> None:
    within_s = SAMPLE[fault]
    findings = find(plan, with_fault(fault, within_s + 1), FAULT_S + within_s)
    opened = alarms(findings)
    assert all(at_s > FAULT_S for at_s in opened.values())
    assert list(opened) == [catalogue()[fault].component]


@pytest.mark.parametrize("place", ["rear_right"])
@pytest.mark.parametrize(
    ("fault", "mode"), [("barometer_off", "barometer"), ("supply_sags", "supply")]
)
def test_a_sick_unit_makes_no_other_one_seem_sick(
    plan: MonitoringPlan, place: str, fault: str, mode: str
) -> None:
    robot = Robot(3)
    robot.inject(f"wheel_{place}_{fault}", 5.0, magnitude=4.5)
    findings = find(plan, list(robot.step_until(20.0)), 19.0)
    blamed = {(found.component, found.mode) for found in failures(findings) if found.mode == mode}
    assert blamed == {(f"wheel_{place}", mode)}


def test_a_frozen_gyroscope_of_a_unit_is_no_fault_of_others(plan: MonitoringPlan) -> None:
    robot = Robot(3)
    robot.inject("wheel_rear_left_bus_disconnected", 20.0)
    findings = find(plan, list(robot.step_until(40.0)), 39.0)
    blamed = {found.component for found in failures(findings)}
    assert "bus" in blamed and "imu" not in blamed


def test_a_robot_that_stops_hard_does_not_jump(plan: MonitoringPlan) -> None:
    findings = find(plan, with_fault("navigation_crash", 6.0), FAULT_S + 5.0)
    assert {"position"}.isdisjoint(found.mode for found in failures(findings))


def test_what_depends_on_a_fault_is_blocked_and_has_no_alarm(plan: MonitoringPlan) -> None:
    findings = find(plan, with_fault("wheel_rear_right_bus_disconnected", 12), FAULT_S + 10)
    assert list(alarms(findings)) == ["bus"]
    blocked = {t.component: t.blocked_by for t in failures(findings) if not t.mode}
    assert blocked["wheel_rear_right"] == ("bus",)
