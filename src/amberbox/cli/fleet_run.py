"""A run on a robot, by its server, in a terminal: its steps, its signatures, codes, an abort."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from amberbox.cli._output import print_lines, print_notes
from amberbox.cli.experiment_terminal import Terminal, order_text
from amberbox.cli.fleet_command import key_named, state_text
from amberbox.cli.sign import why_not_signed
from amberbox.client.commanding import sign_line
from amberbox.core.command import CommandError
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.safe_text import one_line
from amberbox.experiments.experiment import FieldOptions, PersonStepOptions, Role
from amberbox.experiments.local import Answer, Confirmation, Order, Remark, Said
from amberbox.experiments.procedure import Step
from amberbox.experiments.run import PersonTask, RobotTask, RunEvent
from amberbox.experiments.unit_tests import UnitTestResult

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import CommandLine, FormField, PersonStep, RobotStep, RunDetail
    from amberbox.client.signing_key import SigningKey

_LOOK_S = 0.5
_PRESENT_S = 10.0
_ROLES = ("technician", "operator")
# Behind the id of a step of the robot: its code is asked for
_CODE = "#code"


@dataclass(frozen=True)
class Signer:
    """The key that signs the commands of a run; unless ``unasked`` each is asked for."""

    key: SigningKey
    ttl_s: int = 20
    unasked: bool = False


def signer_of(args: argparse.Namespace) -> Signer | None:
    """Return the key that signs, if ``--sign`` is given."""
    if not args.sign:
        if args.yes or args.key:
            raise UsageError("--yes and --key go with --sign on a server", "--sign --yes")
        return None
    return Signer(key_named(args.key), unasked=args.yes)


@dataclass
class FollowedRun:
    """Follows a run to its end and takes part in it; ``roles`` are those whose steps are done here.

    Without a ``signer`` its commands wait for somebody else's signature.
    """

    fleet: Fleet
    robot: str
    id: str
    signer: Signer | None = None
    roles: Sequence[str] = _ROLES
    show: Callable[[str], None] = lambda text: print_lines([text])
    interrupted: bool = False
    _names: dict[str, str] = field(default_factory=dict)
    _done: set[str] = field(default_factory=set)
    _signed: set[str] = field(default_factory=set)
    _waiting: dict[str, CommandLine] = field(default_factory=dict)
    _seen: int = 0
    _present_s: float = 0.0
    _said: dict[str, str] = field(default_factory=dict)

    def follow(self) -> RunDetail:
        """Take part until the run is judged; Ctrl-C aborts it, or ends the wait for its verdict."""
        terminal = Terminal(
            lambda path: self._names.get(path, path), sys.stdin.fileno(),
            self.show, self._question, None,
        )  # fmt: skip
        while True:
            try:
                detail = self._step(terminal)
                if detail is not None:
                    return detail
            except KeyboardInterrupt:
                self.interrupted = True
                detail = self._abort()
                if detail is not None:
                    return detail

    def _step(self, terminal: Terminal) -> RunDetail | None:
        """Look at the run, and do what is wanted meanwhile; return it when it is over."""
        from amberbox.client.transport import UnreachableError

        try:
            detail = self.fleet.run(self.robot, self.id)
            self._note("server", "")
            self._tell(terminal, detail)
            if detail.run.is_over:
                return detail
            if detail.run.state == "judging":
                self._note("", "waits for its record; Ctrl-C leaves it, its verdict is kept")
                time.sleep(_LOOK_S)
                return None
            self._be_present(detail)
            terminal.show(self._tasks(detail), self._motions(detail))
        except UnreachableError as error:  # the server may be starting again: the run goes on there
            self._note("server", f"{error.what}: waiting for it")
            time.sleep(_LOOK_S)
            return None
        said = terminal.said(_LOOK_S)
        if said is not None:
            try:
                self._heed(said)
            except AmberboxError as error:
                terminal.refuse(error)
        return None

    def _abort(self) -> RunDetail | None:
        """Abort the run; return it if nothing more is to be waited for."""
        from amberbox.client.transport import UnreachableError

        try:
            detail = self.fleet.run(self.robot, self.id)
            if detail.run.state == "judging" or detail.run.is_over:
                return detail
            self.fleet.abort_run(self.robot, self.id, "Ctrl-C")
        except UnreachableError as error:
            hint = "at the robot: amberbox confirm FOLDER --abort; without its server it stops soon"
            raise UnreachableError(f"{error.what}: the run is not aborted", hint) from error
        return None

    def _note(self, about: str, text: str) -> None:
        """Print a note, unless it is what was printed last about this."""
        if text and text != self._said.get(about):
            print_notes([one_line(text)])
        self._said[about] = text

    def _tell(self, terminal: Terminal, detail: RunDetail) -> None:
        from amberbox.client.models import time_ns

        for one in detail.events:
            self._names[one.element] = one.name
        for one in detail.events[self._seen :]:
            terminal.tell(
                RunEvent(
                    one.number, time_ns(one.at), one.kind, one.element, one.task,  # type: ignore[arg-type]  # as sent
                    one.who, one.text, dict(one.values),
                )
            )  # fmt: skip
            if one.kind == "done" and one.task not in self._done:
                self.show(f"-- {one_line(one.name)}: done by {one_line(one.who)}")
        self._seen = len(detail.events)

    def _be_present(self, detail: RunDetail) -> None:
        """State every few seconds that somebody is here, in the roles that the run needs."""
        now_s = time.monotonic()
        if now_s - self._present_s < _PRESENT_S and self._present_s:
            return
        self._present_s = now_s
        for role in self.roles:
            if role in (*detail.needs, "technician"):
                with suppress(UsageError):  # a role that one does not have
                    self.fleet.be_present(self.robot, self.id, role)

    # -- what waits

    def _tasks(self, detail: RunDetail) -> list[PersonTask]:
        mine = [step for step in detail.people if step.mine and step.role in self.roles]
        for step in detail.people:
            if step not in mine:
                self._note(step.task, f"{step.name}: waits for a {step.role}")
        return [_person_task(step) for step in mine] + [
            _code_task(step) for step in detail.robot if step.confirm
        ]

    def _motions(self, detail: RunDetail) -> list[RobotTask]:
        """Return the steps whose commands are to be signed here; note what the others wait for."""
        found = []
        for step in detail.robot:
            if step.waits:
                self._note(step.task, f"{step.name}: {step.waits}")
            elif step.state == "unsigned" and self.signer is None:
                page = f"{self.fleet.url}/robots/{self.robot}"
                self._note(step.task, f"{step.name} waits for a signature: amberbox sign {page} "
                           f"--run {self.id}")  # fmt: skip
            elif step.state == "unsigned" and step.command not in self._signed:
                found += self._to_sign(step)
            elif step.state == "sent" and not step.confirm:
                self._note_confirmation(step)
        return found

    def _to_sign(self, step: RobotStep) -> list[RobotTask]:
        """Return a step whose command may be signed, as it was given to the server."""
        assert self.signer is not None
        line = self.fleet.command(self.robot, step.command)
        state = self.fleet.actions(self.robot)
        wrong = why_not_signed(line, self.robot, state)
        if line.run != self.id or wrong:
            self._signed.add(line.id)
            self._note(step.task, f"not signed: {wrong or 'it is of another run'}")
            return []
        if state.lease.run != self.id or not state.challenge:
            self._note(step.task, f"{self.robot} is not held for this run, or takes no commands "
                       "now")  # fmt: skip
            return []
        if self.signer.unasked:
            self._sign(line)
            return []
        self._waiting[step.task] = line
        parameters = json.loads(line.parameters)
        shown = Step(step.element, step.name, "robot")
        return [RobotTask(step.task, shown, 0, line.action, parameters, None, None, line.id)]

    def _question(self, task: RobotTask) -> str:
        assert self.signer is not None
        risk = self._waiting[task.id].risk
        what = "the robot will move" if risk == "moves" else "the robot will act"
        return f"{what} ({order_text(task)}). Sign it with the key {self.signer.key.name}?"

    def _note_confirmation(self, step: RobotStep) -> None:
        state = self.fleet.actions(self.robot)
        if state.waiting == step.command and not state.by_code:
            what = "waits for its confirmation at the robot: press the button there"
            self._note(step.task, what)

    # -- what is said

    def _heed(self, said: Said) -> None:
        fleet, robot, run = self.fleet, self.robot, self.id
        if isinstance(said, Answer) and said.task.endswith(_CODE):
            code = str(said.values["code"])
            fleet.confirm_command(robot, said.task.removesuffix(_CODE), code)
        elif isinstance(said, Answer):
            self._done.add(said.task)
            fleet.complete_step(robot, run, said.task, said.values)
        elif isinstance(said, Confirmation) and said.is_free:
            self._sign(self._waiting[said.task])
        elif isinstance(said, Confirmation):
            fleet.withdraw_command(robot, self._waiting[said.task].id)
        elif isinstance(said, Remark) and said.task and not said.task.endswith(_CODE):
            fleet.note_deviation(robot, run, said.task, said.text)
        elif isinstance(said, Remark):
            fleet.note_run(robot, run, said.text)
        else:
            self._heed_order(said)

    def _heed_order(self, said: Order) -> None:
        if said.what == "pause":
            self.fleet.pause_run(self.robot, self.id, said.reason)
        elif said.what == "resume":
            self.fleet.resume_run(self.robot, self.id, said.reason)
        else:
            self.fleet.abort_run(self.robot, self.id, said.reason)

    def _sign(self, line: CommandLine) -> None:
        assert self.signer is not None
        lease = self.fleet.actions(self.robot).lease
        if lease.run != self.id:
            raise CommandError(f"{self.robot} is not held for this run any more")
        sign_line(self.fleet, self.robot, line, self.signer.key, lease.number, self.signer.ttl_s)
        self._signed.add(line.id)
        self.show(f"-- signed: {line.action} {one_line(line.parameters)}")


def _person_task(step: PersonStep) -> PersonTask:
    """Return a step of a person as a terminal shows it."""
    form = PersonStepOptions(
        text=step.text, expected=step.expected, deviation=step.deviation,
        fields={one.name: _field(one) for one in step.fields},
    )  # fmt: skip
    role: Role = "operator" if step.role == "operator" else "technician"
    return PersonTask(step.task, Step(step.element, step.name, role, step.lane, form), 0)


def _field(one: FormField) -> FieldOptions:
    values = {**msgspec.to_builtins(one), "choices": tuple(one.choices)}
    del values["name"]
    return FieldOptions(**values)


def _code_task(step: RobotStep) -> PersonTask:
    """Return the question for the code of a motion."""
    form = PersonStepOptions(
        text=f"{step.name}: the robot will move when its code is entered. It is shown at the robot",
        fields={"code": FieldOptions(kind="text", label="code")},
    )  # fmt: skip
    shown = Step(step.element, "Is the way free?", "operator", person=form)
    return PersonTask(f"{step.command}{_CODE}", shown, 0)


def unit_test_result(fleet: Fleet, detail: RunDetail) -> UnitTestResult:
    """Return how a unit test has ended; as an error where the robot has not told."""
    line = detail.run
    ordered = [one.values["command"] for one in detail.events if one.kind == "started"]
    for command in ordered:
        for answer in fleet.command(line.robot, str(command)).answers:
            with suppress(msgspec.MsgspecError):  # a robot wrote it
                return msgspec.json.decode(answer.result, type=UnitTestResult)
    began, ended = line.begun or line.created, line.ended or line.created
    reason = f"{run_text(line.state)}: {line.reason}" if line.reason else run_text(line.state)
    return UnitTestResult(line.name, "error", began, ended, 0.0, reason)


def run_text(state: str) -> str:
    """Return the state of a run in words."""
    return "waits for its record" if state == "judging" else state_text(state)
