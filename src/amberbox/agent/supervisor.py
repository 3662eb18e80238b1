"""The supervisor: starts the child processes, the recorder first, and restarts them.

Each child is started, watched, and restarted after a backoff, or left alone. The supervisor's
events are printed at once and written into the record by the keeper.
"""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from amberbox.agent.doctor.processes import SUPERVISOR_LOCK, SUPERVISOR_STATE_FILE
from amberbox.agent.folder_changes import (
    FolderVerdict,
    FolderWatch,
    read_server_key,
    recorder_config_hash,
)
from amberbox.agent.process import (
    ACT,
    DETECT,
    LINK,
    MIRROR,
    RECORD,
    REFUSED,
    WATCH,
    WRITER_OF,
    ChildProcess,
    Launch,
    Process,
    RealProcess,
    end_orphan,
    is_wanted,
)
from amberbox.blackbox.store import store
from amberbox.blackbox.store.store import EVENT_REQUEST, Store, WriterLock
from amberbox.core.child_process import ChildOutput, print_line
from amberbox.core.files import replace_file, wait_readable
from amberbox.core.pacing import Backoff
from amberbox.core.systemd import ALL_INPUTS_ENDED, Notifier

_MOST = 1000
_AGAIN_S = 5.0
_END_S = 2.0


class SupervisorLog:
    """Writes events and the state of the children into the store, in a separate thread.

    A slow or full disk blocks only this thread; failed writes are retried.
    """

    def __init__(self, store: Store, out: Callable[[str], None] = print_line) -> None:
        self._store, self._out = store, out
        self._events: deque[Mapping[str, Any]] = deque(maxlen=_MOST)
        self._state: str | None = None
        self._wake, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="notes", daemon=True)
        self._thread.start()

    def log_event(self, kind: str, text: str, **details: Any) -> None:
        """Print an event and queue it for the record."""
        self._out(f"{time.strftime('%H:%M:%S')} {kind}: {text}")
        self._events.append({"kind": kind, "text": text, "source": "run", "details": details})
        self._wake.set()

    def state(self, document: Mapping[str, Any]) -> None:
        """Queue the state of the children to be written."""
        self._state = json.dumps(document)
        self._wake.set()

    def close(self) -> None:
        """Write the remaining events, in bounded time."""
        self._stop.set()
        self._wake.set()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.wait()
            self._wake.clear()
            while not self._written() and not self._stop.wait(_AGAIN_S):
                pass
        self._written()

    def _written(self) -> bool:
        """Write everything queued; return False if the disk refuses it."""
        try:
            while self._events:
                store.submit(self._store, EVENT_REQUEST, self._events[0])
                self._events.popleft()
            state, self._state = self._state, None
            if state is not None:
                replace_file(self._store.path / SUPERVISOR_STATE_FILE, state)
        except OSError:
            return False
        return True


HEALTHY_S = 60.0  # after this time, the backoff starts again
RETRY_S = 60.0  # a refused configuration is retried after this time, changed or not

State = Literal["off", "waiting", "starting", "running", "stopping", "refused", "spent"]


class LogEvent(Protocol):
    """Logs an event of a child: prints it and writes it into the record."""

    def __call__(self, kind: str, text: str, **details: Any) -> None:
        """Log an event."""


@dataclass
class ChildLifecycle:
    """State machine of one child: start, watch, back off, stop. Times are monotonic seconds."""

    child: ChildProcess
    launch: Launch
    log_event: LogEvent
    backoff: Backoff = field(default_factory=Backoff)
    state: State = "off"
    status: str = ""  # as reported by the child
    trouble: str = ""
    """Why it was ended last, if not by a normal stop."""
    restarts: int = 0
    _process: Process | None = None
    _due_s: float = 0.0
    _deadline_s: float = math.inf
    _began_s: float = 0.0
    _why_killed: str = ""
    _restart: bool = False
    _refusal: str = ""

    @property
    def process(self) -> Process | None:
        """The running process, or None."""
        return self._process

    @property
    def is_up(self) -> bool:
        """Return whether it runs and is ready."""
        return self.state == "running"

    def want(self, now_s: float) -> None:
        """Start it if it does not run."""
        if self.state == "off":
            self.state, self._due_s = "waiting", now_s

    def stop(self, now_s: float, within_s: float, *, restart: bool = False) -> None:
        """Terminate it, and kill it after ``within_s`` seconds; with ``restart`` start it again."""
        self._restart = restart
        if self._process is None:
            self.state, self._due_s = ("waiting" if restart else "off"), now_s
        elif self.state == "stopping":
            self._deadline_s = min(self._deadline_s, now_s + within_s)
        else:
            self.state, self._deadline_s = "stopping", now_s + within_s
            self._process.send(signal.SIGTERM)

    def retry(self, now_s: float) -> None:
        """Retry a refused start now, since something has changed."""
        if self.state == "refused":
            self._due_s, self._refusal = now_s, ""

    def step(self, now_s: float) -> None:
        """Carry out the steps that are due."""
        if self._process is None:
            if self.state in ("waiting", "refused") and now_s >= self._due_s:
                self._start(now_s)
            return
        status = self._process.poll()
        self._listen(self._process, now_s)
        if status is not None:
            self._ended(status, now_s)
        elif now_s >= self._deadline_s:
            self._kill(now_s)

    def _start(self, now_s: float) -> None:
        self._began_s, self._why_killed, self.status = now_s, "", ""
        try:
            self._process = self.launch(self.child)
        except OSError as error:
            self._failed(f"cannot be started: {error.strerror or error}", now_s)
            return
        self.state, self._deadline_s = "starting", now_s + self.child.start_s

    def _listen(self, process: Process, now_s: float) -> None:
        """Read its watchdog messages; each moves the deadline."""
        for key, value in process.received():
            if key == "STATUS":
                self.status = value
            elif self.state == "stopping" or self._why_killed:
                continue
            elif key == "READY":
                self.state, self._deadline_s = "running", now_s + self.child.watchdog_s
                self._refusal = ""
            elif key == "EXTEND_TIMEOUT_USEC" and self.state == "starting" and value.isdecimal():
                self._deadline_s = max(self._deadline_s, now_s + int(value) / 1e6)
            elif key == "WATCHDOG":
                self._deadline_s = now_s + self.child.watchdog_s
            elif key == "STOPPING":  # it may take its time to stop, within bounds
                self._deadline_s = now_s + max(self.child.start_s, self.child.watchdog_s)

    def _kill(self, now_s: float) -> None:
        """Kill a child that hangs or does not end in time."""
        assert self._process is not None
        silent = now_s - self._began_s if self.state == "starting" else self.child.watchdog_s
        gave_none = "is not ready after" if self.state == "starting" else "gave no sign of life for"
        late = "did not end in time" if self.state == "stopping" else f"{gave_none} {silent:.0f} s"
        self._why_killed, self._deadline_s = f"{late} and was killed", math.inf
        self._process.send(signal.SIGKILL)

    def _ended(self, status: int, now_s: float) -> None:
        assert self._process is not None
        error = self._process.error()
        self._process.close()
        self._process, self._deadline_s = None, math.inf
        if self.state == "stopping":
            if self._why_killed:
                self.log_event("process_killed", f"{self.child.name} {self._why_killed}",
                          process=self.child.name)  # fmt: skip
            self.state, self._due_s = ("waiting" if self._restart else "off"), now_s
        elif status == REFUSED:
            self.state, self._due_s = "refused", now_s + RETRY_S
            self.trouble = error or "its configuration is wrong"
            if self.trouble != self._refusal:
                self._refusal = self.trouble
                text = f"{self.child.name} cannot run: {self.trouble}; it is tried again when the "
                text += f"folder changes, and every {RETRY_S:.0f} s"
                self.log_event("process_refused", text, process=self.child.name)
        elif status == 0 and self.status == ALL_INPUTS_ENDED:
            self.state = "spent"
        else:
            why = self._why_killed or exit_in_words(status)
            self._failed(f"{why}: {error}" if error else why, now_s, status=status)

    def _failed(self, why: str, now_s: float, **details: Any) -> None:
        if now_s - self._began_s >= HEALTHY_S:
            self.backoff.succeeded()
        wait_s = self.backoff.failed()
        self.state, self._due_s, self.trouble = "waiting", now_s + wait_s, why
        self.restarts += 1
        kind = "process_hung" if self._why_killed else "process_died"
        self.log_event(kind, f"{self.child.name} {why}; it starts again in {wait_s:.1f} s",
                  process=self.child.name, wait_s=round(wait_s, 3), **details)  # fmt: skip


def exit_in_words(status: int) -> str:
    """Describe an exit status, negative for a signal."""
    if status < 0:
        try:
            return f"was killed by {signal.Signals(-status).name}"
        except ValueError:
            return f"was killed by signal {-status}"
    return f"ended with status {status}" if status else "ended by itself"


_TICK_S = 0.2
_RESTART_S = 9.0  # limit for the end of a child that is restarted
_HURRY_S = 2.0
_PATIENCE_S = 5.0  # longest time that a child waits for the one it follows


@dataclass(frozen=True, slots=True)
class SupervisedBox:
    """The folder, the store and the children to supervise."""

    folder: Path
    store: Store
    config_hash: str
    children: Sequence[ChildProcess]


class ProcessSupervisor:
    """Runs the processes of one robot folder; ``turn`` carries out the steps that are due, ``run``
    loops until the end.

    Raises UsageError if another supervisor holds the store.
    """

    def __init__(
        self,
        box: SupervisedBox,
        *,
        launch: Launch | None = None,
        out: Callable[[str], None] = print_line,
        clock_s: Callable[[], float] = time.monotonic,
        notifier: Notifier | None = None,
    ) -> None:
        self._box, self._out, self._clock_s = box, out, clock_s
        self._lock = WriterLock(box.store, SUPERVISOR_LOCK)
        self._log = SupervisorLog(box.store, out)
        self._launch = launch or self._begin
        self._outputs = {child.name: ChildOutput(child.name, out) for child in box.children}
        self.lifecycles = [
            ChildLifecycle(child, self._launched, self._log.log_event) for child in box.children
        ]
        self._changes = FolderWatch(box.folder, box.store.path)
        self._config_hash = box.config_hash
        self._recorder_config = recorder_config_hash(box.folder)
        self._server_key = read_server_key(box.folder)
        self._wanted = self._wanted_children()
        self._notifier = notifier or Notifier()
        self._stops = 0
        self._reload = False
        self._is_reload_requested = False
        self._stopping_since_s: float | None = None
        self._is_hurried = False
        self._began_s = clock_s()
        self._last_state: Any = None

    def stop(self) -> None:
        """Begin to stop; a second call hurries. For any thread and signal handlers."""
        self._stops += 1

    def reload(self) -> None:
        """Apply the present configuration of the folder, also to the recorder."""
        self._reload = True

    @property
    def is_over(self) -> bool:
        """Return whether it was stopped and every child has ended."""
        ended = all(lifecycle.state in ("off", "spent") for lifecycle in self.lifecycles)
        return self._stopping_since_s is not None and ended

    def run(self) -> None:
        """Supervise until stopped, or until the recorder has nothing left to record."""
        try:
            while not self.is_over:
                self.turn()
                self._wait()
        finally:
            self.close()

    def turn(self) -> None:
        """Carry out the steps that are due."""
        now_s = self._clock_s()
        if self._stops and self._stopping_since_s is None:
            self._stopping_since_s = now_s
            self._notifier.stopping("ending what runs")
        self._is_hurried = self._stops > 1
        if self._reload:
            self._reload, self._is_reload_requested = False, True
            self._changes.ask()
        for lifecycle in self.lifecycles:
            lifecycle.step(now_s)
        if self._stopping_since_s is None:
            self._run_wanted(now_s)
        else:
            self._end(self._stopping_since_s, now_s)
        self._report()

    def close(self) -> None:
        """Write the remaining events, and release the store."""
        self._changes.close()
        self._log.close()
        self._lock.release()

    def _wait(self) -> None:
        """Wait until a child becomes active, at most for a moment."""
        busy = [
            lifecycle.process.filenos()
            for lifecycle in self.lifecycles
            if lifecycle.process is not None
        ]
        wait_readable([fd for fds in busy for fd in fds], _TICK_S)

    # -- starting

    def _launched(self, child: ChildProcess) -> Process:
        """Start a child; end the one that an earlier supervisor left running."""
        writer = WRITER_OF.get(child.name)
        pid = end_orphan(self._box.store, writer) if writer else None
        if pid:
            text = f"{child.name} (process {pid}) had outlived its supervisor and begins anew"
            self._log.log_event("process_taken_over", text)
        if child.name == RECORD:
            self._recorder_config = recorder_config_hash(self._box.folder)
        return self._launch(child)

    def _begin(self, child: ChildProcess) -> Process:
        return RealProcess(child, self._box.store.id, self._outputs[child.name])

    def _run_wanted(self, now_s: float) -> None:
        """Start the wanted children, each after the one it follows; check a changed folder."""
        for lifecycle in self.lifecycles:
            if lifecycle.child.name in self._wanted and self._may_start(lifecycle, now_s):
                lifecycle.want(now_s)
        judgement = self._changes.step(now_s)
        if judgement is not None:
            self._apply_verdict(judgement, now_s)
        if any(lifecycle.state == "spent" for lifecycle in self.lifecycles):
            self._out("all inputs have ended")
            self.stop()

    def _may_start(self, lifecycle: ChildLifecycle, now_s: float) -> bool:
        before = [other for other in self.lifecycles if other.child.name == lifecycle.child.follows]
        return now_s - self._began_s >= _PATIENCE_S or all(other.is_up for other in before)

    # -- the configuration

    def _wanted_children(self) -> frozenset[str]:
        folder = self._box.folder
        return frozenset(child.name for child in self._box.children if is_wanted(child, folder))

    def _apply_verdict(self, judgement: FolderVerdict, now_s: float) -> None:
        """Apply the result of checking a changed folder."""
        is_reload_requested, self._is_reload_requested = self._is_reload_requested, False
        for lifecycle in self.lifecycles:
            lifecycle.retry(now_s)
        if not judgement.is_right:
            text = f"{judgement.trouble}; what runs goes on as it is"
            self._log.log_event("configuration_refused", text)
        elif judgement.store and Path(judgement.store).resolve() != self._box.store.path.resolve():
            text = f"the record is to lie in {judgement.store} now: stop and start for that"
            self._log.log_event("configuration_refused", text)
        else:
            self._adopt(judgement.config_hash, now_s, with_recorder=is_reload_requested)

    def _adopt(self, config_hash: str, now_s: float, *, with_recorder: bool) -> None:
        """Restart the children whose configuration changed; the recorder only on a reload."""
        recorder_config_changed = recorder_config_hash(self._box.folder) != self._recorder_config
        if recorder_config_changed and with_recorder:
            self._restart(RECORD, now_s)
        linked, self._server_key = self._server_key, read_server_key(self._box.folder)
        if config_hash == self._config_hash:
            if linked != self._server_key:
                self._wanted = self._wanted_children()
                self._restart(LINK, now_s)
            if with_recorder and not recorder_config_changed:
                self._out("nothing has changed in the folder")
            return
        self._config_hash = config_hash
        text = "the folder has changed"
        if recorder_config_changed and not with_recorder:
            text += "; the recorder goes on as it began, until a reload or a restart"
        self._log.log_event("configuration_changed", text)
        self._wanted = self._wanted_children()
        for name in (WATCH, LINK, ACT, MIRROR, DETECT):
            self._restart(name, now_s)

    def _restart(self, name: str, now_s: float) -> None:
        for lifecycle in self.lifecycles:
            if lifecycle.child.name == name and lifecycle.state != "off":
                lifecycle.stop(now_s, _RESTART_S, restart=name in self._wanted)

    # -- stopping

    def _end(self, since_s: float, now_s: float) -> None:
        """Stop one stage after the other, or all at once when hurried."""
        stages = [
            lifecycle.child.stage for lifecycle in self.lifecycles if lifecycle.process is not None
        ]
        for lifecycle in self.lifecycles:
            is_due = (
                self._is_hurried
                or lifecycle.process is None
                or lifecycle.child.stage == min(stages)
            )
            if is_due and lifecycle.state not in ("off", "spent"):
                left_s = since_s + lifecycle.child.end_s - now_s
                lifecycle.stop(
                    now_s, max(0.0, min(left_s, _HURRY_S) if self._is_hurried else left_s)
                )

    # -- reporting

    def _report(self) -> None:
        """Report the state of the children to the service manager and into the store."""
        if any(lifecycle.is_up for lifecycle in self.lifecycles if lifecycle.child.name == RECORD):
            self._notifier.ready()
        self._notifier.alive(lambda: "; ".join(self._lines()))
        children = {
            lifecycle.child.name: {
                "state": lifecycle.state,
                "pid": lifecycle.process.pid if lifecycle.process else None,
                "restarts": lifecycle.restarts, "trouble": lifecycle.trouble,
            }
            for lifecycle in self.lifecycles
        }  # fmt: skip
        if children != self._last_state:
            self._last_state = children
            self._log.state({"pid": os.getpid(), "children": children})

    def _lines(self) -> Iterator[str]:
        for lifecycle in self.lifecycles:
            if lifecycle.child.name in self._wanted:
                doing = (
                    lifecycle.status if lifecycle.is_up and lifecycle.status else lifecycle.state
                )
                yield f"{lifecycle.child.name}: {doing}"
