"""The process that supervises the unit tests of a robot.

``python -m amberbox.agent.unit_test_process`` reads its task from stdin, one line of JSON
(``RunTask``), then lines ``abort REASON``; the end of stdin aborts as well. It writes events to
stdout, one line of JSON each. The tests run in a pytest process below it
(``experiments.pytest_process``) that is killed with all that it has started when a test takes too
long, at the end, and on an abort; the other tests then go on in a fresh one.

Actions that tests ask for are not killed with the test but stopped safely. The robot's command
process carries them out where one runs, so that only one commands the robot; else, and in a test
that it runs itself, actors of this process do.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import TypeAlias

import msgspec

from amberbox.agent.actor import Task
from amberbox.agent.actor_supervisor import Outcome as ActionOutcome
from amberbox.agent.actor_supervisor import SupervisedActor
from amberbox.agent.command_socket import OrderOutcome, SiteOrder, orders_at
from amberbox.agent.process_tree import adopt_orphans, descendants, end_descendants
from amberbox.agent.unit_tests import (
    COLLECTION_S,
    Found,
    Over,
    Progress,
    Result,
    RunEvent,
    RunTask,
)
from amberbox.core.command import RISKS
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.files import wait_readable
from amberbox.core.safe_text import one_line
from amberbox.core.timestamps import format_time
from amberbox.experiments.action import load_action
from amberbox.experiments.pytest_process import MOST_PROCESSES
from amberbox.experiments.unit_test_messages import (
    LINE_BYTES,
    SOCKET_VARIABLE,
    Answer,
    AsksAction,
    AsksStatus,
    Begins,
    BeginsRecording,
    Collected,
    Collecting,
    Ends,
    EndsRecording,
    Finished,
    FromTests,
    Phase,
    Setup,
)
from amberbox.experiments.unit_tests import (
    MOST_RECORDINGS,
    OUTPUT_BYTES,
    TEXT,
    CollectionProblem,
    Measurement,
    Outcome,
    Recording,
    TestCollection,
    UnitTest,
    UnitTestResult,
    names_of,
)

MOST_BAD_FILES = 20
_PYTEST = (sys.executable, "-P", "-m", "amberbox.experiments.pytest_process")
_LOOK_S = 0.1
_COUNT_S = 0.2
_MOST_READ = 1 << 20
_MARGIN_S = 1.0  # kept beside a recorded window
_STOPPED_S = 60.0
_KILLED_S = 5.0
_WHO = 128

_Verdict: TypeAlias = tuple[Outcome, str]
_Question: TypeAlias = AsksAction | AsksStatus | BeginsRecording | EndsRecording


@dataclass
class _Open:
    """A test that runs."""

    test: UnitTest
    began_ns: int
    began_s: float
    window: tuple[str, int, float] | None = None
    recordings: list[Recording] = field(default_factory=list)


class _Pytest:
    """A pytest process: its messages, the end of what it prints."""

    def __init__(self, task: RunTask, ignored: Sequence[str]) -> None:
        ours, theirs = socket.socketpair()
        read, write = os.pipe()
        left_out = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "PYTEST_ADDOPTS")
        environment = {k: v for k, v in os.environ.items() if k not in left_out}
        environment |= {
            SOCKET_VARIABLE: str(theirs.fileno()), "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONUNBUFFERED": "1", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        }  # fmt: skip
        words = ("-k", task.keyword) if task.keyword else ()
        with theirs:
            self.process = subprocess.Popen(
                [*_PYTEST, str(os.getpid()), *words], cwd=task.folder, env=environment,
                pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=write, stderr=write,
                start_new_session=True,
            )  # fmt: skip
        os.close(write)
        self.socket, self._prints = ours, read
        self._watched = os.pidfd_open(self.process.pid)
        ours.setblocking(False)
        os.set_blocking(read, False)
        self._line = b""
        self._open = {ours.fileno(), read}
        self.tail = b""
        self.left_out = 0
        self._put(msgspec.json.encode(Setup(tuple(ignored), task.simulated)))

    def answer(self, answer: Answer) -> None:
        """Answer a question, unless the process is gone."""
        self._put(msgspec.json.encode(answer))

    def _put(self, data: bytes) -> None:
        # it waits for this line, so there is room for it; who does not read is killed in the end
        with suppress(OSError):
            self.socket.sendall(data + b"\n")

    def filenos(self) -> list[int]:
        """Return the file descriptors to wait for."""
        return [self._watched, *self._open]

    def is_gone(self) -> bool:
        """Return whether the process has ended."""
        return bool(wait_readable([self._watched], 0))

    def read(self) -> list[FromTests]:
        """Return its messages since the last call; raises ValueError for what is none."""
        data = self._read(self.socket.fileno())
        self.drain()
        *lines, self._line = (self._line + data).split(b"\n")
        if len(self._line) > LINE_BYTES:
            raise ValueError("a line without an end")
        return [msgspec.json.decode(line, type=FromTests) for line in lines]

    def has_more(self) -> bool:
        """Return whether there are bytes, or an end, to be read."""
        return self.socket.fileno() in self._open and bool(wait_readable([self.socket], 0))

    def drain(self) -> None:
        """Read what it has printed, at most a megabyte: then others have their turn."""
        whole = self.tail + self._read(self._prints)
        self.tail = whole[-OUTPUT_BYTES:]
        self.left_out += len(whole) - len(self.tail)

    def take_output(self) -> tuple[str, int]:
        """Return the end of what was printed since the last call, and how many bytes before."""
        self.drain()
        found = self.tail.decode(errors="replace"), self.left_out
        self.tail, self.left_out = b"", 0
        return found

    def _read(self, number: int) -> bytes:
        found = b""
        with suppress(BlockingIOError, ConnectionResetError):
            while number in self._open and len(found) < _MOST_READ:
                block = os.read(number, 1 << 16)
                found += block
                if not block:
                    self._open.discard(number)
        return found

    def end(self, spared: Sequence[int]) -> str:
        """Kill it and all that it has started, except actors; return how it had ended before."""
        is_gone = self.is_gone()
        with suppress(ProcessLookupError, PermissionError):
            # before it is reaped: until then its id belongs to nobody else
            os.killpg(self.process.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_KILLED_S)
        is_clean = end_descendants(spared)
        self.drain()
        self.socket.close()
        os.close(self._prints)
        os.close(self._watched)
        self._open.clear()
        if not is_clean:
            return "processes that it has started could not be killed"
        return _death(self.process.returncode) if is_gone else ""


def _death(status: int) -> str:
    if status >= 0:
        return f"its process ended with exit status {status}"
    with suppress(ValueError):
        return f"its process was killed ({signal.Signals(-status).name})"
    return f"its process was killed by signal {-status}"


class Supervisor:
    """Collects and runs the tests of one task; ``run`` returns at the end."""

    def __init__(self, task: RunTask, emit: Callable[[RunEvent], None], orders: int) -> None:
        self._task, self._emit, self._orders = task, emit, orders
        self._folder = Path(task.folder)
        self._read = b""
        self._abort = self._halt = ""
        self._tests: dict[str, UnitTest] | None = None
        self._bad: list[CollectionProblem] = []
        self._left: list[str] = []
        self._importing = ""
        self._open: _Open | None = None
        self._actor: SupervisedActor | SiteOrder | None = None
        self._deadline_s = self._count_s = 0.0
        self._finished = False

    def abort(self, reason: str) -> None:
        """End the run; the first reason counts."""
        self._abort = self._abort or one_line(reason)[:300] or "aborted"

    def run(self) -> None:
        """Collect and run; tests that were left when the run was aborted are skipped."""
        while not self._abort and (self._tests is None or self._left):
            before = list(self._left)
            end = self._run_process()
            if self._tests is not None and before and self._left == before and not self._abort:
                self._settle_unrun(self._left.pop(0), "killed", end or "pytest did not run it")
        for node in self._left:
            self._settle_unrun(node, "skipped", f"not run: {self._abort}")
        self._emit(Over(self._abort))

    def _run_process(self) -> str:
        """Run one pytest process until it ends or has to be killed; return why it has ended."""
        self._finished, self._importing = False, ""
        self._deadline_s = time.monotonic() + COLLECTION_S
        child = _Pytest(self._task, [problem.file for problem in self._bad])
        verdict: _Verdict | None = None
        # it says why it cannot collect only behind its end
        while (
            verdict is None
            and not (self._finished and self._tests is not None)
            and not child.is_gone()
        ):
            verdict = self._turn(child)
        while verdict is None and child.is_gone() and child.has_more():
            verdict = self._handle(child)
        died = child.end(self._spared())
        self._stop_actor(verdict[1] if verdict else died)
        outcome, why = verdict or ("killed", died)
        if self._tests is None:
            self._judge_collection(why, child.tail.decode(errors="replace"))
        elif self._open is not None:
            self._close(child, outcome, why)
        return why

    def _turn(self, child: _Pytest) -> _Verdict | None:
        """Wait for something to do and do it; return how the open test ends if it has to."""
        actor = self._actor
        watched = [self._orders, *child.filenos(), *(actor.filenos() if actor else ())]
        wait_readable(watched, _LOOK_S)
        self._read_orders()
        if self._abort:
            return "killed", self._abort
        self._step_actor(child)
        verdict = self._handle(child)
        now_s = time.monotonic()
        if verdict is None and now_s > self._deadline_s:
            limit_s = self._open.test.timeout_s if self._open else COLLECTION_S
            return "timeout", f"not done within {limit_s:g} s"
        if verdict is None and now_s > self._count_s:
            self._count_s = now_s + _COUNT_S
            count = len(descendants(self._spared()))
            if count > MOST_PROCESSES:
                return "killed", f"it had more than {MOST_PROCESSES} processes"
        return verdict

    def _read_orders(self) -> None:
        if self._orders not in wait_readable([self._orders], 0):
            return
        block = os.read(self._orders, 1 << 16)
        *lines, self._read = (self._read + block).split(b"\n")
        for line in lines:
            word, _, reason = line.decode(errors="replace").partition(" ")
            if word == "abort":
                self.abort(reason)
        if not block:
            self.abort("who has started it is gone")

    # -- what the tests report and ask

    def _handle(self, child: _Pytest) -> _Verdict | None:
        """Read its messages; return how the open test ends if its process has to be killed.

        Of a process without end, only a megabyte at once: time goes on for it.
        """
        try:
            for message in child.read():
                verdict = self._take(child, message)
                if verdict is not None:
                    return verdict
        except ValueError as error:  # msgspec's as well
            return "killed", f"its process wrote what is no report: {error}"[:TEXT]
        return None

    def _take(self, child: _Pytest, message: FromTests) -> _Verdict | None:
        if isinstance(message, Collecting):
            self._importing = message.file
        elif isinstance(message, Collected):
            child.answer(Answer(data=self._collected(message)))
            self._deadline_s = time.monotonic() + COLLECTION_S
        elif isinstance(message, Begins):
            if self._halt:
                self.abort(self._halt)
                return "killed", self._halt
            self._begin(child, message.node)
            child.answer(Answer())
        elif isinstance(message, Finished):
            self._finished = True
        elif self._open is None:
            raise ValueError("it reports a test that does not run")
        elif isinstance(message, Phase):
            self._emit(Progress(self._open.test.name, message.phase))
        elif isinstance(message, Ends):
            self._close(child, message.outcome, message.message, message)
            self._deadline_s = time.monotonic() + COLLECTION_S
            child.answer(Answer())
        else:
            answer = self._answer(self._open, message)
            if answer is not None:
                child.answer(answer)
        return None

    def _collected(self, found: Collected) -> list[str]:
        """Note what was found, the first time; return the nodes to run."""
        if self._tests is None:
            names = names_of([test.node for test in found.tests])
            tests = [
                msgspec.structs.replace(test, name=name)
                for test, name in zip(found.tests, names, strict=True)
            ]
            self._note_found(tests, found.problems)
        return self._left

    def _note_found(self, tests: Sequence[UnitTest], problems: Sequence[CollectionProblem]) -> None:
        self._tests = {test.node: test for test in tests}
        names = self._task.names
        chosen = [t for t in tests if self._task.run and (names is None or t.name in names)]
        self._left = [test.node for test in chosen]
        collection = TestCollection(tuple(tests), (*self._bad, *problems))
        self._emit(Found(collection, tuple(test.name for test in chosen)))

    def _judge_collection(self, why: str, printed: str) -> None:
        """Leave out the file whose import has ended the process; else nothing can be collected."""
        if self._abort:
            return
        if self._importing and not self._finished and len(self._bad) < MOST_BAD_FILES:
            what = f"its import has ended the collection of tests: {why}"
            self._bad.append(CollectionProblem(self._importing, 1, what))
            return
        lines = [line.strip() for line in printed.splitlines() if line.strip()]
        marked = [line.removeprefix("E").strip() for line in lines if line.startswith("E ")]
        said = (marked or lines or [why])[-1].removeprefix("ERROR: ")
        self._note_found([], [CollectionProblem("", 1, f"pytest cannot collect: {said}"[:TEXT])])

    def _begin(self, child: _Pytest, node: str) -> None:
        test = (self._tests or {}).get(node)
        if test is None or node not in self._left:
            raise ValueError(f"it runs {one_line(node)[:100]}, which was not asked for")
        child.take_output()
        self._open = _Open(test, time.time_ns(), time.monotonic())
        self._deadline_s = time.monotonic() + test.timeout_s
        self._emit(Progress(test.name, "setup"))

    def _close(
        self, child: _Pytest, outcome: Outcome, message: str, end: Ends | None = None
    ) -> None:
        """Emit the result of the open test."""
        test, self._open = self._open, None
        assert test is not None, "closed once"
        if test.window is not None:
            answer = self._end_recording(test)
            message = "; ".join(filter(None, (message, answer.error)))
        output, left_out = child.take_output()
        measured: Sequence[Measurement] = end.measurements if end else ()
        self._left.remove(test.test.node)
        self._emit(Result(UnitTestResult(
            name=test.test.name, outcome=outcome, began=format_time(test.began_ns),
            ended=format_time(time.time_ns()),
            duration_s=round(time.monotonic() - test.began_s, 3),
            message=message[:TEXT], details=end.details if end else "", output=output,
            left_out_bytes=left_out, measurements=tuple(measured),
            recordings=tuple(test.recordings), about=test.test.about,
        )))  # fmt: skip

    def _settle_unrun(self, node: str, outcome: Outcome, message: str) -> None:
        assert self._tests is not None, "tests are left only once they are known"
        test, now = self._tests[node], format_time(time.time_ns())
        self._emit(Result(UnitTestResult(test.name, outcome, now, now, 0.0, message[:TEXT],
                                         about=test.about)))  # fmt: skip

    def _answer(self, test: _Open, message: _Question) -> Answer | None:
        """Answer a question; None if the answer comes later."""
        try:
            if isinstance(message, AsksAction):
                self._begin_action(test, message)
                return None
            if isinstance(message, AsksStatus):
                return Answer(data=self._status(message.component))
            if isinstance(message, BeginsRecording):
                return self._begin_recording(test, message.reason)
            return self._end_recording(test)
        except AmberboxError as error:
            return Answer(error.what, error.hint)
        except OSError as error:
            return Answer(f"it could not be started: {error.strerror}")

    def _begin_action(self, test: _Open, asked: AsksAction) -> None:
        if self._actor is not None:
            raise UsageError("another action of this test runs")
        action = load_action(self._folder, asked.action)
        declared = test.test.risk
        if RISKS.index(action.options.risk) > RISKS.index(declared):
            risk = action.options.risk
            what = f"{action.name} is of the risk '{risk}', this test of '{declared}'"
            raise UsageError(what, f'mark the test with @pytest.mark.risk("{risk}")')
        if RISKS.index(action.options.risk) > RISKS.index(self._task.most_risk):
            what = f"{action.name} is of the risk '{action.options.risk}'"
            raise UsageError(f"{what}, this run was only granted '{self._task.most_risk}'")
        name = test.test.name

        def report(text: str) -> None:
            self._emit(Progress(name, f"{action.name}: {text}"))

        self._emit(Progress(name, action.name))
        is_local = self._task.simulated or self._task.is_commanded
        store = None if is_local else orders_at(self._folder)
        if store is not None:
            who = f"unit test {name}"[:_WHO]
            self._actor = SiteOrder(
                store, action.name, asked.parameters, who=who, confirmed=True, report=report
            )
            return
        task = Task(
            str(self._folder), action.name, asked.parameters, simulated=self._task.simulated
        )
        self._actor = SupervisedActor(task, report)

    def _spared(self) -> Sequence[int]:
        """Return the processes that are not killed with the tests."""
        return [self._actor.pid] if isinstance(self._actor, SupervisedActor) else []

    def _step_actor(self, child: _Pytest) -> None:
        """Renew the lease of the action, and answer with its outcome."""
        outcome = self._look_at_actor(0.0, renew=True)
        if outcome is not None:
            result = json.loads(outcome.result) if outcome.result else {}
            data = {"state": outcome.state, "reason": outcome.reason, "hint": outcome.hint}
            child.answer(Answer(data={**data, "result": result}))

    def _look_at_actor(
        self, seconds: float, *, renew: bool = False, abort: str = ""
    ) -> ActionOutcome | OrderOutcome | None:
        """Return the outcome of the action that runs, if there is one, after at most so long."""
        if self._actor is None:
            return None
        outcome: ActionOutcome | OrderOutcome | None
        try:
            if renew:
                self._actor.renew()
            if abort:
                self._actor.abort(abort)
            outcome = self._actor.wait(seconds)
        except AmberboxError as error:  # the command process has ended
            outcome = ActionOutcome("outcome_unknown", error.what, error.hint)
        if outcome is not None:
            if isinstance(self._actor, SiteOrder):
                self._actor.close()
            self._actor = None
            if outcome.state == "outcome_unknown":
                self._halt = f"the outcome of an action is unknown: {outcome.reason}"
        return outcome

    def _stop_actor(self, reason: str) -> None:
        """Stop what the tests have left running, and wait until it has stopped."""
        end_s = time.monotonic() + _STOPPED_S
        self._look_at_actor(0.0, abort=reason or "its test has ended")
        while self._actor is not None:
            self._look_at_actor(_LOOK_S)
            if self._actor is not None and time.monotonic() > end_s:
                self._actor = None
                self._halt = "an action did not stop"

    def _status(self, component: str) -> dict[str, object]:
        # these load numpy, which few tests need here
        from amberbox.blackbox.store.store import open_store, store_path
        from amberbox.monitoring.current_state import CurrentStateReader

        state = CurrentStateReader(open_store(store_path(self._folder))).read(time.time_ns())
        found = state.components.get(component)
        if found is None and not state.silence:
            what = f"nothing monitors '{component}'{did_you_mean(component, state.components)}"
            raise UsageError(what, "amberbox status FOLDER lists the components")
        if found is None:
            return {"component": component, "level": "unknown", "state": "unknown",
                    "reason": state.silence, "blocked_by": ()}  # fmt: skip
        return {"component": component, "level": found.level, "state": found.state,
                "reason": found.reason, "blocked_by": found.blocked_by}  # fmt: skip

    def _begin_recording(self, test: _Open, reason: str) -> Answer:
        if test.window is not None:
            raise UsageError("a recording of this test is open", "end it first: with recording():")
        if len(test.recordings) >= MOST_RECORDINGS:
            raise UsageError(f"a test has at most {MOST_RECORDINGS} recordings")
        test.window = (one_line(reason), time.time_ns(), time.monotonic())
        return Answer()

    def _end_recording(self, test: _Open) -> Answer:
        """Pin the window since its begin; also that of a test that was killed."""
        from amberbox.blackbox.retention.pins import mark

        if test.window is None:
            raise UsageError("no recording of this test is open")
        (reason, began_ns, began_s), test.window = test.window, None
        text = ": ".join(filter(None, (f"unit test {test.test.name}", reason)))
        try:
            made = mark(
                self._folder, before_s=time.monotonic() - began_s + _MARGIN_S,
                after_s=_MARGIN_S, reason=text, who="unit tests",
            )  # fmt: skip
        except AmberboxError as error:
            return Answer(f"the recording was not kept: {error.what}", error.hint)
        except OSError as error:
            return Answer(f"the recording was not kept: {error.strerror}")
        span = format_time(began_ns), format_time(time.time_ns())
        found = Recording(made.id, reason, *span)
        test.recordings.append(found)
        return Answer(data=msgspec.to_builtins(found))


def main() -> int:
    """Carry out the task on stdin."""
    line = FileIO(0, closefd=False).readline(LINE_BYTES)  # not a byte of the orders behind it
    task = msgspec.json.decode(line, type=RunTask)
    adopt_orphans()
    events = os.dup(1)
    os.dup2(2, 1)

    def emit(event: RunEvent) -> None:
        with suppress(BrokenPipeError):
            data = msgspec.json.encode(event) + b"\n"
            while data:
                data = data[os.write(events, data) :]

    supervisor = Supervisor(task, emit, 0)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: supervisor.abort("its process was terminated"))
    try:
        supervisor.run()
    except OSError as error:  # no room for one more process
        print(f"error: the unit tests cannot go on: {error.strerror}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
