"""The command process of a robot (``amberbox act FOLDER``): the gate, its log, and the actors.

It decides about commands of the server and lets actors carry them out, records both on the channel
``amberbox/command``, and ends every motion when it ends itself. The supervisor keeps it running;
the link process passes the server's frames to it (``agent.command_socket``).
"""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from amberbox.agent.actor import Ended, Task
from amberbox.agent.actor_supervisor import ActorProcess, Outcome, SupervisedActor
from amberbox.agent.command_gate import CONFIRM_S, CommandGate, Decision
from amberbox.agent.command_log import CommandLogFile
from amberbox.agent.command_socket import (
    Announcement,
    Answers,
    Challenge,
    FromGate,
    LinkBegins,
    LinkEnds,
    RunningAction,
    SiteAborts,
    SiteAsks,
    SiteConfirms,
    SiteState,
    SocketClient,
    SocketServer,
    ToGate,
    WaitingMotion,
)
from amberbox.agent.command_trust import CommandTrust, read_trust, trust_path
from amberbox.blackbox.journal import channels
from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.store.derived_journal import DerivedJournal, EncodedRecord
from amberbox.blackbox.store.journal_reader import previous_chain
from amberbox.blackbox.store.store import Store
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.command import Command, CommandAnswer, LeaseState, Risk
from amberbox.core.errors import UsageError
from amberbox.core.files import replace_file
from amberbox.core.systemd import Notifier
from amberbox.experiments.action import (
    FOLDER,
    DeclaredAction,
    announcement,
    check_parameters,
    read_actions,
)
from amberbox.link import limits
from amberbox.link.frames import (
    AnsweredFrame,
    CommandsFrame,
    LeaseFrame,
    RevokedFrame,
    ServerCommandFrame,
)

WRITER = "act"
LOG_FILE = "commands.log"
CARRIED_OUT = "acting.json"
_TICK_S = 0.05
_MINT_S = 10.0
_LOOK_S = 2.0
_END_S = 8.0


class FolderActions:
    """The actions that a robot folder declares, read again when its files change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stamp: Any = None
        self._actions: Mapping[str, DeclaredAction] = {}

    def changed(self) -> bool:
        """Read them if the files have changed; return whether they have."""
        stamp = sorted(_stamps(self._folder / FOLDER))
        if stamp == self._stamp:
            return False
        self._stamp, self._actions = stamp, read_actions(self._folder)[0]
        return True

    def risk(self, action: str) -> Risk | None:
        """Return the risk of an action; None for one that is not declared."""
        found = self._actions.get(action)
        return None if found is None else found.options.risk

    def problem(self, action: str, parameters: str) -> str:
        """Return what is wrong with parameters (JSON text); empty where nothing is."""
        try:
            check_parameters(self._actions[action], parameters)
        except UsageError as error:
            return error.what
        return ""

    def announcement(self) -> bytes:
        """Return what a server may know of them, as JSON; nothing where it is too large."""
        text = announcement(self._folder).encode()
        return text if len(text) <= limits.ACTIONS_BYTES else b'{"actions": []}'


def _stamps(folder: Path) -> list[tuple[str, int, int]]:
    found = []
    with suppress(OSError):
        for entry in os.scandir(folder):
            with suppress(OSError):
                about = entry.stat()
                found.append((entry.name, about.st_mtime_ns, about.st_size))
    return found


@dataclass(slots=True)
class _Acting:
    """An actor at work."""

    command: Command
    person: str
    actor: SupervisedActor
    since_ns: int
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
        self._actions = FolderActions(folder.path)
        self._actions.changed()
        self._log = CommandLogFile(store.path / LOG_FILE)
        self._gate = CommandGate(
            folder.robot.id, self._log, self._clock, self._trust, self._actions
        )
        self._journal = DerivedJournal(
            store, WRITER, robot=folder.robot.id, config_hash=folder.config_hash,
            clock=self._clock, chain=lambda: previous_chain(store, WRITER),
        )  # fmt: skip
        self._socket = SocketServer(store.path)
        self._link: SocketClient | None = None
        self._acting: dict[str, _Acting] = {}
        self._spare: ActorProcess | None = None
        self._asked: tuple[Decision, int] | None = None
        self._lease = LeaseState()
        self._minted_ns = self._looked_ns = 0

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
        self._notifier.ready()
        while not stop.is_set():
            self.turn(_TICK_S)
        self._notifier.stopping("stopping what runs")
        self._do(self._gate.abort("", "the end of the command process"))
        end_ns = self._clock.boot_ns() + int(_END_S * NS)
        while self._acting and self._clock.boot_ns() < end_ns:
            self.turn(_TICK_S)
        self.close()

    def close(self) -> None:
        """Close everything; actors that still run stop by themselves."""
        if self._spare is not None:
            self._spare.close()
        self._socket.close()
        self._journal.close()
        self._log.close()

    def turn(self, wait_s: float) -> None:
        """Wait for something to do, at most so long, and do it."""
        watched = [fd for acting in self._acting.values() for fd in acting.actor.filenos()]
        select.select([*self._socket.filenos(), *watched], [], [], wait_s)
        for client, message in self._socket.received():
            self._receive(client, message)
        if self._link is not None and self._link.is_closed:
            self._link = None
        for command_id, acting in list(self._acting.items()):
            outcome = acting.actor.step()
            if outcome is not None:
                self._ended(command_id, outcome)
        self._do(self._gate.step())
        self._watch_lease()
        self._mint()
        self._look_at_actions()
        self._notifier.alive(self._in_words)

    def _in_words(self) -> str:
        acting = ", ".join(one.command.action for one in self._acting.values())
        return f"carrying out {acting}" if acting else "waiting for commands"

    # -- what comes

    def _receive(self, client: SocketClient, message: ToGate) -> None:
        if isinstance(message, SiteAsks | SiteConfirms | SiteAborts):
            self._handle_site(message)
            client.send(self._site_state())
        elif isinstance(message, LinkBegins):
            self._link, self._minted_ns = client, 0
            self._send(Announcement(self._actions.announcement()))
            self._send_answers(self._gate.unanswered())
        elif isinstance(message, LinkEnds):
            self._link = None
        else:
            self._handle_server(message)

    def _handle_site(self, message: SiteAsks | SiteConfirms | SiteAborts) -> None:
        if isinstance(message, SiteConfirms):
            self._do(self._gate.confirmed(message.code, on_site=message.on_site))
        elif isinstance(message, SiteAborts):
            self._do(self._gate.abort(message.target, message.who or "somebody at the robot"))

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
        else:
            self._do(self._gate.abort(frame.command or frame.run, "the server"))

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

    def _watch_lease(self) -> None:
        """Tell the server when the lease has another holder."""
        state = self._gate.lease()
        if (state.number, state.holder) != (self._lease.number, self._lease.holder):
            self._lease = state
            self._send_challenge(state)

    def _mint(self) -> None:
        due_ns = self._minted_ns + int(_MINT_S * NS)
        if self._link is not None and (not self._minted_ns or self._clock.boot_ns() >= due_ns):
            self._send_challenge(self._gate.lease())

    def _send_challenge(self, lease: LeaseState) -> None:
        if self._link is not None:
            self._minted_ns = self._clock.boot_ns()
            self._send(Challenge(self._gate.mint(), lease))

    def _look_at_actions(self) -> None:
        now_ns = self._clock.boot_ns()
        if now_ns - self._looked_ns >= _LOOK_S * NS:
            self._looked_ns = now_ns
            if self._actions.changed():
                self._send(Announcement(self._actions.announcement()))

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
                self._send(Answers([decision.answer]))
            elif decision.kind == "ask":
                self._asked = decision, self._clock.boot_ns()
            self._record_decision(decision)

    def _forget_asked(self, command_id: str) -> None:
        if self._asked is not None and self._asked[0].id == command_id:
            self._asked = None

    def _start(self, command: Command, person: str) -> None:
        task = Task(str(self._folder.path), command.action, command.parameters)
        now_ns = self._clock.boot_ns()
        try:
            self._note_carried_out([*self._acting.values()], command)
            spare, self._spare = self._spare, None
            actor = SupervisedActor(task, self._reporter(command.id), spare)
        except (OSError, UsageError) as error:
            self._do(self._gate.ended(command.id, "failed", f"it could not be started: {error}"))
            return
        self._acting[command.id] = _Acting(command, person, actor, now_ns)
        self._spare = self._new_actor()

    def _reporter(self, command_id: str) -> Callable[[str], None]:
        def report(text: str) -> None:
            if command_id in self._acting:
                self._acting[command_id].report = text
            self._record("report", id=command_id, text=text)

        return report

    def _new_actor(self) -> ActorProcess | None:
        """Start an actor that waits for a task, so that the next command begins at once."""
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
