"""What one trigger watches in one run of the recorder, and when it fires."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Protocol

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.keeper.conditions import Condition, Conditions, item_of
from amberbox.blackbox.keeper.options import Trigger
from amberbox.core.expression import parse
from amberbox.core.names import identifier
from amberbox.core.types import Batch, IntArray, ItemSchema

EVENTS = identifier(reserved.EVENT)
COUNTERS = identifier(reserved.COUNTERS)
_COUNTS = f"{COUNTERS}__items"
_HEARD = "heard"
_WATCHED = tuple(
    identifier(channel)
    for channel in (reserved.STATUS, reserved.ALARM, reserved.SYMPTOM, reserved.DIAGNOSIS)
)
_PROBE = "probe_"
_TRANSITION = "component_state"
"""Kind of the events by which the watcher says that a component has changed."""


@dataclass(frozen=True, slots=True)
class Firing:
    """A trigger has fired at a time; ``detail`` says by what, if the trigger does not."""

    at_ns: int
    detail: str = ""


class Watcher(Protocol):
    """Looks at rows as they come."""

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take rows of the items it reads."""

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when it fired since it was asked last; all rows until then have been added."""

    def problems(self) -> Iterator[str]:
        """Say what keeps it from working."""


class WhenWatcher:
    """Fires when an expression becomes true."""

    def __init__(self, when: str) -> None:
        self._conditions = Conditions({"when": Condition(parse(when))})

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take rows."""
        self._conditions.add(batch, times_ns)

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when the expression became true."""
        return [Firing(edge.at_ns) for edge in self._conditions.edges(until_ns)]

    def problems(self) -> Iterator[str]:
        """Say why the expression cannot be judged."""
        yield from self._conditions.problems.values()


class SilenceWatcher:
    """Fires when nothing was received of an item for a while, filtered messages counted."""

    def __init__(self, item: str, silence_s: float) -> None:
        self._item = item
        self._last_ns = 0
        self._silent = WhenWatcher(f"age({_HEARD}.at) >= {silence_s!r}")

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take counters of the recorder."""
        counts = batch.children.get("items")
        if batch.item != COUNTERS or counts is None or "last_received_ns" not in counts.columns:
            return
        rows = np.flatnonzero(np.asarray(counts.columns["item"], object) == self._item)
        last_ns = np.asarray(counts.columns["last_received_ns"], np.int64)[rows]
        more = np.diff(last_ns, prepend=self._last_ns) != 0
        if more.any():
            self._last_ns = int(last_ns[-1])
            times_ns = times_ns[np.searchsorted(batch.seq, counts.seq[rows[more]])]
            self._silent.add(_heard(batch, times_ns), times_ns)

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when the silence had lasted long enough."""
        return self._silent.firings(until_ns)

    def problems(self) -> Iterator[str]:
        """Counters are the box's own: nothing can be wrong with them."""
        yield from ()


def _heard(batch: Batch, times_ns: IntArray) -> Batch:
    columns: dict[str, Any] = {"at": np.ones(len(times_ns))}
    return Batch(
        _HEARD, ItemSchema("", ()), batch.writer, batch.run, times_ns, times_ns, times_ns,
        times_ns, columns,
    )  # fmt: skip


class EventWatcher:
    """Fires at each event of a kind."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._found: list[Firing] = []

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take events."""
        if batch.item != EVENTS:
            return
        kinds, texts = batch.columns["kind"], batch.columns["text"]
        for row, at_ns in enumerate(times_ns.tolist()):
            if fnmatchcase(str(kinds[row]), self._kind):
                self._found.append(Firing(at_ns, f"{kinds[row]}: {texts[row]}"))

    def firings(self, until_ns: int) -> list[Firing]:
        """Return when such events happened."""
        found = [firing for firing in self._found if firing.at_ns <= until_ns]
        self._found = [firing for firing in self._found if firing.at_ns > until_ns]
        return found

    def problems(self) -> Iterator[str]:
        """Events are the box's own: nothing can be wrong with them."""
        yield from ()


def watcher_of(trigger: Trigger) -> Watcher:
    """Make what watches for a trigger; raises ExpressionError for one that cannot be read."""
    if trigger.event:
        return EventWatcher(trigger.event)
    if trigger.silence:
        return SilenceWatcher(trigger.silence, trigger.silence_s)
    return WhenWatcher(trigger.when)


def items_of(trigger: Trigger) -> frozenset[str]:
    """Name the items whose rows a trigger wants to see."""
    if trigger.event:
        return frozenset({EVENTS})
    if trigger.silence:
        return frozenset({COUNTERS})
    return Conditions({"when": Condition(parse(trigger.when))}).items


def waits_for(trigger: Trigger) -> frozenset[str]:
    """Name the items that have to come before a trigger can fire."""
    if trigger.silence:
        return frozenset({trigger.silence})
    if trigger.event:
        return frozenset()
    return frozenset(map(item_of, parse(trigger.when).addresses()))


def reads_watch(trigger: Trigger) -> bool:
    """Tell whether a trigger is about what the watcher writes, which comes a moment later."""
    if trigger.event:
        return fnmatchcase(_TRANSITION, trigger.event)
    return any(item in _WATCHED or item.startswith(_PROBE) for item in waits_for(trigger))


def history_ns(trigger: Trigger) -> int:
    """How far back rows matter to a trigger."""
    if trigger.when:
        return parse(trigger.when).history_ns
    return round(trigger.silence_s * 1e9)
