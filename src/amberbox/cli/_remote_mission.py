"""``amberbox mission start`` and ``end`` on a server: missions that people begin there."""

from __future__ import annotations

from collections.abc import Mapping

from amberbox.cli._server import robot_at
from amberbox.client.data_models import Mission
from amberbox.core.errors import UsageError


def start_remote(where: str, name: str, mission_id: str, parameters: Mapping[str, str]) -> str:
    """Begin a mission; return its id, which the server makes."""
    if mission_id:
        raise UsageError("a server makes the ids of its missions itself", "leave out --id")
    fleet, robot = robot_at(where)
    with fleet:
        return fleet.begin_mission(robot, name, parameters).id


def end_remote(where: str, mission_id: str, outcome: str) -> Mission:
    """End a mission of the server; the last one without an id."""
    fleet, robot = robot_at(where)
    with fleet:
        if not mission_id:
            lasting = [m for m in fleet.missions(robot) if m.to is None and m.origin == "server"]
            if not lasting:
                raise UsageError("no mission that was begun on the server lasts",
                                 "a robot's own mission ends on the robot")  # fmt: skip
            mission_id = lasting[0].id
        return fleet.end_mission(robot, mission_id, outcome or "done")
