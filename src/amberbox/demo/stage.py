"""The robots of the demonstration together: who is broken, who is away, and how all of it ends."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.clock import SystemClock
from amberbox.core.errors import UsageError
from amberbox.demo.enrolment import enrol
from amberbox.demo.faults import OFFERS
from amberbox.demo.relay import Relay
from amberbox.demo.robots import IDS, SOMETIMES_AWAY, DemoRobot, place_of, write_folder
from amberbox.fleet.accounts.signincodes import SignInCodes

DATA = "server"
"""The server's data folder, below that of the demonstration."""
_LOOK_S = 0.2


@dataclass(frozen=True, slots=True)
class Absence:
    """When the way of a robot is cut first, for how long, and how long it holds in between."""

    first_s: float
    away_s: float
    there_s: float


class Stage:
    """What the server sees as its ``Demonstration``; made before the server, ended after it."""

    def __init__(self, folder: Path, port: int) -> None:
        self.codes = SignInCodes(SystemClock())
        self.relay = Relay()
        self._folder, self._port = folder, port
        self._running: dict[str, DemoRobot] = {}
        self._broken: dict[str, str] = {}
        self._lock = threading.Lock()

    @property
    def data(self) -> Path:
        """Return the server's data folder."""
        return self._folder / DATA

    @property
    def robots(self) -> Sequence[str]:
        """Return the ids of the robots."""
        return IDS

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults that are offered."""
        return tuple(OFFERS)

    def prepare(self) -> None:
        """Make the server's data folder and the robots' folders."""
        ports = dict.fromkeys(IDS, self._port) | {SOMETIMES_AWAY: self.relay.port}
        lines = enrol(self.data, {robot: f"http://127.0.0.1:{p}" for robot, p in ports.items()})
        for robot, line in lines.items():
            write_folder(place_of(robot, self._folder), line)

    def begin(self) -> None:
        """Let the robots run; they look for the server until it answers.

        Call it on the main thread: its children live as long as it does.
        """
        for robot in IDS:
            self._running[robot] = DemoRobot(place_of(robot, self._folder))

    def broken(self) -> Mapping[str, str]:
        """Return which robot has which fault now."""
        with self._lock:
            return dict(self._broken)

    def damage(self, robot: str, fault: str) -> None:
        """Let a robot have a fault, instead of what it had."""
        if fault not in OFFERS:
            raise UsageError(f"no fault '{fault}' is offered", f"one of {', '.join(OFFERS)}")
        with self._lock:
            self._heal(robot)
            self._robot(robot).order(f"fault {fault}")
            self._broken[robot] = fault

    def repair(self, robot: str) -> None:
        """Let a robot be well again."""
        with self._lock:
            self._heal(robot)

    async def come_and_go(
        self, plan: Absence, say: Callable[[str], None], begins: Callable[[], object]
    ) -> None:
        """Cut the way of one robot for a while, again and again, once something begins that."""
        await self.relay.begin(self._port)
        while not begins():
            await asyncio.sleep(_LOOK_S)
        await asyncio.sleep(plan.first_s)
        while True:
            self.relay.cut()
            say(f"{SOMETIMES_AWAY} has no way to the server for {plan.away_s:.0f} s; it records on")
            await asyncio.sleep(plan.away_s)
            self.relay.mend()
            say(f"{SOMETIMES_AWAY} has its way to the server again")
            await asyncio.sleep(plan.there_s)

    def end(self) -> None:
        """Ask the robots to end."""
        for robot in self._running.values():
            robot.stop()

    def close(self) -> None:
        """End the robots, and wait for them."""
        self.end()
        self.relay.close()
        for robot in self._running.values():
            robot.wait()

    def _heal(self, robot: str) -> None:
        fault = self._broken.pop(robot, None)
        if fault is not None:
            self._robot(robot).order(f"heal {fault}")

    def _robot(self, robot: str) -> DemoRobot:
        if robot not in self._running:
            raise UsageError(f"{robot} does not run (yet)", "wait a moment")
        return self._running[robot]
