"""The contract of the robot's real buses, and how they are found (``amberbox.simbuses``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from amberbox.core.plugins import get
from amberbox.sim.robot import Robot

PACKAGE = "amberbox.simbuses"
BUSES: Mapping[str, str] = {
    "ros1": "MASTER_URI",
    "ethercat": "INTERFACE",
    "can": "CHANNEL",
    "mqtt": "HOST:PORT",
}
"""The buses and what their address is; each is a module with ``open_bus(address, setup)``."""


@dataclass(frozen=True, slots=True)
class BusSetup:
    """What all buses of a robot know: its name, the seed of its noise, how fast its time goes."""

    robot_id: str
    seed: int
    speed: float | None = 1.0
    """Times real time; None for as fast as it goes."""


class RobotBus(Protocol):
    """One bus that the robot speaks on; all calls come from the robot's thread.

    Nothing here changes the robot: with the same seed it does the same, whoever listens.
    """

    def send(self, topic: str, message: Mapping[str, Any]) -> None:
        """Pass on a message that the robot publishes, now that it is due."""

    def tick(self, robot: Robot, due_ns: int) -> None:
        """Pass on the state after a tick (10 ms), due at this time of the monotonic clock."""

    def close(self) -> None:
        """Send what waits, and leave the bus."""


def write_can_definition(path: Path) -> None:
    """Write the DBC file of the bus ``can``; raises AmberboxError."""
    get(PACKAGE, "can").load().write_dbc(path)


def open_bus(name: str, address: str, setup: BusSetup) -> RobotBus:
    """Join a bus; raises AmberboxError if it, or a library that it needs, is not there."""
    bus: RobotBus = get(PACKAGE, name).load().open_bus(address, setup)
    return bus
