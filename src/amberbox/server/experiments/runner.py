"""The runner: carries out the robot's steps of runs, keeps their robots, and ends them.

For each run under way one task looks at what is due: timers, answers to its commands, steps of the
robot that may begin. A second one holds the robot's lease for it and renews it each second. What
a step asks of the robot is a command that a person still has to sign; its id follows from the step,
and it is stored with the run's state, so that whatever dies no step is asked for twice.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import msgspec
from sqlalchemy import Connection

from amberbox.blackbox.journal import channels
from amberbox.core.api import RunRole
from amberbox.core.clock import NS, Clock
from amberbox.core.command import Command, LeaseState
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Expression, Value
from amberbox.core.expressions.tree import output_of, status_of
from amberbox.experiments.action import AnnouncedAction, check_parameters, read_announcement
from amberbox.experiments.experiment import ActionTrouble
from amberbox.experiments.profile import is_variable_of_run
from amberbox.experiments.run import TEST_PREFIX, ExperimentRun, RobotTask, StopOrder
from amberbox.link.frames import AbortFrame, LeaseFrame
from amberbox.server import commands
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.commands import StoredCommand
from amberbox.server.database import ServerDatabase
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import HOLDING, LostRunError, RunRegister, StoredRun
from amberbox.server.experiments.shelf import ExperimentShelf
from amberbox.server.ingest.command_link import RobotContact
from amberbox.server.ingest.link_server import LinkServer
from amberbox.server.live.feed import Feed

RENEW_S: Final = 1.0
# How often a run is looked at where nothing is reported
LOOK_S: Final = 1.0
# How often while a step waits for values of the robot, which are not reported as news
REQUIRES_LOOK_S: Final = 0.3
# How long a step waits for the robot, for what it requires and for people who have to be there
REQUIRE_S: Final = 60.0
# How long its command waits for a signature; longer in the database, where wall clocks step
SIGN_S: Final = 600.0
_KEPT_S: Final = 30 * 24 * 3600.0
# How long the answer to a command that was sent is awaited after its time is over
ANSWER_S: Final = 30.0
# How long a robot has to state that it has stopped; then nobody knows
STOP_S: Final = 30.0
# A person whose page was not heard of for so long is not there any more
PRESENT_S: Final = 30.0
_DECIDE_S: Final = 3.0
_MOST_REPORTS: Final = 50
_LABEL: Final = 128
_REASON: Final = 300


class Presence:
    """Who is there for which run, by role; known in memory only. Threads may share it."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._seen: dict[str, dict[tuple[RunRole, str], int]] = {}

    def note(self, run: str, role: RunRole, who: str) -> bool:
        """Note that somebody is there; return whether that is news."""
        people = self._seen.setdefault(run, {})
        is_news = (role, who) not in self.present(run)
        people[role, who] = self._clock.boot_ns()
        return is_news

    def present(self, run: str) -> list[tuple[RunRole, str]]:
        """Return the roles and names of those who are there, in the order in which they came."""
        since_ns = self._clock.boot_ns() - int(PRESENT_S * NS)
        people = dict(self._seen.get(run, {}))
        return [person for person, at_ns in people.items() if at_ns >= since_ns]

    def forget(self, run: str) -> None:
        """Forget a run that is over."""
        self._seen.pop(run, None)


class CommandReport(msgspec.Struct, frozen=True):
    """A record of the channel ``amberbox/command``, as far as a run needs it."""

    id: str
    state: str
    text: str = ""


@dataclass(slots=True)
class _Look:
    """What follows from a look at a run."""

    stop: list[str] = field(default_factory=list)
    """Commands that the robot has to stop."""
    changed: list[str] = field(default_factory=list)
    """Commands that were made or withdrawn."""
    due_ns: int | None = None


class ExperimentRunner:
    """Drives the runs of the register; a background service of the server."""

    def __init__(
        self,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        links: LinkServer,
        feed: Feed,
        shelf: ExperimentShelf,
    ) -> None:
        self._database, self._bus, self._clock = database, bus, clock
        self._links, self._feed, self.shelf = links, feed, shelf
        self.presence = Presence(clock)
        self.register = RunRegister(database, bus, clock, shelf, self.live_value)
        self._news: dict[str, asyncio.Event] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._watched: dict[str, frozenset[str]] = {}
        self._waits: dict[str, tuple[str, int]] = {}
        self._reports: dict[str, deque[CommandReport]] = {}

    async def run(self) -> None:
        """Drive all runs under way until cancelled."""
        arrived: asyncio.Queue[str] = asyncio.Queue()
        ends = [
            self._bus.on("run", lambda change: arrived.put_nowait(change.robot)),
            self._bus.on("rows", self._on_rows),
            *(
                self._bus.on(kind, lambda change: self._wake(change.robot))
                for kind in ("answered", "command", "lease", "connected", "gone")
            ),
        ]
        try:
            for robot in await asyncio.to_thread(self._robots):
                arrived.put_nowait(robot)
            while True:
                robot = await arrived.get()
                try:
                    await self._attend(robot)
                except AmberboxError as error:  # the database is busy: others are driven meanwhile
                    logging.getLogger(__name__).error("runs on %s: %s", robot, error.what)
                    asyncio.get_running_loop().call_later(LOOK_S, arrived.put_nowait, robot)
        finally:
            for end in ends:
                end()
            tasks = list(self._tasks.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._tasks.clear()

    def close(self) -> None:
        """Do nothing: everything is in the database."""

    def live_value(self, robot: str, address: str) -> Value:
        """Return the newest value of a variable, a status or an output; None if it is unknown."""
        subject = status_of(address)
        if subject is not None:
            status = self._feed.statuses(robot).get(subject)
            return "unknown" if status is None else status.known_level
        output = output_of(address)
        if output is not None:
            status = self._feed.statuses(robot).get((output[0], output[1]))
            found = [o.shown for o in status.outputs if o.name == output[2]] if status else []
            return found[0] if found else None
        known = self._feed.live.value(robot, address) if robot in self._links.robots else None
        return None if known is None else known[1]

    def waits_for(self, run: str) -> str:
        """Return what the present step of the robot waits for; empty where it does not."""
        return self._waits.get(run, ("", 0))[0]

    # -- one task for each run

    def _robots(self) -> set[str]:
        with self._database.reading() as connection:
            return {one.robot for one in runs.listed(connection, states=HOLDING, limit=10_000)}

    def _wake(self, robot: str) -> None:
        if robot in self._news:
            self._news[robot].set()

    def _on_rows(self, change: ServerChange) -> None:
        """Keep what the robot reports of its commands; a status may be what a step waits for."""
        if change.robot not in self._news:
            return
        for row in change.data["rows"]:
            if row.channel == channels.COMMAND:
                try:
                    found = msgspec.json.decode(row.data, type=CommandReport)
                except (msgspec.MsgspecError, UnicodeDecodeError):
                    continue
                kept = self._reports.setdefault(change.robot, deque(maxlen=_MOST_REPORTS))
                kept.append(found)
        self._wake(change.robot)

    async def _attend(self, robot: str) -> None:
        """See that the run of a robot is driven, and looked at now."""
        task = self._tasks.get(robot)
        if task is not None and not task.done():
            self._wake(robot)
            return
        stored = await asyncio.to_thread(self._holder, robot)
        if stored is not None:
            self._news[robot] = asyncio.Event()
            name = f"run {stored.id}"
            self._tasks[robot] = asyncio.create_task(self._drive(stored), name=name)

    def _holder(self, robot: str) -> StoredRun | None:
        with self._database.reading() as connection:
            return runs.holder_of(connection, robot)

    async def _drive(self, stored: StoredRun) -> None:
        """Drive a run until it is over and all that it began has stopped."""
        holding = asyncio.create_task(self._hold(stored))
        news = self._news[stored.robot]
        try:
            with suppress(AmberboxError):  # the first look ends a run that cannot be read
                await self._watch(stored)
            while stored.state in HOLDING:
                news.clear()
                look = _Look()
                try:
                    stored = await self._look_and_act(stored, look)
                except LostRunError as error:
                    stored = await asyncio.to_thread(
                        self.register.give_up, stored, error.what[:_REASON]
                    )
                except AmberboxError as error:  # the database is busy: with the next look
                    logging.getLogger(__name__).error("run %s: %s", stored.id, error.what)
                except Exception as error:  # this run cannot go on; others do
                    logging.getLogger(__name__).exception("run %s cannot go on", stored.id)
                    stored = await asyncio.to_thread(self._give_up, stored, error)
                if stored.state in HOLDING:
                    await self._until_news(news, look.due_ns)
        finally:
            holding.cancel()
            await asyncio.gather(holding, return_exceptions=True)
            self._feed.watch({r: v for r, v in self._watched.items() if r != stored.robot})
            self._watched.pop(stored.robot, None)
        await self._release(stored)
        self._forget(stored)
        self._bus.publish(ServerChange("run", stored.robot, {"id": stored.id}))

    def _forget(self, stored: StoredRun) -> None:
        del self._news[stored.robot]
        self._reports.pop(stored.robot, None)
        self._waits.pop(stored.id, None)
        self.presence.forget(stored.id)

    def _give_up(self, stored: StoredRun, error: Exception) -> StoredRun:
        reason = f"the server cannot go on with it: {error}"[:_REASON]
        try:
            return self.register.change(stored, lambda run, _, now: run.abort("", reason, now))[1]
        except Exception:  # nor can it end it in order
            return self.register.give_up(stored, reason)

    async def _until_news(self, news: asyncio.Event, due_ns: int | None) -> None:
        wait_s = LOOK_S
        if due_ns is not None:
            wait_s = min(wait_s, max(0.0, (due_ns - self.register.now_ns()) / NS))
        try:
            async with asyncio.timeout(wait_s):
                await news.wait()
        except TimeoutError:
            return

    async def _watch(self, stored: StoredRun) -> None:
        """Ask for the newest values of the variables that the run's expressions read."""
        names = await asyncio.to_thread(self._live_variables, stored)
        if names:
            self._watched[stored.robot] = names
            self._feed.watch(dict(self._watched))

    def _live_variables(self, stored: StoredRun) -> frozenset[str]:
        procedure = self.shelf.procedure(stored)
        read: list[Expression] = [
            step.robot.requires
            for step in procedure.steps.values()
            if step.robot is not None and step.robot.requires is not None
        ]
        read += [
            flow.condition
            for node in procedure.process.walk()
            for flow in node.flows
            if flow.condition is not None
        ]
        names = {name for expression in read for name in expression.addresses()}
        return frozenset(
            name
            for name in names
            if not (is_variable_of_run(name) or status_of(name) or output_of(name))
        )

    # -- the lease

    async def _hold(self, stored: StoredRun) -> None:
        """Take the robot's lease for the run, and renew it each second."""
        while True:
            try:
                await self._renew(stored)
            except Exception:  # without renewals the robot would stop
                logging.getLogger(__name__).exception("the lease of run %s", stored.id)
            await asyncio.sleep(RENEW_S)

    async def _renew(self, stored: StoredRun) -> None:
        contact = self._links.contact(stored.robot)
        lease = None if contact is None else contact.lease
        if lease is not None and _is_ours(lease, stored):
            frame = LeaseFrame("renew", stored.who, stored.id, lease.number)
            await self._links.order(stored.robot, frame)
        elif lease is not None and not lease.holder:
            frame = LeaseFrame("take", stored.who, stored.id)
            await self._links.ask(stored.robot, frame, _decided, _DECIDE_S)
            self._wake(stored.robot)

    async def _release(self, stored: StoredRun) -> None:
        contact = self._links.contact(stored.robot)
        lease = None if contact is None else contact.lease
        if lease is not None and _is_ours(lease, stored):
            frame = LeaseFrame("release", stored.who, stored.id, lease.number)
            await self._links.order(stored.robot, frame)

    # -- one look at a run

    async def _look_and_act(self, stored: StoredRun, look: _Look) -> StoredRun:
        work = partial(self._look, stored, look)
        _, after = await asyncio.to_thread(self.register.change, stored, work)
        if look.changed:
            change = ServerChange("command", stored.robot, {"ids": look.changed})
            self._bus.publish(change)
        for command in look.stop:
            await self._links.order(stored.robot, AbortFrame("", command, stored.who))
        return after

    def _look(
        self,
        stored: StoredRun,
        look: _Look,
        run: ExperimentRun,
        connection: Connection,
        now_ns: int,
    ) -> None:
        """Do what is due in a run."""
        run.tick(now_ns)
        self._take_reports(stored, run, now_ns)
        for task in run.running():
            self._take_answer(connection, stored, run, task, now_ns, look)
        for order in run.stop_orders():
            self._stop(connection, stored, run, order, now_ns, look)
        ready = run.robot_tasks()
        for task in ready:
            self._begin_step(connection, stored, run, task, now_ns, look)
        if not ready:
            self._waits.pop(stored.id, None)
        dues_ns = [now_ns + int(REQUIRES_LOOK_S * NS)] if any(t.requires for t in ready) else []
        look.due_ns = min(filter(None, [run.next_due_ns, *dues_ns]), default=None)

    def _take_reports(self, stored: StoredRun, run: ExperimentRun, now_ns: int) -> None:
        tasks = {task.command: task.id for task in run.running()}
        reports = self._reports.get(stored.robot, deque())
        while reports:
            report = reports.popleft()
            if report.state == "report" and report.id in tasks:
                run.robot_report(tasks[report.id], report.text, now_ns)

    def _withdraw(
        self, connection: Connection, stored: StoredRun, command: str, reason: str, look: _Look
    ) -> None:
        wall_ns = self._clock.wall_ns()
        commands.withdraw(connection, wall_ns, stored.robot, command, reason)
        look.changed.append(command)

    def _take_answer(
        self,
        connection: Connection,
        stored: StoredRun,
        run: ExperimentRun,
        task: RobotTask,
        now_ns: int,
        look: _Look,
    ) -> None:
        """Note how the command of a step has ended; have it stopped where it takes too long."""
        command = commands.find(connection, self._clock.wall_ns(), task.command)
        if command is None:
            reason = "its command is not known here: was the server restored from an older copy?"
            run.robot_ended(task.id, "outcome_unknown", now_ns, reason)
            return
        limit_s = task.timeout_s or float("inf")
        if command.state == "done":
            run.robot_ended(task.id, "done", now_ns, command.reason, _result(command))
        elif command.state == "unsigned":
            if self._waited_s(command.id, "signature") > SIGN_S:
                reason = f"nobody has signed it within {SIGN_S / 60:g} min"
                self._withdraw(connection, stored, command.id, reason, look)
                run.robot_ended(task.id, "refused", now_ns, reason)
        elif command.state == "accepted":
            if self._waited_s(command.id, "end") > limit_s:
                look.stop.append(command.id)
        elif (trouble := _trouble(command)) is not None and not self._may_answer(command):
            late = trouble == "aborted" and _ran_s(command) > limit_s
            reason = f"not done within {task.timeout_s:g} s" if late else command.reason
            run.robot_ended(task.id, "timeout" if late else trouble, now_ns, reason)
        if command.state == "outcome_unknown" or _is_given_up(command):
            look.stop.append(command.id)  # the robot may be at work all the same
        if all(one.id != task.id for one in run.running()):
            self._waits.pop(command.id, None)

    def _may_answer(self, command: StoredCommand) -> bool:
        """Return whether an answer may still come to a command whose time went by."""
        return _is_given_up(command) and self._waited_s(command.id, "answer") <= ANSWER_S

    def _stop(
        self,
        connection: Connection,
        stored: StoredRun,
        run: ExperimentRun,
        order: StopOrder,
        now_ns: int,
        look: _Look,
    ) -> None:
        """Have the command of a step stopped, until it has ended."""
        wall_ns = self._clock.wall_ns()
        command = commands.find(connection, wall_ns, order.command)
        if command is not None and command.state == "unsigned":
            self._withdraw(connection, stored, command.id, order.reason, look)
            run.robot_ended(order.task, "aborted", now_ns, order.reason)
        elif command is None or _trouble(command) is not None or command.state == "done":
            state = "outcome_unknown" if command is None else _trouble(command) or "done"
            run.robot_ended(order.task, state, now_ns, command.reason if command else "")
        elif self._waited_s(order.command, "") > STOP_S:
            reason = "the robot did not state that it has stopped"
            run.robot_ended(order.task, "outcome_unknown", now_ns, reason)
        else:
            look.stop.append(order.command)
            return
        self._waits.pop(order.command, None)

    def _begin_step(
        self,
        connection: Connection,
        stored: StoredRun,
        run: ExperimentRun,
        task: RobotTask,
        now_ns: int,
        look: _Look,
    ) -> None:
        """Ask the robot for a step: store a command that waits for its signature."""
        name = task.action
        said = commands.commanded(connection, stored.robot)
        action = read_announcement(said.actions)[0].get(name) if said else None
        waits = self._obstacle(stored, task, action)
        if waits:
            if self._waited_s(stored.id, waits) > REQUIRE_S:
                run.robot_ended(task.id, "requirement", now_ns, waits)
            return
        self._waits.pop(stored.id, None)
        parameters = json.dumps(dict(task.parameters), ensure_ascii=False)
        try:
            if action is None:
                kind = "unit test" if name.startswith(TEST_PREFIX) else "action"
                what = f"{stored.robot} announces no {kind} '{name.removeprefix(TEST_PREFIX)}'"
                raise UsageError(what, "was it taken from its folder?")
            check_parameters(action, parameters)
            command = Command(
                runs.command_id(stored.id, task.id), stored.robot, name, parameters, stored.who,
                action.risk, stored.id, task.id[:_LABEL],
            )  # fmt: skip
            commands.intend(connection, self._clock.wall_ns(), command, int(_KEPT_S * NS))
        except UsageError as error:
            run.robot_ended(task.id, "refused", now_ns, error.what)
            return
        run.robot_started(task.id, command.id, now_ns)
        look.changed.append(command.id)

    def _waited_s(self, what: str, reason: str) -> float:
        """Return for how long something has waited for this reason, in seconds."""
        known, since_ns = self._waits.get(what, ("", None))
        if since_ns is None or known != reason:
            since_ns = self._clock.boot_ns()
            self._waits[what] = reason, since_ns
        return (self._clock.boot_ns() - since_ns) / NS

    def _obstacle(self, stored: StoredRun, task: RobotTask, action: AnnouncedAction | None) -> str:
        """Return what has to be there before a step may begin; empty where all of it is."""
        contact = self._links.contact(stored.robot)
        if contact is None or contact.lease is None:
            return f"{stored.robot} is not connected, or takes no commands"
        if not _is_ours(contact.lease, stored):
            lease = contact.lease
            return f"{stored.robot} is held by {lease.holder or 'nobody yet'}"
        present = {role for role, _ in self.presence.present(stored.id)}
        if action is not None and action.risk == "moves" and not present:
            return "nobody is there: somebody has to have this run open before the robot moves"
        if task.requires is not None:
            values = {
                name: self.live_value(stored.robot, name) for name in task.requires.addresses()
            }
            if task.requires.evaluate(values) is not True:
                return f"it requires {task.requires.text}"
        return ""


def _is_ours(lease: LeaseState, stored: StoredRun) -> bool:
    return (lease.holder, lease.run) == (stored.who, stored.id)


def _decided(contact: RobotContact) -> LeaseState | None:
    lease = contact.lease
    return lease if lease is not None and (lease.holder or lease.reason) else None


def _trouble(command: StoredCommand) -> ActionTrouble | None:
    """Return how a command has ended badly; None while it goes on, or if it is done."""
    if command.state in ("failed", "refused", "aborted", "outcome_unknown"):
        return command.state
    if command.state == "withdrawn":
        return "aborted"
    if command.state == "expired":
        return "outcome_unknown" if _is_given_up(command) else "refused"
    return None


def _is_given_up(command: StoredCommand) -> bool:
    """Return whether a command was sent and its time went by without an answer."""
    return command.state == "expired" and command.sends > 0 and command.answered_ns is None


def _ran_s(command: StoredCommand) -> float:
    """Return for how long the robot has carried out a command, in seconds by its own clock."""
    begun = [answer for answer in command.answers if answer.state == "accepted"]
    ended = [answer for answer in command.answers if answer.state not in ("accepted", "report")]
    if not begun or not ended or begun[0].boot != ended[-1].boot:
        return 0.0
    return (ended[-1].mono_ns - begun[0].mono_ns) / NS


def _result(command: StoredCommand) -> Mapping[str, Any]:
    """Return the result of a command; nothing where it is no object."""
    texts: Sequence[str] = [answer.result for answer in command.answers if answer.state == "done"]
    try:
        found = json.loads(texts[-1]) if texts and texts[-1] else {}
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
