"""Evaluate a record with engine and diagnosis: blocks in, findings out, live and in replay.

A mode that does not return is interrupted; a diagnosis that fails is left out and the monitors
go on.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple, Protocol, TypeAlias

from amberbox.blackbox.store.store import Store
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Diagnosis, FaultFacts, Status, Symptom, WriterCursor
from amberbox.monitoring.alarm_causes import AlarmCauses, DiagnosedAlarms
from amberbox.monitoring.alarms import PersonAction
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import (
    TICK_NS,
    AlarmChange,
    Finding,
    diagnosis_values,
    instant_of,
    is_live_only,
)
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.record_reader import (
    WRITERS,
    Positions,
    RecordBlock,
    RecordedItemsReader,
    at_time,
    before_end,
)
from amberbox.monitoring.watcher_journal import (
    EvaluatedPosition,
    RecordEpoch,
    RecoveredProgress,
    closed_diagnosis,
)

LIMIT_S = 2.0
_LOOKS = 5
_FUNCTIONS = ("evaluate", "explain")


class HangError(TimeoutError):
    """An evaluation took too long."""


def processor_wait_s() -> float:
    """Return how long this thread has waited for a processor; 0 where the kernel does not count."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) / NS
    except (OSError, ValueError, IndexError):
        return 0.0


class HangGuard:
    """A guard that checks now and then whether the same call is still under way."""

    def __init__(
        self,
        codes: frozenset[CodeType],
        clock_s: Callable[[], float] = time.monotonic,
        waited_s: Callable[[], float] = processor_wait_s,
    ) -> None:
        self._codes = codes
        self._clock_s, self._waited_s = clock_s, waited_s
        self._frame: FrameType | None = None
        self._checks = 0
        self._checked = (clock_s(), waited_s())

    def check(self, _number: int, frame: FrameType | None) -> None:
        """Interrupt a call that was still running at several checks in a row.

        Checks are counted, not seconds: while the whole process is suspended there are none. A
        check does not count if the process has waited for a processor most of the time before it.
        """
        before_s, waited_s = self._checked
        self._checked = now_s, now_waited_s = self._clock_s(), self._waited_s()
        call = self._call_in(frame)
        if call is self._frame and now_waited_s - waited_s > (now_s - before_s) / 2:
            return
        self._checks = self._checks + 1 if call is not None and call is self._frame else 0
        self._frame = call
        if self._checks >= _LOOKS:
            self._frame, self._checks = None, 0
            raise HangError(f"no answer within {LIMIT_S:g} s")

    def _call_in(self, frame: FrameType | None) -> FrameType | None:
        while frame is not None and frame.f_code not in self._codes:
            frame = frame.f_back
        return frame


@contextmanager
def hang_guard(plan: MonitoringPlan, others: frozenset[CodeType] = frozenset()) -> Iterator[None]:
    """Raise ``HangError`` inside a function that takes longer than ``LIMIT_S``.

    These are those of modes, and ``others``. The engine treats the interrupted call as a crash of
    that mode, or does without its explanation. Works in the main thread; in others nothing is
    guarded.
    """
    codes = frozenset(_codes(plan)) | others
    if threading.current_thread() is not threading.main_thread() or not codes:
        yield
        return
    before = signal.signal(signal.SIGALRM, HangGuard(codes).check)
    signal.setitimer(signal.ITIMER_REAL, LIMIT_S / _LOOKS, LIMIT_S / _LOOKS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _codes(plan: MonitoringPlan) -> Iterator[CodeType]:
    """Yield the code of each mode's functions."""
    for _, mode in plan.modes():
        for name in _FUNCTIONS:
            code = getattr(getattr(mode.module, name, None), "__code__", None)
            if code is not None:
                yield code


PART = "diagnosing"  # key of the diagnosis in a snapshot


class Diagnoser(Protocol):
    """Diagnoses findings over time.

    It reads no clock, and how rows and findings are split into calls does not matter.
    """

    @property
    def items(self) -> frozenset[str]:
        """Return the names of the items whose rows its own conditions read."""

    @property
    def history_s(self) -> float:
        """Return how far its conditions look back, in seconds."""

    @property
    def facts(self) -> Mapping[str, FaultFacts]:
        """Return the facts of failure modes, by id; empty if there are none."""

    @property
    def left_out(self) -> Mapping[str, str]:
        """Return the providers of evidence that it does without, and why."""

    @property
    def guarded(self) -> frozenset[CodeType]:
        """Return the code of functions that have to return soon."""

    def begin(self, at_ns: int) -> None:
        """Begin an epoch, in which nothing is known yet; an open diagnosis stays open."""

    def feed(self, batch: Batch) -> None:
        """Take rows of any item; log times do not decrease."""

    def advance(
        self, found: Sequence[Status | Symptom], until_ns: int
    ) -> Sequence[Symptom | Diagnosis]:
        """Return symptoms and diagnoses from the monitors' findings, in order of time."""

    def snapshot(self) -> dict[str, Any]:
        """Return the state needed by ``resume``, as JSON, without the rows of ``history_s``."""

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state of a snapshot."""


MakeDiagnoser: TypeAlias = Callable[[], Diagnoser]


class DiagnosedEngine:
    """An engine whose findings are diagnosed; without a diagnoser, the engine alone.

    With ``again`` a diagnoser that raises an error is left out until the next epoch, for which
    another is made. The diagnosis that was open is then over; a replay, which raises the error,
    does not see that.
    """

    def __init__(
        self,
        engine: Engine,
        diagnoser: Diagnoser | None = None,
        again: MakeDiagnoser | None = None,
    ) -> None:
        self._engine = engine
        self._diagnoser = diagnoser
        self._again = again
        self.states = engine.states
        """The engine's states of components and their alarms."""
        self.items = engine.items
        """Names of the items that are read from the record."""
        self.history_s = engine.history_s
        """How far monitors and conditions look back."""
        facts: Mapping[str, FaultFacts] = {}
        self.guarded: frozenset[CodeType] = frozenset()
        """Code of the diagnoser's functions that have to return soon."""
        if diagnoser is not None:
            self.guarded = diagnoser.guarded
            self.items |= diagnoser.items
            self.history_s = max(self.history_s, diagnoser.history_s)
            facts = diagnoser.facts
        plan = engine.states.plan
        self._causes = AlarmCauses(facts, DiagnosedAlarms(plan.robot, plan.config_hash))
        self.trouble = ""
        """Why the diagnoser has failed; the reader empties it."""
        self.left_out: dict[str, str] = {}
        """Providers of evidence that have failed, and why; the reader empties it."""
        self._told: dict[str, str] = {}

    @property
    def diagnosis(self) -> Diagnosis | None:
        """Return the last revision of the open diagnosis."""
        return self._causes.diagnosis

    def begin(self, at_ns: int) -> None:
        """Begin an epoch; alarms and an open diagnosis stay."""
        self._causes.adopt(self.states.alarms())
        self._engine.begin(at_ns)
        if self._diagnoser is None and self._again is not None:
            self._diagnoser = self._again()
        if self._diagnoser is not None:
            self._diagnoser.begin(at_ns // TICK_NS * TICK_NS)

    def feed(self, batch: Batch) -> None:
        """Take rows of any item; log times do not decrease."""
        self._engine.feed(batch)
        if self._diagnoser is not None:
            try:
                self._diagnoser.feed(batch)
            except Exception as error:  # whatever the error is, statuses and alarms must go on
                self._fail(error)

    def advance(self, until_ns: int) -> list[Finding]:
        """Return the findings up to an instant, in order of time."""
        until_ns = until_ns // TICK_NS * TICK_NS
        found = self._engine.advance(until_ns)
        diagnosed: Sequence[Symptom | Diagnosis] = ()
        if self._diagnoser is not None:
            wanted = [finding for finding in found if isinstance(finding, Status | Symptom)]
            try:
                diagnosed = self._diagnoser.advance(wanted, until_ns)
                self._note_left_out(self._diagnoser.left_out)
            except Exception as error:  # as above
                self._fail(error)
        if self._diagnoser is None and self.diagnosis is not None:
            diagnosed = [closed_diagnosis(self.diagnosis, until_ns)]
        return list(
            self._causes.process(_merged(found, diagnosed) if diagnosed else found, until_ns)
        )

    def _note_left_out(self, providers: Mapping[str, str]) -> None:
        if providers != self._told:
            self.left_out |= dict(providers.items() - self._told.items())
            self._told = dict(providers)

    def _fail(self, error: Exception) -> None:
        """Leave the diagnoser out and keep the trouble; raise the error if no other can be made."""
        if self._again is None:
            raise error
        self._diagnoser = None
        self.trouble = f"{type(error).__name__}: {error}"

    def statuses(self) -> Sequence[Status]:
        """Return the newest status of each mode and component."""
        return self._engine.statuses()

    def alarms(self) -> list[AlarmChange]:
        """Return the active alarms in their present state, with their causes."""
        return self._causes.named(self.states.alarms())

    def command(self, alarm_id: str, done: PersonAction) -> list[AlarmChange]:
        """Apply a person's action to an alarm; raises UsageError if that is not possible."""
        changes = self._causes.command(alarm_id, done)
        if changes is None:
            changes = self.states.command(alarm_id, done)
        return [self._causes.take(change) for change in changes]

    def snapshot(self) -> dict[str, Any]:
        """Return the state needed by ``resume``, without the rows of ``history_s``."""
        known = None if self._diagnoser is None else self._diagnoser.snapshot()
        last = None if self.diagnosis is None else diagnosis_values(self.diagnosis)
        diagnoser = known or {} if self._again is None else {"of": known, "open": last}
        part = {"diagnoser": diagnoser, "causes": self._causes.snapshot()}
        return {**self._engine.snapshot(), PART: part}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot; without a diagnosis in it, start with a new one.

        A diagnoser that had failed stays off until the next epoch.
        """
        self._engine.resume(snapshot)
        part = snapshot.get(PART)
        if part is None:
            self._causes.adopt(self.states.alarms())
            if self._diagnoser is not None:
                self._diagnoser.begin(int(snapshot["until_ns"]))
            return
        known = part["diagnoser"] if self._again is None else part["diagnoser"]["of"]
        if known is None:
            self._diagnoser = None
        elif self._diagnoser is not None:
            self._diagnoser.resume(known)
        self._causes.resume(part["causes"])


def _merged(found: Sequence[Finding], diagnosed: Sequence[Finding]) -> Iterator[Finding]:
    """Yield both in order of time; at the same instant findings come before diagnoses."""
    place = 0
    for finding in diagnosed:
        at_ns = instant_of(finding)
        while place < len(found) and instant_of(found[place]) <= at_ns:
            yield found[place]
            place += 1
        yield finding
    yield from found[place:]


@dataclass(slots=True)
class RecordEvaluation:
    """Feeds an engine block by block, and keeps the instant up to which it has evaluated.

    With a checkpoint it continues from there: earlier findings are not returned again.
    """

    engine: DiagnosedEngine
    memory: RecoveredProgress = field(default_factory=RecoveredProgress)
    place: EvaluatedPosition | None = None
    trouble: str = ""
    """Why the checkpoint could not be used; empty if it could."""
    anew: bool = False
    """Whether it started from the beginning, except for the alarms, instead of from the
    checkpoint.
    """
    _epoch: RecordEpoch | None = None
    _known: EvaluatedPosition | None = None
    _more: int = 0

    def __post_init__(self) -> None:
        self._known, self._more = self.memory.place, self.memory.more

    def take(self, block: RecordBlock) -> Iterator[list[Finding]]:
        """Evaluate a block; yield its new findings, each time after ``place`` has moved on."""
        if block.epoch != self._epoch and not self._enter(block.epoch, block.start_ns):
            return
        for batch in block.batches:
            self.engine.feed(batch)
        if self.place is not None and block.until_ns <= self.place.until_ns:
            return
        if self._known is not None:
            self._repeat(self._known, block)
        if self._known is None and (self.place is None or block.until_ns > self.place.until_ns):
            found = list(self.engine.advance(block.until_ns))
            self.place = EvaluatedPosition(block.epoch, block.until_ns)
            yield self._new(found)

    def _new(self, found: list[Finding]) -> list[Finding]:
        """Return the findings that were not written before; only replayable ones were counted."""
        for place, finding in enumerate(found):
            if not self._more:
                return found[place:]
            self._more -= not is_live_only(finding)
        return []

    def _enter(self, epoch: RecordEpoch, start_ns: int) -> bool:
        """Enter an epoch; return False for one before the remembered one."""
        if self._known is not None and self._epoch == self._known.epoch:
            self._known = None
        left = self.memory.checkpoint
        if self._epoch is None and left is not None:
            if epoch != left.place.epoch and epoch.run <= left.place.epoch.run:
                return False
            is_there = epoch == left.place.epoch
            if is_there and left.engine and self.memory.is_ours and self._resumed(left.engine):
                self._epoch, self.place = epoch, left.place
                return True
            self._take_alarms(left.engine)
        self.anew = self.anew or self._epoch is None
        self.engine.begin(start_ns)
        self._epoch, self.place = epoch, None
        return True

    def _resumed(self, engine: Mapping[str, Any]) -> bool:
        """Restore the engine's state; return False, and keep the trouble, if that is impossible."""
        try:
            self.engine.resume(engine)
        except Exception as error:  # it is of another version, or damaged: begin anew
            self.trouble = f"{type(error).__name__}: {error}"
            return False
        return True

    def _take_alarms(self, engine: Mapping[str, Any]) -> None:
        """Restore only the alarms: they and their ids outlast a change of the monitors."""
        if "states" not in engine:
            return
        try:
            self.engine.states.resume({**engine["states"], "config_hash": None})
        except Exception as error:  # as above
            self.trouble = f"{type(error).__name__}: {error}"

    @property
    def has_caught_up(self) -> bool:
        """Return whether all findings written before have been found again."""
        return self.place is not None and self._known is None and self._more == 0

    @property
    def is_behind(self) -> bool:
        """Return whether the position evaluated before is not reached again yet."""
        return self._known is not None

    def _repeat(self, known: EvaluatedPosition, block: RecordBlock) -> None:
        """Evaluate again, without results, the part that was evaluated and written before."""
        if block.epoch.run > known.epoch.run:
            self._known, self._more = None, 0
            return
        is_there = block.epoch == known.epoch
        until_ns = min(block.until_ns, known.until_ns) if is_there else block.until_ns
        if self.place is None or until_ns > self.place.until_ns:
            self.engine.advance(until_ns)
            self.place = EvaluatedPosition(block.epoch, until_ns)
        if is_there and block.until_ns >= known.until_ns:
            self._known = None


WARM_UP_S = 60.0  # added before the start of a partial replay, beside the monitors' history


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What of a record is replayed, in log time, and how many times faster than it was."""

    from_ns: int | None = None
    to_ns: int | None = None
    speed: float | None = None
    """Speed of the replay; None for as fast as possible."""


class EndOfRecord(NamedTuple):
    """The state at the end of a record: statuses, their time, and the diagnosis."""

    statuses: Sequence[Status]
    at_ns: int
    diagnosis: Diagnosis | None = None


def replay(
    plan: MonitoringPlan,
    store: Store,
    part: ReplayOptions = ReplayOptions(),
    stop: threading.Event | None = None,
    diagnoser: MakeDiagnoser | None = None,
) -> Iterator[Finding]:
    """Yield the findings in a record in order of time, with statuses every second.

    ``diagnoser`` makes the diagnoser of the record.
    """
    engine = DiagnosedEngine(Engine(plan), diagnoser and diagnoser())
    evaluation = RecordEvaluation(engine)
    pace = ReplayPace(part.speed, stop or threading.Event())
    with hang_guard(plan, engine.guarded):
        for block in blocks(plan, store, engine, part):
            for finding in (one for found in evaluation.take(block) for one in found):
                at_ns = instant_of(finding)
                if _is_inside(at_ns, part) and pace.wait_for(block, at_ns):
                    yield finding
            if (part.to_ns is not None and block.until_ns >= part.to_ns) or pace.stopped:
                return


def end_of_record(
    plan: MonitoringPlan, store: Store, diagnoser: MakeDiagnoser | None = None
) -> EndOfRecord:
    """Return the statuses of all modes and components at the end of the record."""
    engine = DiagnosedEngine(Engine(plan), diagnoser and diagnoser())
    evaluation = RecordEvaluation(engine)
    with hang_guard(plan, engine.guarded):
        start = before_end(store, WARM_UP_S + engine.history_s)
        for block in _reader(plan, store, engine, start).step():
            for _ in evaluation.take(block):
                pass  # only the last statuses count
    at_ns = 0 if evaluation.place is None else evaluation.place.until_ns
    return EndOfRecord(engine.statuses(), at_ns, engine.diagnosis)


def blocks(
    plan: MonitoringPlan, store: Store, engine: DiagnosedEngine, part: ReplayOptions
) -> Iterator[RecordBlock]:
    """Yield the blocks of a part of a record, and of the time before it that monitors need."""
    start: dict[str, WriterCursor] = {}
    if part.from_ns is not None:
        from_ns = part.from_ns - round((WARM_UP_S + engine.history_s) * NS)
        start = {writer: at_time(store, writer, from_ns) for writer in WRITERS}
    return _reader(plan, store, engine, start).step()


def _reader(
    plan: MonitoringPlan, store: Store, engine: DiagnosedEngine, start: Positions
) -> RecordedItemsReader:
    return RecordedItemsReader(store, engine.items, plan.own_items(), start)


def _is_inside(at_ns: int, part: ReplayOptions) -> bool:
    after = part.from_ns is None or at_ns >= part.from_ns
    return after and (part.to_ns is None or at_ns < part.to_ns)


class ReplayPace:
    """Paces a replay by its speed relative to the record."""

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
        """Return whether the replay has been stopped."""
        return self._stop.is_set()

    def wait_for(self, block: RecordBlock, at_ns: int) -> bool:
        """Wait until an instant is due; return False when stopped meanwhile."""
        if self._speed is None:
            return not self._stop.is_set()
        if self._begin is None or self._begin[0] != block.epoch:
            self._begin = block.epoch, at_ns, self._clock_s()
        _, first_ns, began_s = self._begin
        due_s = began_s + (at_ns - first_ns) / NS / self._speed
        return not self._stop.wait(max(0.0, due_s - self._clock_s()))
