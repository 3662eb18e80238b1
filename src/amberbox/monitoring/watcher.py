"""The watcher process: follow a record, evaluate it, and write the findings.

It carries out requests about alarms, and reports all statuses as unknown while the recorder is
silent.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import msgspec

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.store.derived_journal import ItemMessage, ReaderProgress
from amberbox.blackbox.store.store import Store, StoreRequest, WriterLock, finish, pending
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.errors import UsageError
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.given_findings import KIND as FINDING_KIND
from amberbox.core.given_findings import RecordedFinding
from amberbox.core.probe import SOURCE, ProbeOrder
from amberbox.core.systemd import Notifier
from amberbox.core.types import Status
from amberbox.core.version import __version__
from amberbox.monitoring.alarms import NEVER_NS, PersonAction
from amberbox.monitoring.current_state import EvaluationLateness, write_watched_files
from amberbox.monitoring.detector_scores import DetectorScores
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import AlarmChange, Finding
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.probe_runner import ProbeRunner
from amberbox.monitoring.record_evaluation import (
    DiagnosedEngine,
    MakeDiagnoser,
    RecordEvaluation,
    hang_guard,
)
from amberbox.monitoring.record_reader import (
    WATCH,
    RecordedItemsReader,
    before_checkpoint,
    before_end,
)
from amberbox.monitoring.status_publisher import StatusPublisher
from amberbox.monitoring.watcher_journal import (
    Checkpoint,
    EvaluatedPosition,
    RecoveredProgress,
    RetainedState,
    WatcherJournal,
    recover_progress,
    retained_findings,
)

KIND = "alarm"
# Kind of the requests with answers to tests of the open diagnosis
ANSWER_KIND = "answer"
Given = TypeVar("Given", RecordedAnswer, RecordedFinding)


def apply_alarm_request(
    request: StoreRequest, engine: DiagnosedEngine, at_ns: int, shift_ns: int
) -> list[AlarmChange]:
    """Carry out a request; its times are wall clock, log time is ``shift_ns`` more.

    Raises UsageError if it no longer applies (the alarm has healed meanwhile), and ValueError for
    an unreadable request.
    """
    values = request.values
    until_ns = values.get("until_ns")
    if until_ns is not None:
        if type(until_ns) is not int or not 0 <= until_ns < NEVER_NS:
            raise ValueError(f"until_ns: {until_ns!r:.40} is no time")
        until_ns += shift_ns
    texts = {name: str(values.get(name, "")) for name in ("who", "note", "command")}
    action: Any = str(values.get("action"))
    done = PersonAction(action, at_ns=at_ns, until_ns=until_ns, **texts)
    return engine.command(str(values.get("id")), done)


GONE_S = 2.0  # silence after which a record without recorder counts as ended
STUCK_S = 3.0  # a recorder writes at least once a second, whatever its sources do
_PERIOD_S = 1.0


@dataclass(slots=True)
class SilenceTimer:
    """Measures by the machine's monotonic clock for how long the record has been silent.

    Silence is the time from the last new rows to the last poll: the time that the watcher takes to
    evaluate, or is held up, does not count. A single poll without rows is no silence.
    """

    clock_s: Callable[[], float]
    _received_s: float = field(init=False)
    _polled_s: float = field(init=False)
    _reported_s: float | None = None
    _empty: int = 0
    """Number of consecutive polls without new rows."""

    def __post_init__(self) -> None:
        self._received_s = self._polled_s = self.clock_s()

    def polled(self) -> None:
        """Record that the record is polled."""
        self._polled_s, self._empty = self.clock_s(), self._empty + 1

    def received(self) -> None:
        """Record that new rows were received."""
        self._received_s, self._reported_s, self._empty = self.clock_s(), None, 0

    def due(self, *, is_recording: bool) -> float:
        """Return the length of the silence in seconds, once a second; 0 while it is normal."""
        now_s = self._polled_s
        silent_s = now_s - self._received_s
        if self._empty < 2 or silent_s <= (STUCK_S if is_recording else GONE_S):
            return 0.0
        if self._reported_s is not None and now_s - self._reported_s < _PERIOD_S:
            return 0.0
        self._reported_s = now_s
        return silent_s


def unknown_statuses(
    statuses: Sequence[Status], now_ns: int, silent_s: float, reason: str
) -> Iterator[Status]:
    """Yield all statuses as unknown, ``live_only``: a replay cannot find them."""
    since_ns = now_ns - round(silent_s * 1e9)
    for status in statuses:
        yield replace(
            status, level="unknown", state="unknown", outputs=dict.fromkeys(status.outputs),
            measured_ns=now_ns, since_ns=since_ns, reason=reason, blocked_by=(), live_only=True,
        )  # fmt: skip


POLL_S = 0.02
CHECKPOINT_S = 10.0
FIRST_S = 60.0  # lookback before the end of the record without a checkpoint
CURRENT_S = 3.0  # statuses are published as current if they are no older
_MARGIN_S = 5.0
_REQUESTS_S = 0.2

OnFindings = Callable[[Sequence[Finding]], None]


@dataclass
class WatcherSetup:
    """The setup of a watcher: a plan, and the store whose record is evaluated."""

    plan: MonitoringPlan
    store: Store
    folder: RobotFolder | None = None
    clock: Clock = field(default_factory=SystemClock)
    clock_s: Callable[[], float] = time.monotonic
    diagnoser: MakeDiagnoser | None = None
    """Creates the diagnoser of the monitors' findings."""

    @property
    def monitors(self) -> str:
        """Return an id of the monitors; a checkpoint of other monitors is not used.

        The failure modes used by the diagnosis are part of the configuration.
        """
        monitors = f"{self.plan.config_hash} {__version__}"
        return monitors if self.diagnoser is None else f"{monitors} diagnosed"


class RecordWatcher:
    """Watches one store; ``step`` does the work due now, ``run`` repeats it until stopped.

    ``on_findings`` receives everything that is written.
    """

    def __init__(self, watch: WatcherSetup, on_findings: OnFindings | None = None) -> None:
        self._watch = watch
        self._on_findings = on_findings or (lambda _: None)
        self._lock = WriterLock(watch.store, WATCH)
        diagnoser = watch.diagnoser and watch.diagnoser()
        self._engine = DiagnosedEngine(Engine(watch.plan), diagnoser, again=watch.diagnoser)
        self._retained = RetainedState(retained_findings(watch.store), self._engine)
        self._journal = WatcherJournal(
            watch.store, watch.plan.robot, watch.plan.config_hash, watch.clock, self._retained.again
        )
        memory = _memory_of(watch, self._engine.history_s)
        left = memory.checkpoint
        self._is_new = left is None
        first_s = self._engine.history_s + FIRST_S
        self._start = (
            before_end(watch.store, first_s)
            if left is None
            else before_checkpoint(watch.store, left)
        )
        self._evaluation = RecordEvaluation(self._engine, memory)
        probes = {order.item for order in watch.plan.probes()}
        given = probes - {order.item for order in own_probes(watch)}
        own = [item for item in watch.plan.own_items() if item not in given]
        self._reader = RecordedItemsReader(watch.store, self._engine.items, own, self._start)
        self._scores = DetectorScores(watch.store, own)
        self._scores_read_s = -1e9
        self._silence = SilenceTimer(watch.clock_s)
        self._lateness = EvaluationLateness(watch.store, watch.clock)
        self._is_sound = True
        """Everything that was evaluated is written down."""
        self._silent: list[Status] = []
        self._noted_s = self._requests_read_s = watch.clock_s()
        self._measured: list[tuple[ProbeOrder, Mapping[str, Any]]] = []
        self._measured_lock = threading.Lock()
        folder = watch.folder
        entries = () if folder is None else folder.robot.monitoring.publish
        options = [entry.in_folder(folder.path) for entry in entries if folder is not None]
        self._publisher = StatusPublisher(options, watch.plan, watch.clock_s)
        self._notifier = Notifier(monotonic=watch.clock_s)
        self._stop = threading.Event()
        if memory.place is not None:
            self._journal.passed(memory.place)

    def run(self, stop: threading.Event) -> None:
        """Watch until ``stop`` is set; probes run meanwhile."""
        self._stop = stop
        orders, folder = own_probes(self._watch), self._watch.folder
        extra = () if folder is None else (folder.path / "probes",)
        runner = ProbeRunner(orders, self.measured, extra) if orders else None
        self._publisher.open()
        if self._watch.folder is not None:
            write_watched_files(self._watch.store, self._watch.folder)
        self._lateness.start()
        try:
            if runner is not None:
                runner.start()
            with hang_guard(self._watch.plan, self._engine.guarded):
                while not stop.is_set():
                    self.step()
                    self._notifier.ready()
                    self._notifier.alive(self._status_line)
                    stop.wait(POLL_S)
        finally:
            self._notifier.stopping()
            self._lateness.close()
            if runner is not None:
                runner.close()
            self.close()

    def step(self) -> None:
        """Write measurements of probes, read new rows, evaluate them, write the findings.

        Raises OSError when writing fails; the next watcher continues from before that.
        """
        self._is_sound = False
        self._lateness.began()
        self._silence.polled()
        with self._measured_lock:
            taken, self._measured = self._measured, []
        if taken and self._journal.is_live:
            self._journal.measured([
                ItemMessage(f"{SOURCE}/{order.topic}", order.item, SOURCE, values)
                for order, values in taken
            ])  # fmt: skip
        self._copy_scores()
        for block in self._reader.step():
            self._silence.received()
            self._notifier.alive(self._status_line)
            for found in self._evaluation.take(block):
                self._write(found)
            if self._stop.is_set():  # a long backlog: the next watcher goes on from here
                return
        self._settle()
        self._log_lateness(self._lateness.ended())
        self._carry_out_requests()
        silent_s = self._silence.due(is_recording=self._reader.is_recording)
        if silent_s:
            now_ns = self._journal.now_ns()
            reason = f"the recorder has written nothing for {silent_s:.0f} s"
            self._silent = list(unknown_statuses(self._engine.statuses(), now_ns, silent_s, reason))
            self._journal.found(self._silent, ())
            self._on_findings(self._silent)
            self._publisher.changed()
        if self._publisher.is_due():
            self._publisher.publish(self._known_now(), self._engine.diagnosis)
        for kind, text in self._publisher.events() if self._journal.is_live else ():
            self._journal.log_event(kind, text)
        self._is_sound = True

    def close(self) -> None:
        """Write a checkpoint, and release the store."""
        place = self._evaluation.place
        try:
            if place is not None and self._is_sound and not self._evaluation.is_behind:
                self._journal.found([], [self._checkpoint(place)])
            self._journal.close()
        finally:
            self._publisher.close()
            self._lock.release()

    def measured(self, order: ProbeOrder, values: Mapping[str, Any]) -> None:
        """Add a row of a probe; may be called from any thread."""
        with self._measured_lock:
            self._measured.append((order, values))

    def _copy_scores(self) -> None:
        """Write down the new scores of detectors, which modes read with the rows of now."""
        now_s = self._watch.clock_s()
        if self._journal.is_live and now_s - self._scores_read_s >= _REQUESTS_S:
            self._scores_read_s = now_s
            rows = list(self._scores.take(self._journal.now_ns()))
            if rows:
                self._journal.measured(rows)

    def _write(self, found: Sequence[Finding]) -> None:
        """Write the findings up to a position, and the position, in one chunk."""
        self._settle(found)
        place = self._evaluation.place
        assert place is not None
        self._journal.passed(place)
        if self._is_new:
            self._journal.found([], [self._first(place)])
            self._is_new = False
        if self._evaluation.trouble:
            text = f"begins anew, what was remembered is of no use: {self._evaluation.trouble}"
            self._journal.log_event("watch_anew", text)
            self._evaluation.trouble = ""
        if self._engine.trouble:
            text = f"goes on without diagnosis, which has failed: {self._engine.trouble}"
            self._journal.log_event("diagnosis_failed", text)
            self._engine.trouble = ""
        for name, why in self._engine.left_out.items():
            text = f"the diagnosis goes on without its {name}: {why}"
            self._journal.log_event("evidence_failed", text)
        self._engine.left_out = {}
        notes = [place.note(self._watch.store.id)]
        if self._watch.clock_s() - self._noted_s >= CHECKPOINT_S:
            notes.append(self._checkpoint(place))
        self._journal.found(found, notes)
        if self._silent or not all(isinstance(finding, Status) for finding in found):
            self._publisher.changed()
        self._silent = []
        self._on_findings(found)

    def _settle(self, found: Sequence[Finding] = ()) -> None:
        """Write what new monitors change, once all findings written before are found again.

        ``found`` is written right after it.
        """
        place = self._evaluation.place
        if place is None or self._retained.settled or not self._evaluation.has_caught_up:
            return
        self._journal.passed(place)
        changes = self._retained.settle(found, place.until_ns, anew=self._evaluation.anew)
        if changes:
            self._journal.found(changes, ())
            self._on_findings(changes)

    def _log_lateness(self, late_s: float | None) -> None:
        """Write an event when monitoring has become overloaded, or is no longer."""
        if late_s is None or self._evaluation.place is None:
            return
        if late_s:
            text = f"monitoring overloaded: what was recorded was evaluated {late_s:.1f} s late"
            self._journal.log_event("monitoring_overloaded", text)
        else:
            self._journal.log_event("monitoring_recovered", "monitoring is up to date again")

    def _known_now(self) -> Sequence[Status]:
        """Return the statuses as of now; while it catches up, old ones are replaced by unknown."""
        if self._silent:
            return self._silent
        statuses, now_ns = self._engine.statuses(), self._journal.now_ns()
        place = self._evaluation.place
        if place is None or self._evaluation.is_behind or not self._journal.is_live:
            return list(unknown_statuses(statuses, now_ns, 0.0, "not evaluated yet"))
        late_s = (now_ns - place.until_ns) / NS
        if late_s < CURRENT_S:
            return statuses
        reason = f"evaluated up to {late_s:.0f} s ago only"
        return list(unknown_statuses(statuses, now_ns, late_s, reason))

    def _status_line(self) -> str:
        """Return one line on the monitored robot, for the process supervisor."""
        behind = "; catching up with the record" if self._evaluation.is_behind else ""
        if self._lateness.is_overloaded:
            behind += f"; overloaded, {self._lateness.delay_s():.0f} s late"
        return f"{len(self._watch.plan.components)} components{behind}"

    def _first(self, place: EvaluatedPosition) -> ReaderProgress:
        """Return a checkpoint of where reading began, for a restart before the next one."""
        about, store_id = self._watch.monitors, self._watch.store.id
        return Checkpoint(place.before(), self._start, 0.0, {}, about).note(store_id)

    def _checkpoint(self, place: EvaluatedPosition) -> ReaderProgress:
        self._noted_s = self._watch.clock_s()
        ahead_s = max(self._reader.last_ns() - place.until_ns, 0) / NS
        return Checkpoint(
            place, self._reader.positions(), self._engine.history_s + ahead_s + _MARGIN_S,
            self._engine.snapshot(), self._watch.monitors,
        ).note(self._watch.store.id)  # fmt: skip

    def _carry_out_requests(self) -> None:
        """Carry out requests about alarms, with a checkpoint at once, and write answers down."""
        place, now_s = self._evaluation.place, self._watch.clock_s()
        if (
            place is None
            or self._evaluation.is_behind
            or now_s - self._requests_read_s < _REQUESTS_S
        ):
            return
        self._requests_read_s = now_s
        for request in pending(self._watch.store):
            if request.kind == KIND:
                shift_ns = self._journal.now_ns() - self._watch.clock.wall_ns()
                self._carry_out(request, place, shift_ns)
            elif request.kind == ANSWER_KIND:
                self._take_given(request, RecordedAnswer, self._journal.answered)
            elif request.kind == FINDING_KIND:
                self._take_given(request, RecordedFinding, self._journal.detected)

    def _carry_out(self, request: StoreRequest, place: EvaluatedPosition, shift_ns: int) -> None:
        """Carry out a request; what cannot be done becomes an event."""
        try:
            changes = apply_alarm_request(request, self._engine, place.until_ns, shift_ns)
        except UsageError as error:  # healed meanwhile, or acknowledged twice
            self._journal.log_event("alarm_refused", f"request refused: {error.what}")
        except ValueError as error:
            self._set_aside(request, error)
            return
        else:
            if changes:
                self._journal.found(changes, [self._checkpoint(place)])
                self._on_findings(changes)
        finish(request)

    def _take_given(
        self, request: StoreRequest, kind: type[Given], write: Callable[[Given], None]
    ) -> None:
        """Write an answer or a finding into the journal, from which the diagnosis reads it."""
        try:
            given = msgspec.convert(request.values, kind)
        except msgspec.ValidationError as error:
            self._set_aside(request, error)
            return
        write(given)
        finish(request)

    def _set_aside(self, request: StoreRequest, error: Exception) -> None:
        aside = request.path.with_suffix(".refused")  # under a name that is no request
        with suppress(FileNotFoundError):
            request.path.rename(aside)
        text = f"request {aside.name} cannot be read: {error}"
        self._journal.log_event(f"{request.kind}_refused", text)


def _memory_of(watch: WatcherSetup, history_s: float) -> RecoveredProgress:
    """Return the progress of the last watcher; of other monitors only the alarms are used."""
    memory = recover_progress(watch.store)
    left = memory.checkpoint
    if left is not None and left.monitors != watch.monitors:
        memory.checkpoint = replace(left, lookback_s=history_s + FIRST_S)
        memory.more, memory.is_ours = 0, False
    return memory


def own_probes(watch: WatcherSetup) -> list[ProbeOrder]:
    """Return the probes that the watcher runs itself: none where a source block gives them."""
    blocks = () if watch.folder is None else watch.folder.blocks
    return [] if any(block.name == SOURCE for block in blocks) else watch.plan.probes()
