"""Findings of the robots' watchers in the last hour, and now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.diagnose import DiagnosisId, ObservedSituation, answer
from amberbox.monitoring.findings import AlarmChange
from tests.browser import hostile
from tests.browser.robot import Robot
from tests.server.knowledge.robot import HASH, knowledge

MINUTE_NS = 60 * NS
FAULT_NS = -15 * NS
"""When the front laser of ``ropod_001`` fell silent, from now on backwards."""
COMPONENTS: Sequence[str] = (
    "host", "bus", "battery", "base_controller", "safety", "imu", "wifi", "log",
    "wheel_front_left", "wheel_front_right", "wheel_rear_left", "wheel_rear_right", "odometry",
    "base", "laser_front", "laser_rear", "localisation", "navigation", "task_executor",
)  # fmt: skip
BLOCKED: Mapping[str, tuple[str, ...]] = {
    "localisation": ("laser_front",),
    "navigation": ("laser_front", "localisation"),
    "task_executor": ("navigation",),
}
"""What suffers when the front laser is silent."""
DIAGNOSIS = "ropod_001-1"
ALARM = "laser_front-1"
NO_SCANS = "laser_front/heartbeat/alive"
RUNS = "laser_front/process/running"
REASON = "no scans for 1.0 s, expected 10 Hz"


def past(robot: Robot) -> None:
    """Write down an hour: all is well, but for a dirty window half an hour ago."""
    for minute in range(-55, 0, 5):
        robot.clock.ago_ns = -minute * MINUTE_NS
        if minute == -55:
            all_well(robot)
            robot.tell("started", "the watcher started", "watch")
        elif minute == -30:
            robot.change("laser_rear", "warn", "window_clear", reason="the window is dirty")
            robot.tell("window_dirty", "laser_rear: 12 beams stop at the window")
        elif minute == -25:
            robot.change("laser_rear", "ok", "nominal")
        robot.repeat()
    robot.clock.ago_ns = 0


def all_well(robot: Robot) -> None:
    """Set all components to ok, with the outputs of some modes."""
    for component in COMPONENTS:
        robot.status(component)
    robot.status("laser_front", mode="heartbeat", alive=True, rate_hz=10.0)
    robot.status("laser_front", mode="process", running=True)
    robot.status("laser_front", mode="window", window_clear=True)
    robot.status("laser_rear", mode="heartbeat", alive=True, rate_hz=10.0)
    robot.status("battery", mode="charge", not_empty=True, charge=64.5, time_to_empty=5400.0)
    robot.status("host", mode="memory", enough=True, free_mb=512)
    robot.status("wifi", mode="network", access_point="ward-4", connected=True)
    for wheel in ("front_left", "front_right", "rear_left", "rear_right"):
        robot.status(f"wheel_{wheel}", mode="encoders", encoders_right=True, difference=0.01)
        robot.status(f"wheel_{wheel}", mode="power_stage", power_on=True, volts=24.2)


def laser_dies(robot: Robot) -> None:
    """Let the front laser fall silent: status, consequences, symptom, diagnosis, alarm."""
    known = knowledge(robot.name)
    robot.clock.ago_ns = -FAULT_NS
    at_ns = robot.clock.wall_ns()
    robot.status("laser_front", "error", "alive", mode="heartbeat", reason=REASON, alive=False,
                 rate_hz=0.0)  # fmt: skip
    robot.change("laser_front", "error", "alive", reason=REASON,
                 hint="is it powered, is its driver running?")  # fmt: skip
    for component, by in BLOCKED.items():
        robot.change(component, "error", "blocked", reason=f"needs {by[0]}", blocked_by=by)
    silent = Symptom(NO_SCANS, "present", NO_SCANS, at_ns, at_ns)
    runs = Symptom(RUNS, "absent", RUNS, None, at_ns)
    found = answer(
        known, ObservedSituation((silent, runs), watched=True), DiagnosisId(DIAGNOSIS, 1, at_ns)
    )
    robot.say(silent, runs, found, alarm(robot.name, at_ns, found))
    robot.clock.ago_ns = 0


def alarm(robot: str, at_ns: int, of: Diagnosis) -> AlarmChange:
    """Return the alarm of the silent laser, which a diagnosis explains."""
    return AlarmChange(
        robot, ALARM, "laser_front", "critical", "open", "error", REASON, at_ns, at_ns, 1, "",
        None, HASH, cause=of.hypotheses[0].id, diagnosis=of.id,
    )  # fmt: skip


def hostile_past(robot: Robot) -> None:
    """Write findings with hostile texts for a healthy robot."""
    robot.clock.ago_ns = 20 * MINUTE_NS
    all_well(robot)
    robot.status(hostile.COMPONENT, "warn", "odd", reason=hostile.SCRIPT)
    odd: dict[str, Any] = {hostile.OUTPUT: hostile.BACKWARDS}
    robot.status(hostile.COMPONENT, mode="m", **odd)
    robot.tell("remark", hostile.EVENT)
    robot.clock.ago_ns = 0
