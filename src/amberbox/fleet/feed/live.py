"""Live values: what listeners look at together, asked of robots once, sent five times a second."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol, TypeAlias

from amberbox.fleet.feed.delta import message
from amberbox.fleet.state.said import moment
from amberbox.link import limits

Value: TypeAlias = "tuple[int, float | str | None]"
Watch: TypeAlias = "Mapping[str, Sequence[str]]"
EVERY_S = 0.2
_PATIENCE_S = 5.0


class Watcher(Protocol):
    """Who asks robots for live values."""

    async def watch(self, robot: str, variables: Sequence[str]) -> None:
        """Ask for the latest values of variables from now on."""


class Live:
    """The latest values of what somebody looks at; nothing of it is kept."""

    def __init__(self, links: Watcher, wanted: Callable[[], Iterable[Watch]]) -> None:
        self._links = links
        self._wanted = wanted
        self._asked: dict[str, frozenset[str]] = {}
        self._values: dict[str, dict[str, Value]] = {}
        self._news: set[str] = set()
        self._changed = asyncio.Event()

    def look_again(self) -> None:
        """Tell that listeners have come, gone, or look at something else."""
        self._changed.set()

    def take(self, robot: str, values: Mapping[str, Value]) -> bool:
        """Note values that came; tell whether somebody looks at some of them."""
        asked = self._asked.get(robot)
        known = {name: value for name, value in values.items() if asked and name in asked}
        if known:
            self._values.setdefault(robot, {}).update(known)
            self._news.add(robot)
        return bool(known)

    def news(self) -> set[str]:
        """Return the robots of which values have come since this was asked last."""
        found, self._news = self._news, set()
        return found

    def text(self, number: int, robot: str, variables: Iterable[str]) -> str:
        """Write the latest values of variables of a robot; empty where there are none."""
        known = self._values.get(robot, {})
        data: dict[str, Any] = {
            name: {"at": moment(known[name][0]), "value": known[name][1]}
            for name in variables
            if name in known
        }
        return message(number, "live", robot, data) if data else ""

    async def run(self) -> None:
        """Ask robots for what is looked at, each time that changes."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            union = _union(self._wanted())
            different = [
                robot
                for robot in {*union, *self._asked}
                if union.get(robot, frozenset()) != self._asked.get(robot, frozenset())
            ]
            self._asked = union
            for robot in different:
                self._forget(robot)
            await asyncio.gather(*(self._ask(robot) for robot in different))

    def _forget(self, robot: str) -> None:
        asked = self._asked.get(robot, frozenset())
        kept = {n: v for n, v in self._values.get(robot, {}).items() if n in asked}
        self._values[robot] = kept
        if not asked:
            del self._values[robot]

    async def _ask(self, robot: str) -> None:
        variables = sorted(self._asked.get(robot, ()))[: limits.VARIABLES]
        with suppress(TimeoutError):  # it asks again when it connects again
            async with asyncio.timeout(_PATIENCE_S):
                await self._links.watch(robot, variables)


def _union(watches: Iterable[Watch]) -> dict[str, frozenset[str]]:
    found: dict[str, set[str]] = {}
    for watch in watches:
        for robot, variables in watch.items():
            found.setdefault(robot, set()).update(variables)
    return {robot: frozenset(variables) for robot, variables in found.items() if variables}
