"""What rules look up in a record besides conditions: missions, and what the watcher said."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.missions import Mission, choose
from amberbox.consult.span import Window, happened_ns, in_words
from amberbox.core.clock import NS
from amberbox.diagnosis.rules.intervals import Interval, Keys, Span
from amberbox.diagnosis.rules.proof import Source
from amberbox.diagnosis.rules.terms import Term
from amberbox.monitoring.engine.findings import Condition
from amberbox.monitoring.messages.board import SILENT_NS
from amberbox.monitoring.messages.records import COMPONENT_STATE

LASTS = "lasts"
FAILED = "failed"
_FIRST_NS = (3 * NS, 60 * NS)
"""All statuses are written every second; the first of a run may come later."""


@dataclass(frozen=True)
class Missions:
    """The missions of a record."""

    window: Window

    @cached_property
    def known(self) -> list[Mission]:
        """All that meet the window."""
        return choose(self.window.missions(), span=self.window.span)

    def find(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield missions with each of their outcomes."""
        wanted = keys[0]
        for mission in self.known:
            if wanted is None or wanted == mission.id:
                yield from self._of(mission)

    def _of(self, mission: Mission) -> Iterator[Interval]:
        end = self.window.span[1] if mission.to_ns is None else mission.to_ns
        span = mission.from_ns, max(end, mission.from_ns + 1)
        source = Source(
            f"record, mission {mission.name}, {in_words(span)}", ((f"mission {mission.id}", *span),)
        )
        for outcome in _outcomes(mission):
            yield Interval((mission.id, outcome), *span, source)

    def names(self, args: tuple[Term | None, ...]) -> Iterator[tuple[object, ...]]:
        """Yield what kind each mission is."""
        yield from ((mission.id, mission.name) for mission in self.known)

    def parameters(self, args: tuple[Term | None, ...]) -> Iterator[tuple[object, ...]]:
        """Yield the parameters of each mission."""
        for mission in self.known:
            for name, value in mission.parameters.items():
                yield mission.id, name, _plain(value)


def _plain(value: object) -> object:
    """Return a value that a fact can have; others as the JSON that they were written as."""
    if isinstance(value, str | int | float):
        return value
    return msgspec.json.encode(value).decode()


def _outcomes(mission: Mission) -> Iterator[str]:
    """Yield what came of a mission; one that failed in other words has failed, too."""
    if mission.to_ns is None:
        yield LASTS
        return
    yield mission.outcome
    if mission.failed and mission.outcome != FAILED:
        yield FAILED


@dataclass(frozen=True, slots=True)
class _Said:
    """A component was in a condition."""

    component: str
    condition: Condition
    span: Span


@dataclass(frozen=True)
class Statuses:
    """What the watcher said of components, from change to change."""

    window: Window

    @cached_property
    def said(self) -> list[_Said]:
        """Conditions of components in order of time, run by run of the watcher."""
        runs = (self.window.cut(run) for run in self._heard())
        return [said for run in runs if run[0] < run[1] for said in self._in_run(run)]

    def _heard(self) -> Iterator[Span]:
        """Yield the watcher's runs; each counts until its silence would be noticed.

        Otherwise nothing would be so now: a watcher writes a little behind the recorder.
        """
        runs = self.window.watched
        ends = [run[0] for run in runs[1:]]
        for (first, last), end in zip(runs, [*ends, self.window.span[1]], strict=False):
            yield first, max(last, min(last + SILENT_NS, end))

    def levels(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield the levels of components: ok, warn, error, stale, unknown."""
        return self._find(keys, lambda condition: condition.level)

    def states(self, keys: Keys, span: Span | None) -> Iterator[Interval]:
        """Yield the states of components: nominal, not_initialised, a fault state."""
        return self._find(keys, lambda condition: condition.state)

    def _find(self, keys: Keys, word: Callable[[Condition], str]) -> Iterator[Interval]:
        component, wanted = keys
        found = (s for s in self.said if component is None or s.component == component)
        for name, said, span in _joined((s.component, word(s.condition), s.span) for s in found):
            if wanted is None or wanted == said:
                source = Source(f"watcher, {in_words(span)}", ((name, *span),))
                yield Interval((name, said), *span, source)

    def _in_run(self, run: Span) -> Iterator[_Said]:
        changes = list(self._changes(run))
        now = self._first(run) | {
            change["component"]: Condition(**change["before"]) for _, change in reversed(changes)
        }
        since = dict.fromkeys(now, run[0])
        for at_ns, change in changes:
            name = change["component"]
            if since[name] < at_ns:
                yield _Said(name, now[name], (since[name], at_ns))
            since[name], now[name] = at_ns, Condition(**change["after"])
        for name, from_ns in since.items():
            yield _Said(name, now[name], (from_ns, max(run[1], from_ns + 1)))

    def _changes(self, run: Span) -> Iterator[tuple[int, Mapping[str, Any]]]:
        """Yield changes of components, with their times."""
        for row in self.window.rows(reserved.EVENT, ("kind", "details"), run):
            if row["kind"] != COMPONENT_STATE:
                continue
            change = msgspec.json.decode(row["details"])
            if not change["mode"]:
                at_ns = happened_ns(change["at_ns"], row["received"])
                yield min(max(at_ns, run[0]), run[1]), change

    def _first(self, run: Span) -> dict[str, Condition]:
        """Return what was said of components when the run began."""
        for length_ns in _FIRST_NS:
            span = run[0], min(run[1], run[0] + length_ns)
            names = ("component", "mode", "level", "state")
            rows = list(self.window.rows(reserved.STATUS, names, span))
            found = {
                row["component"]: Condition(row["level"], row["state"])
                for row in reversed(rows)
                if not row["mode"]
            }
            if found:
                return found
        return {}


def _joined(
    said: Iterable[tuple[str, str, Span]],
) -> Iterator[tuple[str, str, Span]]:
    """Join what was said of a component again and again; runs of the watcher stay apart."""
    open_: dict[str, tuple[str, Span]] = {}
    for name, word, span in said:
        before = open_.get(name)
        if before is not None and before[0] == word and before[1][1] == span[0]:
            open_[name] = word, (before[1][0], span[1])
            continue
        if before is not None:
            yield name, *before
        open_[name] = word, span
    for name, last in open_.items():
        yield name, *last
