"""Robots that are connected and say nothing: three heartbeats are missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from amberbox.fleet.linkend.server import Connected
from amberbox.fleet.state.said import moment

LOOK_S = 0.2


class Silence:
    """Remembers who is silent, and tells what has changed."""

    def __init__(self) -> None:
        self._silent: frozenset[str] = frozenset()
        self._unheard: frozenset[str] = frozenset()

    def news(self, robots: Mapping[str, Connected]) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield robots that fell silent or are heard again, with what is told of their presence.

        One whose link has ended is none of them: that is told by itself.
        """
        before, self._silent = self._silent, frozenset(
            name for name, one in robots.items() if one.is_silent
        )  # fmt: skip
        for name in sorted(self._silent - before):
            since = moment(robots[name].last_seen_ns)
            yield name, {"online": True, "silent": True, "since": since}
        for name in sorted(before - self._silent):
            if name in robots:
                yield name, {"online": True}

    def watchers(
        self, robots: Mapping[str, Connected], unheard: frozenset[str]
    ) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield connected robots whose watchers fell silent, or are heard again.

        Their status is another one then, though nothing may have come from them.
        """
        changed, self._unheard = self._unheard ^ unheard, unheard
        for name in sorted(changed & robots.keys()):
            if not robots[name].is_silent:
                yield name, {"online": True}
