"""What the monitors have lately said of components, for rules that are asked while it is so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from amberbox.core.clock import NS
from amberbox.core.types import Level, Status

_KEPT_NS = 600 * NS
_MOST = 2_000
_EVERY_NS = 10 * NS


class StatusSpan(NamedTuple):
    """The level and state of a component over a span of log time, without its end."""

    component: str
    level: Level
    state: str
    from_ns: int
    to_ns: int


class RecentStatuses(NamedTuple):
    """All statuses of components since an instant; earlier ones are in the watcher's journal."""

    from_ns: int
    spans: Sequence[StatusSpan]


class StatusHistory:
    """The changes of components in the last ten minutes, of an epoch."""

    def __init__(self) -> None:
        self._from_ns = 0
        self._changes: list[tuple[int, str, Level, str]] = []
        self._now: dict[str, tuple[Level, str]] = {}

    def begin(self, at_ns: int) -> None:
        """Begin an epoch, in which nothing is known yet."""
        self._from_ns, self._changes, self._now = at_ns, [], {}

    def take(self, found: Sequence[object]) -> None:
        """Take the statuses of components among findings, in order of time."""
        for one in found:
            if isinstance(one, Status) and not one.mode:
                condition = one.level, one.state
                if self._now.get(one.component) != condition:
                    self._now[one.component] = condition
                    self._changes.append((one.measured_ns, one.component, *condition))

    def forget_before(self, until_ns: int) -> None:
        """Forget changes that are too old, or too many, except for the last of each component."""
        if until_ns - self._from_ns < _KEPT_NS + _EVERY_NS and len(self._changes) <= 2 * _MOST:
            return
        if len(self._changes) > _MOST:
            self._from_ns = max(self._from_ns, self._changes[-_MOST][0])
        self._from_ns = max(self._from_ns, until_ns - _KEPT_NS)
        before = {name: change for change in self._changes for at_ns, name, *_ in [change]
                  if at_ns <= self._from_ns}  # fmt: skip
        after = [change for change in self._changes if change[0] > self._from_ns]
        self._changes = [*((self._from_ns, *change[1:]) for change in before.values()), *after]

    def until(self, at_ns: int) -> RecentStatuses:
        """Return the statuses up to an instant, that instant included."""
        spans: list[StatusSpan] = []
        now: dict[str, tuple[int, Level, str]] = {}
        for changed_ns, name, level, state in self._changes:
            if changed_ns > at_ns:
                break
            if name in now and now[name][0] < changed_ns:
                spans.append(_span(name, now[name], changed_ns))
            now[name] = changed_ns, level, state
        spans += (_span(name, last, at_ns + 1) for name, last in now.items())
        return RecentStatuses(self._from_ns, spans)

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        return {"from_ns": self._from_ns, "changes": self._changes}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self._from_ns = snapshot["from_ns"]
        self._changes = [
            (at_ns, name, level, state) for at_ns, name, level, state in snapshot["changes"]
        ]
        self._now = {name: (level, state) for _, name, level, state in self._changes}


def _span(component: str, since: tuple[int, Level, str], to_ns: int) -> StatusSpan:
    from_ns, level, state = since
    return StatusSpan(component, level, state, from_ns, to_ns)
