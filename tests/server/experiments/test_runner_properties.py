"""The runner over random orders and times: answers late and twice, cuts, restarts, clock steps.

The robot of these tests takes each command once, as the gate does, and knows what it has done: the
run has to come to what the same steps give in a run without any of this.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import patch

from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.command import (
    AnswerState,
    CommandAnswer,
    CommandSignature,
    LeaseState,
    decode_command,
)
from amberbox.experiments.run import ExperimentRun, RobotEnd
from amberbox.link import limits
from amberbox.link.frames import AbortFrame, Hello, LeaseFrame
from amberbox.server import commands, database
from amberbox.server.bus import EventBus
from amberbox.server.experiments import runs
from amberbox.server.experiments.runner import REQUIRE_S, SIGN_S, ExperimentRunner, _Look
from amberbox.server.experiments.runs import HOLDING, RunOrder, StoredRun
from amberbox.server.ingest import ledger
from amberbox.testing.clock import ManualClock
from tests.experiments.procedures import PASS_FAIL, S, catch, node, procedure, process

ROBOT, WHO, DAY_S = "r1", "anna", 86_400.0
CHALLENGE = bytes(range(32))
PROCEDURE = procedure(
    process(
        node("start", "start", "ask"),
        node("ask", "person", "safe"),
        node("safe", "exclusive", ("drive", "clear"), "unsafe"),
        node("unsafe", "end"),
        node("drive", "robot", "wait", boundaries=(catch("trouble", "", "recover"),)),
        node("wait", "timer", "dock", timer_ns=5 * S),
        node("dock", "robot", "end", boundaries=(catch("no_dock", "action_failed", "recover"),)),
        node("recover", "person", "bad"),
        node("bad", "error_end", code="test_failed"),
        node("end", "end"),
    ),
    forms={"ask": {"clear": PASS_FAIL}},
)  # fmt: skip
ANNOUNCED = json.dumps({"actions": [{"name": "drive", "risk": "moves"}]})


class _Live:
    def value(self, robot: str, address: str) -> None:
        return None


class _Feed:
    live = _Live()

    def statuses(self, robot: str) -> dict[Any, Any]:
        return {}

    def watch(self, variables: object) -> None:
        pass


@dataclass
class Robot:
    """Takes each command once; ``plan`` is how its actions end, in order."""

    plan: list[AnswerState]
    done: dict[str, AnswerState] = field(default_factory=dict)
    begun: Counter[str] = field(default_factory=Counter)
    running: list[str] = field(default_factory=list)
    answers: list[CommandAnswer] = field(default_factory=list)
    told: int = 0

    def take(self, ids: Sequence[str], boot_ns: int) -> None:
        for one in ids:
            if not self.begun[one]:
                self.begun[one] += 1
                self.running.append(one)
                self._say(one, "accepted", boot_ns)

    def finish(self, boot_ns: int) -> None:
        if self.running:
            state = self.plan.pop(0) if self.plan else "done"
            self._end(self.running[0], state, boot_ns)

    def abort(self, command: str, boot_ns: int) -> None:
        if command in self.running:
            self._end(command, "aborted", boot_ns)

    def _end(self, command: str, state: AnswerState, boot_ns: int) -> None:
        self.running.remove(command)
        self.done[command] = state
        self._say(command, state, boot_ns)

    def _say(self, command: str, state: AnswerState, boot_ns: int) -> None:
        number = len(self.answers) + 1
        answer = CommandAnswer(command, state, at_ns=1, boot="b", mono_ns=boot_ns, number=number)
        self.answers.append(answer)


class World:
    """A server's runner on a database on disk, a link that can be cut, and a robot."""

    def __init__(self, folder: Path, plan: list[AnswerState]) -> None:
        self.clock = ManualClock()
        self.database = database.ServerDatabase(folder / "server.db")
        self.robot = Robot(plan)
        self.epoch = 0
        self.robots: dict[str, object] = {}
        self.lease: LeaseState | None = None
        self.connect()
        with self.database.begin() as connection:
            commands.announce(connection, ROBOT, self.epoch, ANNOUNCED, 1)
            self.server_id = commands.server_id(connection, 1)
        self.runner = self.started()
        with self.database.begin() as connection:
            order = RunOrder(ROBOT, "experiment", "test", "Test", PROCEDURE.sha256, {}, WHO)
            self.id = runs.add(connection, self.clock.wall_ns(), order).id
            self.lease = LeaseState(7, WHO, self.id)
            self.runner.register.begin(connection, self.stored(connection), {}, WHO)

    def started(self) -> ExperimentRunner:
        """Return the runner of a server that has just started."""
        shelf = SimpleNamespace(procedure=lambda run: PROCEDURE)
        return ExperimentRunner(
            self.database, EventBus(), self.clock, cast(Any, self), cast(Any, _Feed()),
            cast(Any, shelf),
        )  # fmt: skip

    # -- what the runner sees of the link

    def contact(self, robot: str) -> object | None:
        return SimpleNamespace(lease=self.lease) if robot in self.robots else None

    async def order(self, robot: str, frame: AbortFrame | LeaseFrame) -> bool:
        if robot in self.robots and isinstance(frame, AbortFrame):
            self.robot.abort(frame.command, self.clock.boot_ns())
        return robot in self.robots

    # -- what happens

    def stored(self, connection: Any) -> StoredRun:
        found = runs.find(connection, self.id)
        assert found is not None
        return found

    def now(self) -> StoredRun:
        with self.database.reading() as connection:
            return self.stored(connection)

    def run(self) -> ExperimentRun:
        found = self.runner.register.read(self.now())
        assert found is not None
        return found

    def connect(self) -> None:
        hello = Hello(ROBOT, "s", "b", {}, "", 0, 0, "1", capabilities=[limits.COMMANDS])
        with self.database.begin() as connection:
            self.epoch = ledger.admit(connection, hello, self.clock.wall_ns()).epoch
            answered = commands.begin_contact(connection, ROBOT, self.epoch, "s").answered
        self.robot.told = answered
        self.robots[ROBOT] = object()

    def cut(self) -> None:
        self.robots.clear()

    def look(self) -> None:
        stored = self.now()
        if stored.state in HOLDING:
            self.runner.presence.note(self.id, "technician", WHO)
            asyncio.run(self.runner._look_and_act(stored, _Look()))

    def restart(self) -> None:
        self.runner = self.started()

    def sign(self) -> None:
        """Sign what waits, which a person can while the robot is there; it is sent at once."""
        if not self.robots:
            return
        with self.database.begin() as connection:
            wall_ns = self.clock.wall_ns()
            for line in commands.listed(connection, wall_ns, ROBOT, states=["unsigned"]):
                signature = CommandSignature("0" * 16, 7, CHALLENGE, 60, self.server_id)
                commands.sign(connection, wall_ns, line.id, signature, [CHALLENGE])
        self.take()

    def take(self) -> None:
        if self.robots:
            with self.database.begin() as connection:
                found = commands.claim(connection, ROBOT, self.epoch, self.clock.wall_ns())
            decoded = [decode_command(one) for one in found]
            moving = [one.id for one in decoded if one.risk == "moves"]
            self.robot.take(moving, self.clock.boot_ns())

    def deliver(self, *, again: bool = False) -> None:
        """Let answers arrive, or ``again`` all that were ever given."""
        answers = self.robot.answers if again else self.robot.answers[self.robot.told :]
        if answers and self.robots:
            with self.database.begin() as connection:
                stored = commands.store_answers(
                    connection, ROBOT, self.epoch, "s", answers, self.clock.wall_ns()
                )
            self.robot.told = max(self.robot.told, stored.number)

    def person(self, clear: bool) -> None:
        stored = self.now()
        waiting = self.run().person_tasks() if stored.state in HOLDING else []
        if waiting:
            task = waiting[0]
            values = {"clear": clear} if task.step.path == "ask" else {}
            self.runner.register.change(
                stored, lambda run, _, now_ns: run.complete(task.id, values, WHO, now_ns)
            )

    def abort(self) -> None:
        stored = self.now()
        if stored.state in HOLDING:
            self.runner.register.change(stored, lambda run, _, now: run.abort(WHO, "", now))

    def do(self, what: str, clear: bool) -> None:
        """Do one thing by its name."""
        acts: dict[str, Callable[[], object]] = {
            "look": self.look, "restart": self.restart, "sign": self.sign, "take": self.take,
            "deliver": self.deliver, "cut": self.cut, "connect": self.connect,
            "abort": self.abort, "again": lambda: self.deliver(again=True),
            "person": lambda: self.person(clear), "time": lambda: self.clock.advance(0.4),
            "finish": lambda: self.robot.finish(self.clock.boot_ns()),
            "tomorrow": lambda: self.clock.step(DAY_S),
            "yesterday": lambda: self.clock.step(-DAY_S),
        }  # fmt: skip
        acts[what]()

    def end(self, clear: bool) -> None:
        """Let everybody do their part until the run is over."""
        self.connect()
        for _ in range(60):
            if self.now().state not in HOLDING:
                return
            for what in ("look", "person", "sign", "take", "finish", "deliver", "time"):
                self.do(what, clear)
        raise AssertionError(f"the run does not end: {self.run().events}")


@contextmanager
def world(plan: list[AnswerState]) -> Iterator[World]:
    def without_waiting(connection: Any, record: object) -> None:
        """No power is cut here."""
        configure(connection, record)
        connection.execute("PRAGMA synchronous=OFF").close()

    configure = database._configure
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(database, "_configure", without_waiting),
    ):
        found = World(Path(folder), plan)
        try:
            yield found
        finally:
            found.database.close()


def pure(states: dict[str, RobotEnd], clear: bool, aborted: bool) -> str | None:
    """Return the outcome of the same steps, one after the other, without anything in between."""
    run, now_ns = ExperimentRun.begin(PROCEDURE, "r", ROBOT, {}, {}, 0), 0
    while run.outcome is None:
        now_ns += S
        run.tick(now_ns)
        for person in run.person_tasks():
            values = {"clear": clear} if person.step.path == "ask" else {}
            run.complete(person.id, values, "", now_ns)
        for task in run.robot_tasks():
            if task.id not in states and aborted:
                return "aborted"
            run.robot_started(task.id, "c", now_ns)
            run.robot_ended(task.id, states[task.id], now_ns)
    return run.outcome


ENDS: Sequence[AnswerState] = ("done", "done", "done", "failed", "refused", "outcome_unknown")
ACTS = st.sampled_from([
    *["look"] * 6, *["sign"] * 3, *["finish"] * 3, *["deliver"] * 3, "take", "person", "person",
    "time", "time", "restart", "cut", "connect", "again", "tomorrow", "yesterday",
])  # fmt: skip


@given(
    acts=st.lists(ACTS, max_size=40), plan=st.lists(st.sampled_from(ENDS), max_size=2),
    clear=st.sampled_from([True, True, True, False]), abort_at=st.none() | st.integers(0, 40),
)  # fmt: skip
@settings(max_examples=60)
def test_whatever_happens_nothing_is_done_twice_and_the_run_ends_as_it_should(
    acts: list[str], plan: list[AnswerState], clear: bool, abort_at: int | None
) -> None:
    with world(list(plan)) as found:
        is_aborted = False
        for number, what in enumerate(acts):
            if number == abort_at and found.run().outcome is None:
                found.abort()
                is_aborted = True
            found.do(what, clear)
        found.end(clear)
        run, robot = found.run(), found.robot
        assert all(count == 1 for count in robot.begun.values())
        tasks = [event.task for event in run.events if event.kind == "started"]
        assert len(tasks) == len(set(tasks))
        assert set(robot.begun) <= {runs.command_id(found.id, task) for task in tasks}
        assert not robot.running
        ended = {e.task: e.values["state"] for e in run.events if e.kind == "ended"}
        for task, state in ended.items():
            done = robot.done.get(runs.command_id(found.id, task))
            # what the robot never had is refused, withdrawn with an abort, or gone with its time
            assert state == (done or state) and (done or state != "done")
        expected = "aborted" if is_aborted else pure(ended, clear, is_aborted)
        assert (run.outcome, run.is_closed) == (expected, True)
        numbers = [event.number for event in run.events]
        assert numbers == list(range(1, len(numbers) + 1))
        times = [event.at_ns for event in run.events]
        assert times == sorted(times) and times[-1] - times[0] < DAY_S * NS / 2


def until_ready(found: World) -> None:
    found.person(True)
    found.look()


def test_a_motion_waits_for_somebody_who_is_there() -> None:
    with world([]) as found:
        found.person(True)
        with patch.object(found.runner.presence, "note"):
            found.look()
            assert "nobody is there" in found.runner.waits_for(found.id)
            found.clock.advance(REQUIRE_S + 1)
            found.look()
        assert [e.values for e in found.run().events if e.kind == "ended"] == [
            {"state": "requirement"}
        ]


def test_a_robot_that_another_run_holds_is_waited_for() -> None:
    with world([]) as found:
        ours, found.lease = found.lease, LeaseState(8, "ben", "other")
        until_ready(found)
        assert found.runner.waits_for(found.id) == "r1 is held by ben"
        found.lease = ours
        found.look()
        assert [task.action for task in found.run().running()] == ["drive"]


def test_a_command_that_nobody_signs_is_withdrawn_whatever_the_wall_clock_does() -> None:
    with world([]) as found:
        until_ready(found)
        found.clock.step(DAY_S)
        found.look()
        assert found.run().running()
        found.clock.advance(SIGN_S + 1)
        found.look()
        [ended] = [e for e in found.run().events if e.kind == "ended"]
        assert (ended.values["state"], ended.text) == (
            "refused",
            "nobody has signed it within 10 min",
        )
        found.sign()
        assert not found.robot.begun


def test_an_answer_that_is_late_by_the_wall_clock_counts() -> None:
    with world([]) as found:
        until_ready(found)
        found.sign()  # the robot has it, and its answers are on their way
        found.robot.finish(found.clock.boot_ns())
        found.clock.step(DAY_S)
        found.look()
        found.deliver()
        found.look()
        assert [e.values["state"] for e in found.run().events if e.kind == "ended"] == ["done"]


def test_an_action_that_takes_too_long_by_the_robots_clock_ends_with_a_timeout() -> None:
    with world([]) as found:
        step = PROCEDURE.steps["drive"]
        assert step.robot is not None
        object.__setattr__(step.robot, "timeout", 3.0)
        try:
            until_ready(found)
            found.sign()
            found.deliver()
            found.clock.step(DAY_S)
            found.look()
            assert not found.robot.done, "a step of the wall clock is no time that passes"
            found.clock.advance(4)
            found.look()
            found.deliver()
            found.look()
        finally:
            object.__setattr__(step.robot, "timeout", None)
        [ended] = [e for e in found.run().events if e.kind == "ended"]
        assert ended.values["state"] == "timeout"


def test_a_run_that_is_over_is_marked_once_and_its_record_asked_for() -> None:
    with world([]) as found:
        with found.database.begin() as connection:
            said = json.dumps(
                {**json.loads(ANNOUNCED), "record": ["incident.mark", "journal.rotate"]}
            )
            commands.announce(connection, ROBOT, found.epoch, said, 1)
        found.abort()
        found.abort()
        with found.database.reading() as connection:
            lines = commands.listed(connection, found.clock.wall_ns(), ROBOT)
        assert sorted(line.action for line in lines) == ["incident.mark", "journal.rotate"]
