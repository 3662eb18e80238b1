"""The watcher: follows a record, evaluates what it says, and writes down what it finds.

It reads its own rows back like all others, so a replay sees what it saw. Killed at any moment it
goes on where it was: no finding is lost, none is written twice.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from amberbox import __version__
from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.keeper.ownjournal import Progress
from amberbox.blackbox.keeper.ownstreams import Row
from amberbox.blackbox.requests import Request
from amberbox.blackbox.service import Notifier
from amberbox.blackbox.store import Store, WriterLock
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.errors import UsageError
from amberbox.core.probe import SOURCE, ProbeOrder
from amberbox.core.types import Status
from amberbox.monitoring.engine.engine import Engine
from amberbox.monitoring.engine.findings import Finding
from amberbox.monitoring.messages.publisher import Publisher
from amberbox.monitoring.messages.watched import write_watched
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.probing.runner import ProbeRunner
from amberbox.monitoring.watcher import commands
from amberbox.monitoring.watcher.diagnosing import Diagnosing, MakeDiagnoser
from amberbox.monitoring.watcher.evaluation import Evaluation
from amberbox.monitoring.watcher.guard import guarded
from amberbox.monitoring.watcher.lateness import Lateness
from amberbox.monitoring.watcher.memory import Checkpoint, Memory, Place, recall
from amberbox.monitoring.watcher.reader import Reader
from amberbox.monitoring.watcher.silence import Silence, silent, unknown
from amberbox.monitoring.watcher.standing import Standing, standing_in
from amberbox.monitoring.watcher.start import WATCH, before_checkpoint, before_end
from amberbox.monitoring.watcher.surviving import Surviving
from amberbox.monitoring.watcher.writing import Journal

POLL_S = 0.02
CHECKPOINT_S = 10.0
FIRST_S = 60.0
"""A watcher without a memory begins this long before the end of the record."""
CURRENT_S = 3.0
"""What is published is how things are if it is evaluated up to so long ago."""
_MARGIN_S = 5.0
_REQUESTS_S = 0.2

Tell = Callable[[Sequence[Finding]], None]


@dataclass
class Watch:
    """What is watched: a plan, and the store whose record it is about."""

    plan: Plan
    store: Store
    folder: RobotFolder | None = None
    clock: Clock = field(default_factory=SystemClock)
    clock_s: Callable[[], float] = time.monotonic
    diagnoser: MakeDiagnoser | None = None
    """Makes what diagnoses what the monitors find."""

    @property
    def monitors(self) -> str:
        """State which monitors these are: what was known of others says nothing about them.

        What the diagnosis knows of faults is part of the configuration.
        """
        monitors = f"{self.plan.config_hash} {__version__}"
        return monitors if self.diagnoser is None else f"{monitors} diagnosed"


class Watcher:
    """Watches one store; ``step`` does what there is to do now, ``run`` until told to stop.

    ``tell`` hears of everything that is written down.
    """

    def __init__(self, watch: Watch, tell: Tell | None = None) -> None:
        self._watch = watch
        self._tell = tell or _tell_nobody
        self._lock = WriterLock(watch.store, WATCH)
        self._diagnoser = None if watch.diagnoser is None else Surviving(watch.diagnoser)
        self._engine = Diagnosing(Engine(watch.plan), self._diagnoser)
        self._standing = Standing(standing_in(watch.store), self._engine)
        self._journal = Journal(
            watch.store, watch.plan.robot, watch.plan.config_hash, watch.clock, self._standing.again
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
        self._evaluation = Evaluation(self._engine, memory)
        probes = [order.item for order in own_probes(watch)]
        self._reader = Reader(watch.store, self._engine.items, probes, self._start)
        self._silence = Silence(watch.clock_s)
        self._lateness = Lateness(watch.store, watch.clock)
        self._is_sound = True
        """Everything that was evaluated is written down."""
        self._silent: list[Status] = []
        self._noted_s = self._asked_s = watch.clock_s()
        self._measured: list[tuple[ProbeOrder, Mapping[str, Any]]] = []
        self._measured_lock = threading.Lock()
        options = () if watch.folder is None else watch.folder.robot.monitoring.publish
        self._publisher = Publisher(options, watch.plan, watch.clock_s)
        self._notifier = Notifier(monotonic=watch.clock_s)
        self._stop = threading.Event()
        if memory.place is not None:
            self._journal.passed(memory.place)

    def run(self, stop: threading.Event) -> None:
        """Watch until told to stop; probes run meanwhile."""
        self._stop = stop
        runner = self._probes()
        self._publisher.open()
        if self._watch.folder is not None:
            write_watched(self._watch.store, self._watch.folder)
        self._lateness.start()
        try:
            if runner is not None:
                runner.start()
            with guarded(self._watch.plan):
                while not stop.is_set():
                    self.step()
                    self._notifier.ready()
                    self._notifier.alive(self._told)
                    stop.wait(POLL_S)
        finally:
            self._notifier.stopping()
            self._lateness.close()
            if runner is not None:
                runner.close()
            self.close()

    def step(self) -> None:
        """Write what was measured, read on, evaluate, write what was found.

        Raises OSError when the disk does not take it; the next watcher goes on before that.
        """
        self._is_sound = False
        self._lateness.began()
        self._silence.looked()
        self._write_measured()
        for block in self._reader.step():
            self._silence.heard()
            self._notifier.alive(self._told)
            for found in self._evaluation.take(block):
                self._write(found)
            if self._stop.is_set():  # amid much that is behind: the next one goes on from here
                return
        self._settle()
        self._tell_lateness(self._lateness.ended())
        self._carry_out_requests()
        self._say_silence()
        if self._publisher.is_due():
            self._publisher.publish(self._known_now())
        self._is_sound = True

    def close(self) -> None:
        """Write down all that is needed to go on, and give the store free."""
        place = self._evaluation.place
        try:
            if place is not None and self._is_sound and not self._evaluation.is_behind:
                self._journal.found([], [self._checkpoint(place)])
            self._journal.close()
        finally:
            self._publisher.close()
            self._lock.release()

    def measured(self, order: ProbeOrder, values: Mapping[str, Any]) -> None:
        """Take a row of a probe; from any thread."""
        with self._measured_lock:
            self._measured.append((order, values))

    def _write_measured(self) -> None:
        """Write what probes have measured, each row after all that is evaluated."""
        with self._measured_lock:
            taken, self._measured = self._measured, []
        if taken and self._journal.is_live:
            self._journal.measured([
                Row(f"{SOURCE}/{order.topic}", order.item, SOURCE, values)
                for order, values in taken
            ])  # fmt: skip

    def _write(self, found: Sequence[Finding]) -> None:
        """Write what was found up to a place beside a note of the place."""
        self._settle(found)
        place = self._evaluation.place
        assert place is not None
        self._journal.passed(place)
        if self._is_new:
            self._journal.found([], [self._first(place)])
            self._is_new = False
        if self._evaluation.trouble:
            text = f"begins anew, what was remembered is of no use: {self._evaluation.trouble}"
            self._journal.told("watch_anew", text)
            self._evaluation.trouble = ""
        if self._diagnoser is not None and self._diagnoser.trouble:
            text = f"goes on without diagnosis, which has failed: {self._diagnoser.trouble}"
            self._journal.told("diagnosis_failed", text)
            self._diagnoser.trouble = ""
        notes = [place.note(self._watch.store.id)]
        if self._watch.clock_s() - self._noted_s >= CHECKPOINT_S:
            notes.append(self._checkpoint(place))
        self._journal.found(found, notes)
        self._silent = []
        self._tell(found)

    def _settle(self, found: Sequence[Finding] = ()) -> None:
        """Once all that was written before is found again: say what new monitors change in it.

        ``found`` is written right after it.
        """
        place = self._evaluation.place
        if place is None or self._standing.settled or not self._evaluation.has_caught_up:
            return
        self._journal.passed(place)
        changes = self._standing.settle(found, place.until_ns, anew=self._evaluation.anew)
        if changes:
            self._journal.found(changes, ())
            self._tell(changes)

    def _tell_lateness(self, late_s: float | None) -> None:
        """Write that monitoring has become overloaded, or is no more."""
        if late_s is None or self._evaluation.place is None:
            return
        if late_s:
            text = f"monitoring overloaded: what was recorded was evaluated {late_s:.1f} s late"
            self._journal.told("monitoring_overloaded", text)
        else:
            self._journal.told("monitoring_recovered", "monitoring is up to date again")

    def _known_now(self) -> Sequence[Status]:
        """Return the statuses as of now: old ones, while it catches up, are not how things are."""
        if self._silent:
            return self._silent
        statuses, now_ns = self._engine.statuses(), self._journal.now_ns()
        place = self._evaluation.place
        if place is None or self._evaluation.is_behind or not self._journal.is_live:
            return list(unknown(statuses, now_ns, 0.0, "not evaluated yet"))
        late_s = (now_ns - place.until_ns) / NS
        if late_s < CURRENT_S:
            return statuses
        reason = f"evaluated up to {late_s:.0f} s ago only"
        return list(unknown(statuses, now_ns, late_s, reason))

    def _told(self) -> str:
        """Say in one line what is being watched, for whoever looks after this process."""
        behind = "; catching up with the record" if self._evaluation.is_behind else ""
        if self._lateness.is_overloaded:
            behind += f"; overloaded, {self._lateness.delay_s():.0f} s late"
        return f"{len(self._watch.plan.components)} components{behind}"

    def _first(self, place: Place) -> Progress:
        """Say where the reading began: whoever is killed before the next note begins there."""
        about, store_id = self._watch.monitors, self._watch.store.id
        return Checkpoint(place.before(), self._start, 0.0, {}, about).note(store_id)

    def _checkpoint(self, place: Place) -> Progress:
        self._noted_s = self._watch.clock_s()
        ahead_s = max(self._reader.last_ns() - place.until_ns, 0) / NS
        return Checkpoint(
            place, self._reader.positions(), self._engine.history_s + ahead_s + _MARGIN_S,
            self._engine.snapshot(), self._watch.monitors,
        ).note(self._watch.store.id)  # fmt: skip

    def _carry_out_requests(self) -> None:
        """Do what people say of alarms, and remember it at once."""
        place, now_s = self._evaluation.place, self._watch.clock_s()
        if place is None or self._evaluation.is_behind or now_s - self._asked_s < _REQUESTS_S:
            return
        self._asked_s = now_s
        for request in commands.requests(self._watch.store):
            shift_ns = self._journal.now_ns() - self._watch.clock.wall_ns()
            self._carry_out(request, place, shift_ns)

    def _carry_out(self, request: Request, place: Place, shift_ns: int) -> None:
        """Do what a request says; what cannot be done is said in an event."""
        try:
            changes = commands.carry_out(request, self._engine.command, place.until_ns, shift_ns)
        except UsageError as error:  # healed meanwhile, or acknowledged twice
            self._journal.told("alarm_refused", f"request refused: {error.what}")
        except ValueError as error:
            name = commands.set_aside(request)
            self._journal.told("alarm_refused", f"request {name} cannot be read: {error}")
            return
        else:
            if changes:
                self._journal.found(changes, [self._checkpoint(place)])
                self._tell(changes)
        commands.done(request)

    def _say_silence(self) -> None:
        """Say of everything that it is unknown while the record does not go on."""
        silent_s = self._silence.due(is_recording=self._reader.is_recording)
        if silent_s:
            now_ns = self._journal.now_ns()
            self._silent = list(
                unknown(self._engine.statuses(), now_ns, silent_s, silent(silent_s))
            )
            self._journal.found(self._silent, ())
            self._tell(self._silent)

    def _probes(self) -> ProbeRunner | None:
        """Make what runs the probes, unless the recorder gets their rows from elsewhere."""
        orders, folder = own_probes(self._watch), self._watch.folder
        extra = () if folder is None else (folder.path / "probes",)
        return ProbeRunner(orders, self.measured, extra) if orders else None


def _memory_of(watch: Watch, history_s: float) -> Memory:
    """Recall what the last watcher left behind; if its monitors are not ours only alarms count."""
    memory = recall(watch.store)
    left = memory.checkpoint
    if left is not None and left.monitors != watch.monitors:
        memory.checkpoint = replace(left, lookback_s=history_s + FIRST_S)
        memory.more, memory.is_ours = 0, False
    return memory


def own_probes(watch: Watch) -> list[ProbeOrder]:
    """Return the probes that the watcher runs itself: none where a source block gives them."""
    blocks = () if watch.folder is None else watch.folder.blocks
    return [] if any(block.name == SOURCE for block in blocks) else watch.plan.probes()


def _tell_nobody(_: Sequence[Finding]) -> None:
    """Say nothing."""
