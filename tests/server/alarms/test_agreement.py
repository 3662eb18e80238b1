"""A server and a robot agree on what people did with alarms, whatever order things come in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.command import CommandAnswer, decode_command
from amberbox.core.errors import UsageError
from amberbox.core.record_commands import RECORD_COMMANDS, decode_record_command
from amberbox.monitoring.alarms import Action, ComponentAlarms, PersonAction
from amberbox.monitoring.component_states import OwnState
from amberbox.monitoring.findings import AlarmChange
from amberbox.server import commands, record_orders
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.agreement import agree
from amberbox.server.alarms.alarm import Alarm, Step
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.schema import ALARM, COMMAND, HISTORY
from tests.server.alarms.stand import STORE, Stand, stand

BAD = OwnState("error", "working", "it does not work", "urgent")
SERVER = "bo"
ROBOT = "anna at the robot"
MONTH_S = 30 * 86_400


@dataclass
class Robot:
    """A robot's alarms, its record, and its link to the server; its clock is ``behind_s``."""

    server: Stand
    behind_s: int = 0
    alarms: ComponentAlarms = field(default_factory=lambda: ComponentAlarms("r1", "hash"))
    record: list[AlarmChange] = field(default_factory=list)
    sent: int = 0
    answers: list[CommandAnswer] = field(default_factory=list)
    done: dict[str, str] = field(default_factory=dict)
    online: bool = False

    def __post_init__(self) -> None:
        self.record += self.alarms.update("laser", self.now_ns(), BAD, ())

    def now_ns(self) -> int:
        return self.server.clock.wall_ns() - self.behind_s * NS

    @property
    def state(self) -> AlarmChange:
        (found,) = self.alarms.active()
        return found

    def do(self, action: Action, who: str = "anna", for_s: float = 0.0, command: str = "") -> None:
        """Do something with the alarm, as the watcher does on request."""
        until_ns = self.now_ns() + round(for_s * NS) if action == "shelve" else None
        asked = PersonAction(action, who, self.now_ns(), until_ns, "a note", command)
        with suppress(UsageError):  # the watcher refuses it, with an event
            self.record += self.alarms.command(self.state.id, asked)

    def passes(self) -> None:
        """Let time pass: a shelf may be over."""
        self.record += self.alarms.due(self.now_ns())[1]

    def restart(self) -> None:
        """Begin anew from a checkpoint; a new file begins with the lasting alarms."""
        kept = msgspec.json.decode(msgspec.json.encode(self.alarms.snapshot(self.now_ns())))
        self.alarms = ComponentAlarms("r1", "hash")
        self.alarms.resume(kept)
        self.record += self.alarms.active()

    def connect(self) -> None:
        self.online = True
        self.server.connect("r1", behind_s=self.behind_s)
        names = msgspec.json.encode({"record": sorted(RECORD_COMMANDS)}).decode()
        with self.server.database.begin() as connection:
            epoch, now_ns = self.server.epochs["r1"], self.server.clock.wall_ns()
            commands.begin_contact(connection, "r1", epoch, STORE)
            commands.announce(connection, "r1", epoch, names, now_ns)

    def send_rows(self, most: int = 1_000) -> None:
        """Send what is in the record; the server takes it."""
        new = self.record[self.sent : self.sent + most]
        self.sent += len(new)
        self.server.send("r1", self.server.rows("r1", new, self.now_ns()))
        self.server.alarms.step()

    def receive(self, *, is_lost: bool = False, is_twice: bool = False) -> None:
        """Receive what the server sends; with ``is_lost`` the connection breaks before it comes."""
        epoch, now_ns = self.server.epochs["r1"], self.server.clock.wall_ns()
        with self.server.database.begin() as connection:
            raw = commands.claim(connection, "r1", epoch, now_ns)
        for data in [] if is_lost else [*raw, *(raw if is_twice else [])]:
            self._carry_out(data)

    def _carry_out(self, data: bytes) -> None:
        command = decode_command(data)
        if command.id in self.done:  # as the gate does: at most once
            self.answers.append(self._answer(command.id, self.done[command.id]))
            return
        asked: Any = decode_record_command(command.action, command.parameters)
        state = "done"
        if asked.alarm != self.state.id:
            state = "refused"
        else:
            action: Any = command.action.partition(".")[2]
            self.do(action, asked.who, getattr(asked, "for_s", 0.0), command.id)
        self.done[command.id] = state
        self.answers.append(self._answer(command.id, state))

    def _answer(self, command_id: str, state: Any) -> CommandAnswer:
        number = len(self.done) + len(self.answers)
        return CommandAnswer(command_id, state, number=number)

    def answer(self) -> None:
        """Send all answers again."""
        epoch, now_ns = self.server.epochs["r1"], self.server.clock.wall_ns()
        with self.server.database.begin() as connection:
            commands.store_answers(connection, "r1", epoch, STORE, self.answers, now_ns)


def person(server: Stand, step: Callable[[Alarm, str, int], Step]) -> None:
    """Do something with the alarm on the server, as its API does."""
    with server.database.begin() as connection, suppress(lifecycle.AlarmStateError):
        register, now_ns = AlarmRegister(connection), server.clock.wall_ns()
        (alarm,) = register.alarms(ALARM.c.kind == "robot")
        register.keep(alarm, step(alarm, SERVER, now_ns))
        agree(register, alarm.number, now_ns)


def on_server(server: Stand, what: str, for_s: float = 3600.0) -> None:
    until_ns = server.clock.wall_ns() + round(for_s * NS)
    steps: dict[str, Callable[[Alarm, str, int], Step]] = {
        "acknowledge": partial(lifecycle.acknowledged, note="a note"),
        "shelve": partial(lifecycle.shelved, until_ns=until_ns, reason="spare part"),
        "unshelve": lifecycle.unshelved,
        "resolve": partial(lifecycle.resolved, reason="a plug"),
    }
    person(server, steps[what])


def settle(robot: Robot) -> None:
    """Let both ends say all that they have to say."""
    robot.connect()
    for _ in range(12):
        robot.passes()
        robot.send_rows()
        robot.receive()
        robot.answer()
        with robot.server.database.begin() as connection:
            record_orders.renew(connection, robot.server.clock.wall_ns())
        robot.server.wait(11.0, 11.0)


def the_alarm(robot: Robot) -> Alarm:
    """Return the server's alarm of the robot's component."""
    (alarm,) = [one for one in robot.server.found() if one.kind == "robot"]
    return alarm


def made(server: Stand) -> list[str]:
    """Return the actions of all commands."""
    with server.database.reading() as connection:
        return list(connection.scalars(select(COMMAND.c.action).order_by(COMMAND.c.number)))


def lines(server: Stand) -> list[tuple[str, str]]:
    """Return what people did with the alarm, and who."""
    h = HISTORY.c
    chosen = select(h.what, h.who).where(h.who != "").order_by(h.number)
    with server.database.reading() as connection:
        return [(row.what, row.who) for row in connection.execute(chosen)]


@contextmanager
def both(path: Path, behind_s: int = 0) -> Iterator[Robot]:
    path.mkdir(parents=True, exist_ok=True)
    with stand(path) as server:
        robot = Robot(server, behind_s)
        robot.connect()
        robot.send_rows()
        yield robot


def test_an_acknowledgement_of_the_server_is_at_the_robot_and_its_echo_changes_nothing(
    tmp_path: Path,
) -> None:
    with both(tmp_path) as robot:
        on_server(robot.server, "acknowledge")
        settle(robot)
        said = robot.state
        assert (said.state, said.who, said.note) == ("acknowledged", SERVER, "a note")
        assert made(robot.server) == ["alarm.acknowledge"]
        assert lines(robot.server) == [("acknowledged", SERVER)]


def test_what_is_done_at_the_robot_is_on_the_server(tmp_path: Path) -> None:
    with both(tmp_path, behind_s=-7200) as robot:
        robot.do("acknowledge")
        settle(robot)
        assert the_alarm(robot).acknowledged_by == ROBOT
        robot.do("shelve", for_s=7200)
        robot.restart()
        settle(robot)
        alarm = the_alarm(robot)
        assert (alarm.state, alarm.shelved_by) == ("shelved", ROBOT)
        left_s = ((alarm.shelved_until_ns or 0) - robot.server.clock.wall_ns()) / NS
        assert 6000 < left_s <= 7200
        robot.do("resolve")
        settle(robot)
        assert (the_alarm(robot).state, the_alarm(robot).resolution) == ("resolved", "a note")
        assert made(robot.server) == []
        robot.restart()
        settle(robot)
        did = [("acknowledged", ROBOT), ("shelved", ROBOT), ("resolved", ROBOT)]
        assert lines(robot.server) == did, "each once, though files begin with it again"


def test_the_later_one_counts_and_both_are_in_the_history(tmp_path: Path) -> None:
    with both(tmp_path) as robot:
        robot.do("acknowledge")
        robot.server.wait(60)
        on_server(robot.server, "shelve", 2 * MONTH_S)  # not knowing of it
        robot.server.wait(60)
        settle(robot)
        assert (robot.state.state, robot.state.who) == ("shelved", SERVER)
        assert the_alarm(robot).state == "shelved"
        on_server(robot.server, "resolve")
        robot.server.wait(60)
        robot.do("acknowledge")  # later, while the command waits
        settle(robot)
        assert (robot.state.state, the_alarm(robot).state) == ("resolved", "resolved")
        assert ("note", ROBOT) in lines(robot.server)


def test_an_older_command_that_waits_is_withdrawn(tmp_path: Path) -> None:
    with both(tmp_path) as robot:
        on_server(robot.server, "acknowledge")
        on_server(robot.server, "shelve")
        on_server(robot.server, "unshelve")
        with robot.server.database.reading() as connection:
            states = list(connection.scalars(select(COMMAND.c.state).order_by(COMMAND.c.number)))
        assert states == ["withdrawn", "withdrawn", "waiting"]
        settle(robot)
        assert robot.state.state == "acknowledged"


def test_a_shelf_ends_when_the_person_said_though_the_robot_was_away(tmp_path: Path) -> None:
    with both(tmp_path) as robot:
        on_server(robot.server, "shelve", 8 * 86_400)
        robot.server.wait(7 * 86_400, 3600)
        settle(robot)
        until_ns = (robot.state.until_ns or 0) + robot.behind_s * NS
        assert abs(until_ns - (the_alarm(robot).shelved_until_ns or 0)) < 120 * NS
        assert made(robot.server) == ["alarm.shelve", "alarm.shelve"]


def test_an_unknown_outcome_is_made_anew_a_few_times(tmp_path: Path) -> None:
    with both(tmp_path) as robot:
        on_server(robot.server, "acknowledge")
        for _ in range(2 * record_orders.MOST_TRIES):
            robot.receive(is_lost=True)
            with robot.server.database.begin() as connection:
                order = record_orders.find(connection, "r1", f"alarm:{robot.state.id}")
                assert order is not None
                epoch, now_ns = robot.server.epochs["r1"], robot.server.clock.wall_ns()
                unknown = CommandAnswer(order.command, "outcome_unknown", number=1)
                commands.store_answers(connection, "r1", epoch, STORE, [unknown], now_ns)
                record_orders.renew(connection, now_ns)
        assert len(made(robot.server)) == record_orders.MOST_TRIES


def test_what_the_robot_refused_is_not_asked_again(tmp_path: Path) -> None:
    with both(tmp_path) as robot:
        on_server(robot.server, "acknowledge")
        with robot.server.database.begin() as connection:
            order = record_orders.find(connection, "r1", f"alarm:{robot.state.id}")
            assert order is not None
            epoch, now_ns = robot.server.epochs["r1"], robot.server.clock.wall_ns()
            refused = CommandAnswer(order.command, "refused", "no such alarm", number=1)
            commands.store_answers(connection, "r1", epoch, STORE, [refused], now_ns)
        robot.restart()
        settle(robot)
        assert made(robot.server) == ["alarm.acknowledge"]


def test_a_robot_that_takes_no_such_commands_gets_none(tmp_path: Path) -> None:
    with stand(tmp_path) as server:
        robot = Robot(server)
        robot.send_rows()
        on_server(server, "acknowledge")
        assert made(server) == []
        with server.database.begin() as connection:
            epoch = server.epochs["r1"]
            commands.begin_contact(connection, "r1", epoch, STORE)
            commands.announce(connection, "r1", epoch, '{"actions": []}', 1)
        on_server(server, "shelve")
        assert made(server) == []


@pytest.mark.parametrize("component", ["a b", "\x1b[2J", ""])
def test_hostile_components_cost_no_person_their_action(tmp_path: Path, component: str) -> None:
    with both(tmp_path) as robot:
        robot.server.say("r1", replace(robot.state, component=component))
        on_server(robot.server, "acknowledge")
        assert robot.server.found()[0].state == "acknowledged"


STEPS: Sequence[Any] = [
    st.tuples(st.just("server"), st.sampled_from(["acknowledge", "shelve", "unshelve", "resolve"])),
    st.tuples(st.just("robot"), st.sampled_from(["acknowledge", "shelve", "unshelve", "resolve"])),
    st.tuples(st.just("wait"), st.sampled_from([5, 400, 8 * 86_400, 40 * 86_400])),
    st.tuples(st.just("rows"), st.sampled_from([1, 2, 1000])),
    st.tuples(st.just("receive"), st.sampled_from(["well", "lost", "twice"])),
    st.tuples(st.just("other"), st.sampled_from(["connect", "answer", "restart", "server"])),
]


def play(robot: Robot, kind: str, what: Any) -> None:
    if kind == "server":
        on_server(robot.server, what, 6 * 3600.0)
    elif kind == "robot":
        robot.do(what, for_s=5 * 3600.0)
    elif kind == "wait":
        robot.server.wait(what, max(what / 2, 1))
        robot.passes()
    elif kind == "rows":
        robot.send_rows(what)
    elif kind == "receive":
        robot.receive(is_lost=what == "lost", is_twice=what == "twice")
    elif what == "connect":
        robot.connect()
    elif what == "answer":
        robot.answer()
    elif what == "restart":
        robot.restart()
    else:
        robot.server.restart()
        robot.server.alarms.step()


@settings(
    max_examples=40,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink),
)
@given(
    steps=st.lists(st.one_of(STEPS), min_size=1, max_size=14),
    behind_s=st.sampled_from([0, 3600, -90]),
)
def test_both_ends_agree_in_the_end(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, Any]], behind_s: int
) -> None:
    with both(tmp_path_factory.mktemp("agree"), behind_s) as robot:
        for kind, what in steps:
            play(robot, kind, what)
            robot.server.clock.advance(1.0)
        settle(robot)
        settle(robot)
        alarm, said = the_alarm(robot), robot.state
        assert alarm.state == said.state, (steps, lines(robot.server), made(robot.server))
        count = len(made(robot.server))
        settle(robot)
        assert len(made(robot.server)) == count, "no ping-pong"
        people = [one for one in steps if one[0] in ("server", "robot")]
        assert count <= record_orders.MOST_TRIES * (len(people) + 1)
