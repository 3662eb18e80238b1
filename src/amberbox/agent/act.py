"""The command process of a robot (``amberbox act FOLDER``): the gate, its log, and the actors.

It decides about commands of the server and orders of somebody at the robot, lets actors carry them
out, records both on the channel ``amberbox/command``, and ends every motion when it ends itself.
The supervisor keeps it running; the link process passes the server's frames to it
(``agent.command_socket``).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from amberbox.agent.actor import Ended, Task
from amberbox.agent.actor_supervisor import ActorProcess, Outcome, SupervisedActor
from amberbox.agent.command_gate import (
    CAME_AGAIN,
    CONFIRM_S,
    CommandGate,
    Decision,
    WaitingState,
)
from amberbox.agent.command_inbox import CommandInbox
from amberbox.agent.command_log import CommandLogFile
from amberbox.agent.command_socket import (
    Announcement,
    Answers,
    Challenge,
    FromGate,
    LinkBegins,
    LinkEnds,
    OrderOutcome,
    OrderReport,
    RunningAction,
    SiteAborts,
    SiteAsks,
    SiteConfirms,
    SiteOrders,
    SiteRenews,
    SiteState,
    SocketClient,
    SocketServer,
    ToGate,
    WaitingMotion,
)
from amberbox.agent.command_trust import CommandTrust, read_trust, trust_path
from amberbox.agent.model_action import install_action, takes_models
from amberbox.agent.record_commands import RecordCommandThread, RecordRequests
from amberbox.agent.recovery import (
    ISSUER,
    CauseReader,
    RecoveryPolicy,
    RuleReport,
    recovery_lines,
    write_recovery,
)
from amberbox.agent.recovery_actions import causes_by_action, folder_recoveries
from amberbox.agent.unit_test_action import FolderTests, is_unit_test
from amberbox.blackbox.journal import channels
from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.robot_folder.robot_yaml import RecoveryRule
from amberbox.blackbox.store.derived_journal import DerivedJournal, EncodedRecord
from amberbox.blackbox.store.journal_reader import previous_chain
from amberbox.blackbox.store.store import EVENT_REQUEST, Store, submit
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.command import (
    Command,
    CommandAnswer,
    CommandError,
    LeaseState,
    Risk,
    new_command_id,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import replace_file, wait_readable
from amberbox.core.pacing import TokenBucket
from amberbox.core.record_commands import RECORD_COMMANDS, decode_record_command
from amberbox.core.systemd import Notifier
from amberbox.experiments.action import (
    FOLDER,
    DeclaredAction,
    announcement,
    check_parameters,
    read_actions,
)
from amberbox.experiments.unit_tests import with_tests
from amberbox.link import limits
from amberbox.link.frames import (
    AnsweredFrame,
    CommandsFrame,
    ConfirmFrame,
    LeaseFrame,
    RevokedFrame,
    ServerCommandFrame,
)

WRITER = "act"
LOG_FILE = "commands.log"
CARRIED_OUT = "acting.json"
_TICK_S = 0.05
# While commands wait for their turn
_HURRY_S = 0.01
# Commands that are carried out at once; more wait, so that no server fills the memory with actors
_MOST_ACTING = 16
# Notes, refusals and repeated answers that are recorded, lastingly a second and at once
_ASIDES_PER_S = 5.0
_ASIDES = 200.0
_MINT_S = 10.0
_LOOK_S = 2.0
_RECOVER_S = 0.5
_END_S = 8.0
_RECORDS_END_S = 2.0


class FolderActions:
    """The actions and unit tests of a robot folder, read again when its files change.

    The built-in commands about the record are known without a declaration.
    """

    def __init__(self, folder: RobotFolder) -> None:
        self._folder = folder
        self._tests = FolderTests(folder.path)
        self._stamp: Any = None
        # what they recover; read in a thread, as it takes the whole folder
        self._recovers: Mapping[str, Sequence[str]] = {}
        self._is_read = False
        self._actions: Mapping[str, DeclaredAction] = {}
        self._built_in = [install_action(folder.path)] if takes_models(folder) else []

    def changed(self) -> bool:
        """Read them if the files have changed; return whether more is known than before."""
        stamp = sorted(_stamps(self._folder.path / FOLDER))
        has_other_tests = self._tests.changed()
        if stamp == self._stamp:
            is_read, self._is_read = self._is_read, False
            return is_read or has_other_tests
        self._stamp, self._actions = stamp, read_actions(self._folder.path)[0]
        threading.Thread(target=self._read_recovers, name="recovery", daemon=True).start()
        return True

    def _read_recovers(self) -> None:
        with suppress(AmberboxError, OSError):
            self._recovers = causes_by_action(folder_recoveries(self._folder))
            self._is_read = True

    @property
    def are_declared(self) -> bool:
        """Return whether there are any."""
        return bool(self._actions)

    def risk(self, action: str) -> Risk | None:
        """Return the risk of an action; None for one that is not declared."""
        if action in RECORD_COMMANDS:
            return "record"
        found = self._get(action)
        return None if found is None else found.options.risk

    def _get(self, action: str) -> DeclaredAction | None:
        if is_unit_test(action):
            return self._tests.get(action)
        ours = {one.name: one for one in self._built_in}
        return ours.get(action) or self._actions.get(action)

    def problem(self, action: str, parameters: str) -> str:
        """Return what is wrong with parameters (JSON text); empty where nothing is."""
        declared = self._get(action)
        try:
            if action in RECORD_COMMANDS:
                decode_record_command(action, parameters)
            elif declared is not None:
                check_parameters(declared, parameters)
        except (CommandError, UsageError) as error:
            return error.what
        return ""

    def announcement(self) -> bytes:
        """Return what a server may know of them, as JSON; without those that do not fit.

        ``record`` are the names of the built-in commands that this version knows.
        """
        known = {"record": sorted(RECORD_COMMANDS)}
        room = limits.ACTIONS_BYTES - len(msgspec.json.encode(known))
        ours = [one.announced() for one in self._built_in]
        room -= len(msgspec.json.encode(ours))
        declared = msgspec.json.decode(announcement(self._folder.path, self._recovers, room))
        declared["actions"] = [*ours, *declared["actions"]]
        able = msgspec.json.encode(declared | known)
        return with_tests(able, self._tests.found.tests, limits.ACTIONS_BYTES)


def _stamps(folder: Path) -> list[tuple[str, int, int]]:
    found = []
    with suppress(OSError):
        for entry in os.scandir(folder):
            with suppress(OSError):
                about = entry.stat()
                found.append((entry.name, about.st_mtime_ns, about.st_size))
    return found


class _LeftOut(msgspec.Struct, frozen=True):
    """How many actions an announcement leaves out, and why."""

    left_out: int = 0
    reason: str = ""


@dataclass(slots=True)
class _Acting:
    """An actor at work."""

    command: Command
    person: str
    actor: SupervisedActor
    since_ns: int
    site: SocketClient | None = None
    """Who ordered it at the robot."""
    report: str = ""


class CarriedOut(msgspec.Struct, frozen=True):
    """An action that was being carried out, as it is on the disk while it is."""

    id: str
    action: str
    parameters: str


class CommandProcess:
    """Everything that a robot does on command; ``run`` until ``stop`` is set.

    Raises AmberboxError when the command log cannot be used.
    """

    def __init__(
        self,
        folder: RobotFolder,
        store: Store,
        *,
        clock: Clock | None = None,
        notifier: Notifier | None = None,
        log: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._folder, self._store, self._out = folder, store, log
        self._clock = clock or SystemClock()
        self._notifier = notifier or Notifier()
        self._actions = FolderActions(folder)
        self._actions.changed()
        self._log = CommandLogFile(store.path / LOG_FILE)
        self._gate = CommandGate(
            folder.robot.id, self._log, self._clock, self._trust, self._actions
        )
        self._journal = DerivedJournal(
            store, WRITER, robot=folder.robot.id, config_hash=folder.config_hash,
            clock=self._clock, chain=lambda: previous_chain(store, WRITER),
        )  # fmt: skip
        self._records = RecordCommandThread(RecordRequests(folder, store, self._clock))
        self._socket = SocketServer(store.path)
        self._inbox = CommandInbox()
        self._asides = TokenBucket(_ASIDES_PER_S, _ASIDES)
        self._unrecorded = 0
        self._left_out = _LeftOut()
        self._link: SocketClient | None = None
        self._acting: dict[str, _Acting] = {}
        self._ordering: SocketClient | None = None  # whose order the gate decides about now
        self._spare: ActorProcess | None = None
        self._asked: tuple[Decision, int] | None = None
        self._lease = LeaseState()
        self._waiting: WaitingState | None = None
        self._minted_ns = self._looked_ns = self._recovered_ns = 0
        rules = folder.robot.recovery
        self._causes = CauseReader(store, self._clock, rules)
        self._policy = RecoveryPolicy(rules, self._gate, self._clock, self._causes)
        self._rules: list[RuleReport] = []

    def _trust(self) -> CommandTrust | None:
        path = trust_path(self._folder)
        return None if path is None else read_trust(path)

    def run(self, stop: threading.Event) -> None:
        """Decide and act until ``stop``; then stop what runs safely, and end."""
        for note in self._log.notes:
            self._record("note", text=note)
        self._stop_left_behind()
        self._do(self._gate.boot())
        self._spare = self._spare or self._new_actor()
        write_recovery(self._store, self._rules)
        if self._folder.robot.recovery:
            self._causes.start()
        self._notifier.ready()
        while not stop.is_set():
            self.turn(_TICK_S)
        self._notifier.stopping("stopping what runs")
        self._do(self._gate.abort("", "the end of the command process"))
        end_ns = self._clock.boot_ns() + int(_END_S * NS)
        while self._acting and self._clock.boot_ns() < end_ns:
            self.turn(_TICK_S)
        self._records.close(_RECORDS_END_S)
        self.turn(0.0)
        self.close()

    def close(self) -> None:
        """Close everything; actors that still run stop by themselves."""
        if self._spare is not None:
            self._spare.close()
        self._causes.close()
        self._socket.close()
        self._journal.close()
        self._log.close()

    def turn(self, wait_s: float) -> None:
        """Wait for something to do, at most so long, and do it."""
        watched = [fd for acting in self._acting.values() for fd in acting.actor.filenos()]
        wait_s = min(wait_s, _HURRY_S) if self._inbox.has_commands else wait_s
        wait_readable([*self._socket.filenos(), *watched], wait_s)
        for client, message in self._socket.received():
            self._receive(client, message)
        room = _MOST_ACTING - len(self._acting)
        for frame in self._inbox.take(self._clock.boot_ns() / NS, room):
            self._handle_server(frame)
        if self._link is not None and self._link.is_closed:
            self._link = None
        self._watch_terminals()
        for command_id, acting in list(self._acting.items()):
            outcome = acting.actor.step()
            if outcome is not None:
                self._ended(command_id, outcome)
        for answered in self._records.ended():
            self._do(
                self._gate.ended(answered.id, answered.state, answered.reason, answered.result)
            )
        self._do(self._gate.step())
        self._watch_gate()
        self._mint()
        self._look_at_actions()
        self._recover()
        with suppress(OSError):
            self._journal.keep_up()
        self._notifier.alive(self._in_words)

    def _in_words(self) -> str:
        acting = ", ".join(one.command.action for one in self._acting.values())
        return f"carrying out {acting}" if acting else "waiting for commands"

    # -- what comes

    def _receive(self, client: SocketClient, message: ToGate) -> None:
        if isinstance(message, SiteAsks | SiteConfirms | SiteAborts):
            self._handle_site(message)
            client.send(self._site_state())
        elif isinstance(message, SiteOrders):
            self._handle_order(client, message)
        elif isinstance(message, SiteRenews):
            acting = self._acting.get(message.id)
            if acting is not None and acting.site is client:
                self._gate.renew_order(message.id)
                acting.actor.renew()
        elif isinstance(message, LinkBegins):
            self._link, self._minted_ns = client, 0
            self._announce()
            self._send_answers(self._gate.unanswered())
        elif isinstance(message, LinkEnds):
            self._link = None
            self._inbox.forget_commands()
        else:
            self._inbox.add(message)

    def _handle_site(self, message: SiteAsks | SiteConfirms | SiteAborts) -> None:
        if isinstance(message, SiteConfirms):
            self._do(self._gate.confirmed(message.code, on_site=message.on_site))
        elif isinstance(message, SiteAborts):
            self._do(self._gate.abort(message.target, message.who or "somebody at the robot"))

    def _handle_order(self, client: SocketClient, order: SiteOrders) -> None:
        who = order.who or "somebody at the robot"
        decisions = self._gate.order(
            order.id, order.action, order.parameters, who, is_confirmed=order.confirmed
        )
        self._ordering = client
        self._do(decisions)
        self._ordering = None
        mine = [decision for decision in decisions if decision.id == order.id]
        if not any(decision.kind == "run" for decision in mine):
            why = next((decision.text for decision in mine), "")
            client.send(OrderOutcome(order.id, "refused", why.removeprefix("refused: ")))

    def _watch_terminals(self) -> None:
        """Stop what was ordered at a terminal that is gone."""
        for command_id, acting in list(self._acting.items()):
            if acting.site is not None and acting.site.is_closed:
                acting.site = None
                self._do(self._gate.abort(command_id, "the end of the terminal that ordered it"))

    def _recover(self) -> None:
        """Order what the policy wants, keep what it has ordered, and show what it does."""
        now_ns = self._clock.boot_ns()
        if not self._folder.robot.recovery or now_ns - self._recovered_ns < _RECOVER_S * NS:
            return
        self._recovered_ns = now_ns
        for command_id, acting in self._acting.items():
            if acting.person == ISSUER and self._gate.renew_order(command_id):
                acting.actor.renew()
        rule = self._policy.due()
        if rule is not None:
            self._order_recovery(rule)
        before, self._rules = self._rules, self._policy.reports()
        if self._rules != before:
            write_recovery(self._store, self._rules)
            self._report_given_up(before)

    def _order_recovery(self, rule: RecoveryRule) -> None:
        command_id = new_command_id()
        decisions = self._gate.order(
            command_id, rule.do, rule.parameters_json, ISSUER, rule=rule.key, limit=rule.at_most
        )
        mine = [decision for decision in decisions if decision.id == command_id]
        is_run = any(decision.kind == "run" for decision in mine)
        why = "" if is_run else next((d.text for d in mine), "it cannot be ordered")
        self._policy.ordered(rule, command_id, why)
        self._do(decisions)

    def _report_given_up(self, before: Sequence[RuleReport]) -> None:
        """Log an event for each rule that has given up."""
        known = {(one.when, one.do) for one in before if one.state == "gave_up"}
        for one in self._rules:
            if one.state == "gave_up" and (one.when, one.do) not in known:
                text = next(recovery_lines([one]))
                self._record("note", text=text)
                with suppress(OSError):
                    submit(self._store, EVENT_REQUEST, {
                        "kind": "recovery_gave_up", "text": text, "source": "act",
                        "details": {"when": one.when, "do": one.do, "attempts": one.attempts},
                    })  # fmt: skip

    def _handle_server(self, frame: ServerCommandFrame) -> None:
        if isinstance(frame, CommandsFrame):
            for command in frame.commands:
                self._do(self._gate.receive(command))
        elif isinstance(frame, AnsweredFrame):
            self._gate.acknowledged(frame.number)
        elif isinstance(frame, RevokedFrame):
            self._do(self._gate.revoke(frame.keys))
        elif isinstance(frame, LeaseFrame):
            self._handle_lease(frame)
        elif isinstance(frame, ConfirmFrame):
            self._do(self._gate.confirmed(frame.code, frame.command))
        else:
            who = frame.who or "the server"
            self._do(self._gate.abort(frame.command or frame.run, who))

    def _handle_lease(self, frame: LeaseFrame) -> None:
        if frame.do == "take":
            state = self._gate.take_lease(frame.holder, frame.run)
        elif frame.do == "release":
            self._do(self._gate.release(frame.number))
            state = self._gate.lease()
        else:
            state = self._gate.renew(frame.number)
            if not state.reason:
                for acting in self._acting.values():
                    acting.actor.renew()
        if frame.do == "take" or state.reason:
            self._send_challenge(state)

    def _watch_gate(self) -> None:
        """Tell the server when the lease has another holder, or another motion waits."""
        state, waiting = self._gate.lease(), self._gate.waiting()
        is_other = (state.number, state.holder) != (self._lease.number, self._lease.holder)
        if is_other or waiting != self._waiting:
            self._lease, self._waiting = state, waiting
            self._send_challenge(state)

    def _mint(self) -> None:
        due_ns = self._minted_ns + int(_MINT_S * NS)
        if self._link is not None and (not self._minted_ns or self._clock.boot_ns() >= due_ns):
            self._send_challenge(self._gate.lease())

    def _send_challenge(self, lease: LeaseState) -> None:
        if self._link is not None:
            self._minted_ns = self._clock.boot_ns()
            waiting = self._gate.waiting() or WaitingState("", by_code=False, tries=0)
            self._send(
                Challenge(self._gate.mint(), lease, waiting.id, waiting.by_code, waiting.tries)
            )

    def _look_at_actions(self) -> None:
        now_ns = self._clock.boot_ns()
        if now_ns - self._looked_ns >= _LOOK_S * NS:
            self._looked_ns = now_ns
            if self._actions.changed():
                self._announce()
            self._note_flood()

    def _announce(self) -> None:
        """Send what the robot can do; record how many actions were too many, when that changes."""
        announced = self._actions.announcement()
        left_out = msgspec.json.decode(announced, type=_LeftOut)
        if left_out != self._left_out:
            self._left_out = left_out
            if left_out.left_out:
                text = f"{left_out.left_out} actions are not announced: {left_out.reason}"
                self._record("note", text=text)
        self._send(Announcement(announced))

    def _note_flood(self) -> None:
        """Record how much of a flood of commands was neither handled nor recorded."""
        dropped, unrecorded = self._inbox.dropped, self._unrecorded
        if dropped:
            text = f"{dropped} commands were dropped: the server sends more than is handled"
            self._record("note", text=text)
            self._inbox.dropped = 0
        if unrecorded:
            text = f"{unrecorded} refusals, repetitions and notes were too many to be recorded"
            self._unrecorded = 0
            self._record("note", text=text)

    def _send_answers(self, answers: list[CommandAnswer]) -> None:
        for start in range(0, len(answers), limits.ANSWERS_COUNT):
            self._send(Answers(answers[start : start + limits.ANSWERS_COUNT]))

    def _send(self, message: FromGate) -> None:
        if self._link is not None:
            self._link.send(message)

    # -- what is done

    def _do(self, decisions: list[Decision]) -> None:
        """Carry out the gate's decisions, and record them."""
        for decision in decisions:
            if decision.kind == "run" and decision.command is not None:
                self._start(decision.command, decision.person)
            elif decision.kind == "stop" and decision.id in self._acting:
                self._acting[decision.id].actor.abort(decision.text)
            elif decision.kind == "answer" and decision.answer is not None:
                self._forget_asked(decision.id)
                if not decision.is_local:
                    self._send(Answers([decision.answer]))
            elif decision.kind == "ask":
                self._asked = decision, self._clock.boot_ns()
            self._record_decision(decision)

    def _forget_asked(self, command_id: str) -> None:
        if self._asked is not None and self._asked[0].id == command_id:
            self._asked = None

    def _start(self, command: Command, person: str) -> None:
        if command.action in RECORD_COMMANDS:
            self._records.put(command)
            return
        task = Task(str(self._folder.path), command.action, command.parameters)
        now_ns = self._clock.boot_ns()
        try:
            self._note_carried_out([*self._acting.values()], command)
            spare, self._spare = self._spare, None
            if spare is not None and spare.is_gone():  # killed while it waited
                spare.close()
                spare = None
            actor = SupervisedActor(task, self._reporter(command.id), spare)
        except (OSError, UsageError) as error:
            why = f"it could not be started: {error}"
            self._do(self._gate.ended(command.id, "failed", why))
            self._policy.ended(command.id, "failed", why)
            if self._ordering is not None:
                self._ordering.send(OrderOutcome(command.id, "failed", why))
            return
        self._acting[command.id] = _Acting(command, person, actor, now_ns, self._ordering)
        self._spare = self._new_actor()

    def _reporter(self, command_id: str) -> Callable[[str], None]:
        def report(text: str) -> None:
            acting = self._acting.get(command_id)
            if acting is not None:
                acting.report = text
                if acting.site is not None:
                    acting.site.send(OrderReport(command_id, text))
            self._record("report", id=command_id, text=text)

        return report

    def _new_actor(self) -> ActorProcess | None:
        """Start an actor that waits for a task, so that the next command begins at once."""
        if not self._actions.are_declared:
            return None
        try:
            return ActorProcess()
        except OSError:
            return None

    def _ended(self, command_id: str, outcome: Outcome) -> None:
        acting = self._acting.pop(command_id)
        hint = f" ({outcome.hint})" if outcome.hint else ""
        if outcome.printed:
            self._out(f"{acting.command.action}: {outcome.printed.strip()[-500:]}")
        self._do(
            self._gate.ended(command_id, outcome.state, f"{outcome.reason}{hint}", outcome.result)
        )
        self._policy.ended(command_id, outcome.state, outcome.reason)
        if acting.site is not None:
            acting.site.send(
                OrderOutcome(command_id, outcome.state, outcome.reason, outcome.hint,
                             outcome.result, outcome.printed)
            )  # fmt: skip
        with suppress(OSError):
            self._note_carried_out([*self._acting.values()])

    def _note_carried_out(self, acting: list[_Acting], *more: Command) -> None:
        """Write which actions run, so that they can be stopped if everything here is killed."""
        commands = [*(one.command for one in acting), *more]
        running = [CarriedOut(one.id, one.action, one.parameters) for one in commands]
        replace_file(self._store.path / CARRIED_OUT, msgspec.json.encode(running).decode())

    def _stop_left_behind(self) -> None:
        """Stop, in fresh actors, what was being carried out when everything here was killed."""
        path = self._store.path / CARRIED_OUT
        try:
            left = msgspec.json.decode(path.read_bytes(), type=list[CarriedOut])
        except FileNotFoundError:
            return
        except (OSError, msgspec.MsgspecError) as error:
            self._record("note", text=f"{CARRIED_OUT} cannot be read: {error}")
            return
        for one in left:
            died = Ended("outcome_unknown", "the robot's command process was killed")
            task = Task(str(self._folder.path), one.action, one.parameters, after=died)
            try:
                actor = SupervisedActor(task)
            except (OSError, UsageError) as error:
                self._record("note", id=one.id, text=f"{one.action} was not stopped: {error}")
                continue
            while (outcome := actor.wait(_TICK_S)) is None:
                self._notifier.alive(lambda: "stopping what was left running")
            self._record("stopped", id=one.id, action=one.action, text=outcome.reason)
        path.unlink(missing_ok=True)

    def _site_state(self) -> SiteState:
        now_ns = self._clock.boot_ns()
        waiting = None
        if self._asked is not None and self._asked[0].command is not None:
            asked, since_ns = self._asked
            command = self._asked[0].command
            waiting = WaitingMotion(
                command.id, command.action, command.parameters, asked.person, asked.code,
                max(0.0, CONFIRM_S - (now_ns - since_ns) / NS),
            )  # fmt: skip
        running = [
            RunningAction(
                command_id, one.command.action, one.person, (now_ns - one.since_ns) / NS, one.report
            )
            for command_id, one in self._acting.items()
        ]
        return SiteState(self._gate.lease(), waiting, running, self._link is not None)

    # -- the record

    def _record_decision(self, decision: Decision) -> None:
        answer, command = decision.answer, decision.command
        about = {} if command is None else {
            "action": command.action, "parameters": command.parameters, "risk": command.risk,
            "issuer": command.issuer, "run": command.run, "step": command.step,
        }  # fmt: skip
        state = decision.kind if answer is None else answer.state
        # what a server can cause without end
        is_aside = state in ("note", "refused") or decision.text == CAME_AGAIN
        if is_aside and self._asides.take_one(self._clock.boot_ns() / NS):
            self._unrecorded += 1
            return
        result = "" if answer is None else answer.result
        self._record(
            state,
            id=decision.id,
            text=decision.text,
            person=decision.person,
            result=result,
            **about,
        )

    def _record(self, state: str, **values: str) -> None:
        """Write a record on ``amberbox/command``; without the disk only the log has it."""
        if values.get("text"):
            self._out(values["text"] if state == "note" else f"{state}: {values['text']}")
        record = {"robot": self._folder.robot.id, "state": state, **values}
        row = EncodedRecord(channels.COMMAND, msgspec.json.encode(record))
        with suppress(OSError):
            self._journal.append([row], urgent=True)
