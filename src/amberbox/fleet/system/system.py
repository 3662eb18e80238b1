"""Watches teams and the system on the server."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.system import places
from amberbox.fleet.system.checking import Checks
from amberbox.fleet.system.member import CHANNELS, FRESH_NS, Heard, Lateness, MemberStore
from amberbox.fleet.system.places import MEMBERS, Place
from amberbox.fleet.system.runner import Runner, State

_LOOK_S = 10.0
_WRITE_S = 0.2
_WAITING = 20_000
"""Records of members that wait to be written, at most; older ones are of the past then."""


@dataclass(frozen=True, slots=True)
class Watched:
    """A folder of the system level as it is now, and whether it runs."""

    place: Place
    state: State
    restarts: int
    trouble: str


class SystemLevel:
    """Watches teams and the system on the server.

    Members' statuses are written to stores like those that robots have, as they come; ``amberbox
    run`` of each folder reads them there.
    """

    def __init__(self, folder: Path, bus: Bus, clock: Clock, links: LinkServer) -> None:
        self._folder = folder
        self._clock = clock
        self._links = links
        self._members: dict[str, MemberStore] = {}
        self._wanted: frozenset[str] = frozenset()
        self._late: dict[str, Lateness] = {}
        self._waiting: dict[str, list[Heard]] = {}
        self._places: dict[str, Place] = {}
        self._runners: dict[str, Runner] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._checks = Checks()
        self._ends = [bus.on("connected", self._connected), bus.on("rows", self._rows)]

    async def run(self) -> None:
        """Look for folders now and then, run them, write down what their members say."""
        writing = asyncio.create_task(self._write_on())
        try:
            while True:
                await self.look()
                await asyncio.sleep(_LOOK_S)
        finally:
            writing.cancel()
            for task in self._tasks.values():
                task.cancel()
            await asyncio.gather(writing, *self._tasks.values(), return_exceptions=True)
            self._tasks.clear()

    def close(self) -> None:
        """Let go of what is held."""
        for end in self._ends:
            end()
        for runner in self._runners.values():
            runner.kill()
        for member in self._members.values():
            with contextlib.suppress(OSError):
                member.close()
        self._members.clear()

    def watched(self) -> list[Watched]:
        """Return the folders of the system level, teams first."""
        found = []
        for name, place in self._places.items():
            runner = self._runners.get(name, Runner(place.path))
            found.append(Watched(place, runner.state, runner.restarts, runner.trouble))
        return found

    async def look(self) -> None:
        """See which folders there are, what is wrong with them, who their members are."""
        there = await asyncio.to_thread(places.paths, self._folder)
        found = {
            name: await asyncio.to_thread(places.look, self._folder, name, path)
            for name, path in there.items()
        }
        self._wanted = frozenset[str]().union(*(place.members for place in found.values()))
        await asyncio.to_thread(self._open)
        for name, place in found.items():
            found[name] = replace(place, problems=await self._checks.of(place.path))
        self._places = found
        for name, place in found.items():
            if name not in self._tasks and place.store is not None:
                runner = self._runners.setdefault(name, Runner(place.path))
                self._tasks[name] = asyncio.create_task(runner.run())
        for name in [name for name in self._tasks if name not in found]:
            self._tasks.pop(name).cancel()
            self._runners.pop(name).state = "off"

    def _open(self) -> None:
        for robot in self._wanted - self._members.keys():
            path = self._folder / MEMBERS / robot
            with contextlib.suppress(AmberboxError, OSError):  # tried again at the next look
                self._members[robot] = MemberStore(path, self._clock)

    def _connected(self, change: Change) -> None:
        now_ns = self._clock.wall_ns()
        ahead_ns = now_ns - change.data["hello"].wall_ns
        self._late[change.robot] = Lateness(ahead_ns, now_ns)

    def _rows(self, change: Change) -> None:
        """Take what is about now; it is written in a thread."""
        robot, late = change.robot, self._late.get(change.robot)
        if robot not in self._wanted or late is None:
            return
        now_ns, one = self._clock.wall_ns(), self._links.robots.get(robot)
        backlog = 0 if one is None else one.backlog
        waiting = self._waiting.setdefault(robot, [])
        for row in change.data["rows"]:
            if row.channel in CHANNELS and row.writer == "watch":
                run = change.data["store_id"], row.run
                late_ns = late.of(run, row.log_ns, now_ns, backlog)
                if late_ns <= FRESH_NS:
                    waiting.append(Heard(row.channel, row.log_ns + late_ns, row.data))
        del waiting[:-_WAITING]

    async def _write_on(self) -> None:
        while True:
            await asyncio.sleep(_WRITE_S)
            waiting, self._waiting = self._waiting, {}
            if waiting:
                await asyncio.to_thread(partial(self._write, waiting))

    def _write(self, waiting: Mapping[str, list[Heard]]) -> None:
        for robot, heard in waiting.items():
            member = self._members.get(robot)
            if member is not None:
                with contextlib.suppress(OSError):  # the disk is full: the members go stale
                    member.say(heard)
