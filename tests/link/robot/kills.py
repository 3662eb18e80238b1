"""Robots and their server, killed at random moments: the rig of the short test and of the soak."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from amberbox.core.errors import AmberboxError
from amberbox.server.database import ServerDatabase
from tests.link.robot.rig import Held, held, put_aside, recorded
from tests.support.processes import free_port

ROOT = Path(__file__).parents[3]


@dataclass
class Result:
    """The result: written rows, and how long the last ones took to arrive."""

    rows: int = 0
    kills: int = 0
    caught_up_s: float = 0.0


@dataclass
class Field:
    """Robots in the field and a server, each a process."""

    folder: Path
    robots: int
    seed: int = 0
    port: int = 0
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    starts: int = 0

    def __post_init__(self) -> None:
        self.port = free_port()

    @property
    def names(self) -> list[str]:
        return [f"r{number}" for number in range(self.robots)]

    def start(self, name: str) -> None:
        """Start a robot, or the server."""
        self.starts += 1
        words = ["tests.link.robot.serverprocess", str(self.folder / "server.db"), str(self.port)]
        if name != "server":
            path = self.folder / name
            words = ["tests.link.robot.robotprocess", str(path), name, str(self.port),
                     str(self.seed * 1000 + self.starts)]  # fmt: skip
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'src'}"}
        self.processes[name] = subprocess.Popen(
            [sys.executable, "-m", *words], cwd=ROOT, env=environment
        )

    def kill(self, name: str) -> None:
        """Kill a process without a word."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def end(self) -> None:
        """Kill all remaining processes."""
        for name in list(self.processes):
            self.kill(name)


def run(folder: Path, robots: int, kills: int, seconds: float, seed: int = 0) -> Result:
    """Kill robots and server ``kills`` times in ``seconds``, then see that all has arrived once."""
    chance = random.Random(seed)
    world = Field(folder, robots, seed)
    try:
        for name in ("server", *world.names):
            world.start(name)
        _await_rows(world, folder)
        for _ in range(kills):
            time.sleep(chance.uniform(0.5, 1.5) * seconds / kills)
            victim = chance.choice(["server", *world.names])
            world.kill(victim)
            time.sleep(chance.uniform(0.0, 0.3))
            world.start(victim)
        for name in world.names:
            (folder / f"{name}.quiet").touch()
        return _judged(world, folder, kills)
    finally:
        world.end()


def _await_rows(world: Field, folder: Path) -> None:
    """Wait until each robot writes: how long a start takes depends on the machine."""
    end = time.monotonic() + 60
    while not all(_has_rows(folder / name) for name in world.names):
        assert time.monotonic() < end, "robots do not write"
        time.sleep(0.1)


def _has_rows(path: Path) -> bool:
    try:
        return bool(recorded(path))
    except AmberboxError:  # no store yet
        return False


def _judged(world: Field, folder: Path, kills: int) -> Result:
    """Wait for all that robots have written; nothing twice, nothing changed, nothing else."""
    begin = time.monotonic()
    database = ServerDatabase(folder / "server.db", read_only=True)
    try:
        rows = 0
        for name in world.names:
            _await((folder / f"{name}.written").exists)
            wanted = recorded(folder / name)
            _await(partial(_has_all, database, name, wanted))
            (folder / f"{name}.stop").touch()
            assert world.processes[name].wait(60) == 0
            assert held(database, name) == wanted
            assert not put_aside(database, name)
            rows += len(wanted)
    finally:
        database.close()
    return Result(rows, kills, time.monotonic() - begin)


def _has_all(database: ServerDatabase, name: str, wanted: Held) -> bool:
    return held(database, name).keys() >= wanted.keys()


def _await(is_so: Callable[[], bool]) -> None:
    """Wait for a condition, a minute at most; the next check reports what is missing."""
    end = time.monotonic() + 60
    while not is_so() and time.monotonic() < end:
        time.sleep(0.1)
