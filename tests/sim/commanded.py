"""A simulated robot on command, in simulated time."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import msgspec

from amberbox.sim.faults import FaultEffect, FaultMagnitude, FaultOnset, SimulatedFault
from amberbox.sim.noise import Pose2D
from amberbox.sim.robot import Message, Robot

BEGIN_S = 1.0


def standing(seed: int = 3) -> Robot:
    """Return a robot that stands in ward A, at (8.7, 6.0), and looks north."""
    robot = Robot(seed, scenario="standing")
    run_for(robot, BEGIN_S)
    return robot


def run_for(robot: Robot, seconds: float) -> list[Message]:
    """Let time pass; return what the robot published."""
    return list(robot.step_until(robot.now_s + seconds))


def begin(robot: Robot, do: str, **parameters: Any) -> str:
    """Begin a motion; return its id."""
    answer = robot.command({"do": do, **parameters})
    assert (answer["ok"], answer["state"]) == (True, "running"), answer
    return str(answer["id"])


def end(robot: Robot, command: str, limit_s: float = 300.0) -> dict[str, Any]:
    """Let time pass until a command has ended; return its answer."""
    until_s = robot.now_s + limit_s
    while (answer := status(robot, command))["state"] == "running":
        assert robot.now_s < until_s, f"{answer} has no end"
        run_for(robot, 0.1)
    return answer


def carry_out(robot: Robot, do: str, **parameters: Any) -> dict[str, Any]:
    """Carry out a command to its end; return its answer."""
    return end(robot, begin(robot, do, **parameters))


def status(robot: Robot, command: str = "") -> dict[str, Any]:
    """Return the state of a command, or of the robot."""
    return robot.command({"do": "status", **({"id": command} if command else {})})


def place(robot: Robot) -> Pose2D:
    """Return where the robot truly stands, as a copy."""
    return Pose2D(*robot.truth()["pose"])


def distance_m(a: Pose2D, b: Pose2D) -> float:
    """Return the distance between two poses."""
    return math.dist((a.x, a.y), (b.x, b.y))


def knob(part: str, name: str, size: float) -> SimulatedFault:
    """Return a fault of one's own that turns one knob."""
    return SimulatedFault(
        id=f"test_{part}_{name}",
        component=part,
        domain="mechanics",
        description="for a test",
        magnitude=FaultMagnitude(size, -1000.0, 1000.0, ""),
        onset=FaultOnset("step"),
        effects=(FaultEffect(part, name, 1.0),),
        affects=(part,),
        shows_in=(),
        visible_s=1.0,
        scenario="standing",
    )


def digest(messages: Sequence[Message]) -> str:
    """Return the SHA-256 of all that was published: topics, times and every byte."""
    total = hashlib.sha256()
    for topic, sent_ns, message in messages:
        total.update(f"{topic} {sent_ns} ".encode() + msgspec.json.encode(message) + b"\n")
    return total.hexdigest()
