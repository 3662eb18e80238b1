"""The supervisor: runs the processes of the box, the recorder first, until it is told to stop."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.blackbox.doctor.supervised import LOCK
from amberbox.blackbox.service import Notifier
from amberbox.blackbox.store import Store, WriterLock
from amberbox.robot.supervisor.changes import Changes
from amberbox.robot.supervisor.child import LINK, RECORD, WATCH, Child, is_wanted
from amberbox.robot.supervisor.footprint import linked_by, recorded_by
from amberbox.robot.supervisor.judgement import Judgement
from amberbox.robot.supervisor.life import Life
from amberbox.robot.supervisor.notes import Notes
from amberbox.robot.supervisor.orphans import WRITER_OF, end_orphan
from amberbox.robot.supervisor.output import Voice, say
from amberbox.robot.supervisor.process import Launch, Process, RealProcess

_TICK_S = 0.2
_RESTART_S = 9.0
"""How long a child may take to end that is to begin anew."""
_HURRY_S = 2.0
_PATIENCE_S = 5.0
"""What follows another child does not wait longer until that is ready."""


@dataclass(frozen=True, slots=True)
class Box:
    """What is supervised: a robot folder as it was read, its store, and what there is to run."""

    folder: Path
    store: Store
    config_hash: str
    children: Sequence[Child]


class Supervisor:
    """Runs the processes of one box; ``turn`` does what there is to do now, ``run`` until the end.

    Raises UsageError if another one has the store.
    """

    def __init__(
        self,
        box: Box,
        *,
        launch: Launch | None = None,
        out: Callable[[str], None] = say,
        clock_s: Callable[[], float] = time.monotonic,
        notifier: Notifier | None = None,
    ) -> None:
        self._box, self._out, self._clock_s = box, out, clock_s
        self._lock = WriterLock(box.store, LOCK)
        self._notes = Notes(box.store, out)
        self._launch = launch or self._begin
        self._voices = {child.name: Voice(child.name, out) for child in box.children}
        self.lives = [Life(child, self._launched, self._notes.tell) for child in box.children]
        self._changes = Changes(box.folder, box.store.path)
        self._config_hash = box.config_hash
        self._recorded = recorded_by(box.folder)
        self._linked = linked_by(box.folder)
        self._wanted = self._wishes()
        self._notifier = notifier or Notifier()
        self._stops = 0
        self._reload = False
        self._is_asked = False
        self._stopping_since_s: float | None = None
        self._is_hurried = False
        self._began_s = clock_s()
        self._known: Any = None

    def stop(self) -> None:
        """Begin to stop; called again, hurry. From any thread and from signal handlers."""
        self._stops += 1

    def reload(self) -> None:
        """Take what the folder says now, for the recorder, too."""
        self._reload = True

    @property
    def is_over(self) -> bool:
        """Tell whether it was told to stop, and everything has ended."""
        ended = all(life.state in ("off", "spent") for life in self.lives)
        return self._stopping_since_s is not None and ended

    def run(self) -> None:
        """Supervise until told to stop, or until the recorder has nothing left to record."""
        try:
            while not self.is_over:
                self.turn()
                self._wait()
        finally:
            self.close()

    def turn(self) -> None:
        """Do what there is to do now."""
        now_s = self._clock_s()
        self._heed(now_s)
        for life in self.lives:
            life.step(now_s)
        if self._stopping_since_s is None:
            self._go_on(now_s)
        else:
            self._end(self._stopping_since_s, now_s)
        self._report()

    def close(self) -> None:
        """Write down what is left to say, give the store free."""
        self._changes.close()
        self._notes.close()
        self._lock.release()

    def _wait(self) -> None:
        """Wait until a child does something, for a moment at most."""
        busy = [life.process.filenos() for life in self.lives if life.process is not None]
        select.select([fd for fds in busy for fd in fds], [], [], _TICK_S)

    # -- starting

    def _launched(self, child: Child) -> Process:
        """Start a child; one that was left over from a supervisor before is ended for it."""
        writer = WRITER_OF.get(child.name)
        pid = end_orphan(self._box.store, writer) if writer else None
        if pid:
            text = f"{child.name} (process {pid}) had outlived its supervisor and begins anew"
            self._notes.tell("process_taken_over", text)
        if child.name == RECORD:
            self._recorded = recorded_by(self._box.folder)
        return self._launch(child)

    def _begin(self, child: Child) -> Process:
        return RealProcess(child, self._box.store.id, self._voices[child.name])

    def _go_on(self, now_s: float) -> None:
        """Let run what is wanted, each after what it follows; see what has changed."""
        for life in self.lives:
            if life.child.name in self._wanted and self._has_its_turn(life, now_s):
                life.want(now_s)
        judgement = self._changes.step(now_s)
        if judgement is not None:
            self._take(judgement, now_s)
        if any(life.state == "spent" for life in self.lives):
            self._out("all inputs have ended")
            self.stop()

    def _has_its_turn(self, life: Life, now_s: float) -> bool:
        before = [other for other in self.lives if other.child.name == life.child.follows]
        return now_s - self._began_s >= _PATIENCE_S or all(other.is_up for other in before)

    # -- what the folder says

    def _wishes(self) -> frozenset[str]:
        folder = self._box.folder
        return frozenset(child.name for child in self._box.children if is_wanted(child, folder))

    def _take(self, judgement: Judgement, now_s: float) -> None:
        """Do what follows from a judgement about the folder."""
        is_asked, self._is_asked = self._is_asked, False
        for life in self.lives:
            life.retry(now_s)
        if not judgement.is_right:
            text = f"{judgement.trouble}; what runs goes on as it is"
            self._notes.tell("configuration_refused", text)
        elif judgement.store and Path(judgement.store).resolve() != self._box.store.path.resolve():
            text = f"the record is to lie in {judgement.store} now: stop and start for that"
            self._notes.tell("configuration_refused", text)
        else:
            self._adopt(judgement.config_hash, now_s, with_recorder=is_asked)

    def _adopt(self, config_hash: str, now_s: float, *, with_recorder: bool) -> None:
        """Let begin anew what goes by something else now; the recorder only if that was asked."""
        is_recorded_anew = recorded_by(self._box.folder) != self._recorded
        if is_recorded_anew and with_recorder:
            self._again(RECORD, now_s)
        linked, self._linked = self._linked, linked_by(self._box.folder)
        if config_hash == self._config_hash:
            if linked != self._linked:
                self._wanted = self._wishes()
                self._again(LINK, now_s)
            if with_recorder and not is_recorded_anew:
                self._out("nothing has changed in the folder")
            return
        self._config_hash = config_hash
        later = "; the recorder goes on as it began, until a reload or a restart"
        text = f"the folder has changed{later if is_recorded_anew and not with_recorder else ''}"
        self._notes.tell("configuration_changed", text)
        self._wanted = self._wishes()
        self._again(WATCH, now_s)
        self._again(LINK, now_s)

    def _again(self, name: str, now_s: float) -> None:
        for life in self.lives:
            if life.child.name == name and life.state != "off":
                life.stop(now_s, _RESTART_S, again=name in self._wanted)

    # -- stopping

    def _heed(self, now_s: float) -> None:
        """Take what signals have asked for."""
        if self._stops and self._stopping_since_s is None:
            self._stopping_since_s = now_s
            self._notifier.stopping("ending what runs")
        self._is_hurried = self._stops > 1
        if self._reload:
            self._reload, self._is_asked = False, True
            self._changes.ask()

    def _end(self, since_s: float, now_s: float) -> None:
        """End one stage after the other, all at once if there is no time."""
        stages = [life.child.stage for life in self.lives if life.process is not None]
        for life in self.lives:
            is_due = self._is_hurried or life.process is None or life.child.stage == min(stages)
            if is_due and life.state not in ("off", "spent"):
                left_s = since_s + life.child.end_s - now_s
                life.stop(now_s, max(0.0, min(left_s, _HURRY_S) if self._is_hurried else left_s))

    # -- telling

    def _report(self) -> None:
        """Tell the service manager, and write down for others how the children are."""
        if any(life.is_up for life in self.lives if life.child.name == RECORD):
            self._notifier.ready()
        self._notifier.alive(lambda: "; ".join(self._lines()))
        children = {
            life.child.name: {
                "state": life.state, "pid": life.process.pid if life.process else None,
                "restarts": life.restarts, "trouble": life.trouble,
            }
            for life in self.lives
        }  # fmt: skip
        if children != self._known:
            self._known = children
            self._notes.state({"pid": os.getpid(), "children": children})

    def _lines(self) -> Iterator[str]:
        for life in self.lives:
            if life.child.name in self._wanted:
                doing = life.status if life.is_up and life.status else life.state
                yield f"{life.child.name}: {doing}"
