"""Evaluate what is recorded: the findings that a watcher writes, without writing anything."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from amberbox.blackbox.store import Store
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Status, WriterCursor
from amberbox.monitoring.engine.engine import Engine
from amberbox.monitoring.engine.findings import Finding
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.watcher.diagnosing import Diagnosing, MakeDiagnoser
from amberbox.monitoring.watcher.evaluation import Evaluates, Evaluation
from amberbox.monitoring.watcher.guard import guarded
from amberbox.monitoring.watcher.instants import instant_of
from amberbox.monitoring.watcher.reader import Block, Positions, Reader
from amberbox.monitoring.watcher.start import WRITERS, at_time, before_end

WARM_UP_S = 60.0
"""A replay of a part begins this long before it, beside what the monitors look back."""


@dataclass(frozen=True, slots=True)
class Part:
    """What of a record is replayed, in log time, and how many times faster than it was."""

    from_ns: int | None = None
    to_ns: int | None = None
    speed: float | None = None
    """None is as fast as it goes."""


class Newest(NamedTuple):
    """How everything is at the end of a record: statuses, when that is, what is diagnosed."""

    statuses: Sequence[Status]
    at_ns: int
    diagnosis: Diagnosis | None = None


def replay(
    plan: Plan,
    store: Store,
    part: Part = Part(),
    stop: threading.Event | None = None,
    diagnoser: MakeDiagnoser | None = None,
) -> Iterator[Finding]:
    """Yield what is found in a record, in order of time; statuses every second among it.

    ``diagnoser`` makes what diagnoses it.
    """
    engine = Diagnosing(Engine(plan), diagnoser and diagnoser())
    evaluation = Evaluation(engine)
    pace = Pace(part.speed, stop or threading.Event())
    with guarded(plan):
        for block in blocks(plan, store, engine, part):
            for finding in (one for found in evaluation.take(block) for one in found):
                at_ns = instant_of(finding)
                if _is_inside(at_ns, part) and pace.wait_for(block, at_ns):
                    yield finding
            if (part.to_ns is not None and block.until_ns >= part.to_ns) or pace.stopped:
                return


def newest(plan: Plan, store: Store, diagnoser: MakeDiagnoser | None = None) -> Newest:
    """Return the statuses of all modes and components at the end of the record."""
    engine = Diagnosing(Engine(plan), diagnoser and diagnoser())
    evaluation = Evaluation(engine)
    with guarded(plan):
        start = before_end(store, WARM_UP_S + engine.history_s)
        for block in _reader(plan, store, engine, start).step():
            for _ in evaluation.take(block):
                pass  # only the last statuses count
    at_ns = 0 if evaluation.place is None else evaluation.place.until_ns
    return Newest(engine.statuses(), at_ns, engine.diagnosis)


def blocks(plan: Plan, store: Store, engine: Evaluates, part: Part) -> Iterator[Block]:
    """Give what is recorded of a part of a record, and what the monitors need from before it."""
    start: dict[str, WriterCursor] = {}
    if part.from_ns is not None:
        from_ns = part.from_ns - round((WARM_UP_S + engine.history_s) * NS)
        start = {writer: at_time(store, writer, from_ns) for writer in WRITERS}
    return _reader(plan, store, engine, start).step()


def _reader(plan: Plan, store: Store, engine: Evaluates, start: Positions) -> Reader:
    return Reader(store, engine.items, [order.item for order in plan.probes()], start)


def _is_inside(at_ns: int, part: Part) -> bool:
    after = part.from_ns is None or at_ns >= part.from_ns
    return after and (part.to_ns is None or at_ns < part.to_ns)


class Pace:
    """Lets a replay go as many times faster than the record was."""

    def __init__(
        self,
        speed: float | None,
        stop: threading.Event,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._speed = speed
        self._stop = stop
        self._clock_s = clock_s
        self._begin: tuple[object, int, float] | None = None

    @property
    def stopped(self) -> bool:
        """Tell whether the replay has been stopped."""
        return self._stop.is_set()

    def wait_for(self, block: Block, at_ns: int) -> bool:
        """Wait until it is time for an instant; False when stopped meanwhile."""
        if self._speed is None:
            return not self._stop.is_set()
        if self._begin is None or self._begin[0] != block.epoch:
            self._begin = block.epoch, at_ns, self._clock_s()
        _, first_ns, began_s = self._begin
        due_s = began_s + (at_ns - first_ns) / NS / self._speed
        return not self._stop.wait(max(0.0, due_s - self._clock_s()))
