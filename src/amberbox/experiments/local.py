"""A run at the robot: its actions, the person at the terminal, and the clock, around the state.

The state is saved before anything is done, so that a run that was ended at any instant can be
continued without doing an action twice.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.derived_journal import ChannelValues
from amberbox.core.clock import NS
from amberbox.core.command import new_command_id
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Expression, Value
from amberbox.core.files import below, replace_file
from amberbox.experiments.profile import SUFFIX, Experiment, read_experiment
from amberbox.experiments.run import ExperimentRun, PersonTask, RobotEnd, RobotTask, RunEvent

RUNS = "experiments"
STATE, REPORT, NAME, FILES = "state.json", "report.json", "experiment", "files"
WRITER = "experiment"


class ActionOutcome(Protocol):
    """How an action has ended; ``result`` is the JSON text of an object, or empty."""

    @property
    def state(self) -> str:
        """``done``, ``failed``, ``refused``, ``aborted``, ``outcome_unknown``..."""

    @property
    def reason(self) -> str:
        """Why."""

    @property
    def result(self) -> str:
        """What came of it."""


class ActionAtWork(Protocol):
    """An action that the robot carries out."""

    def renew(self) -> None:
        """State that it is still wanted; once a second at least."""

    def wait(self, seconds: float, /) -> ActionOutcome | None:
        """Wait until there is something new, or so long; return the outcome, if any."""

    def abort(self, reason: str, /) -> None:
        """Have it stopped; its outcome comes all the same."""


class RobotPort(Protocol):
    """The actions of the robot."""

    def begin(
        self, action: str, parameters: str, timeout_s: float | None, report: Callable[[str], None]
    ) -> ActionAtWork:
        """Begin an action; raises AmberboxError if the robot does not take it."""

    def timeout_s(self, action: str) -> float:
        """Return its declared longest run; raises UsageError for an action that is not declared."""

    def moves(self, action: str) -> bool:
        """Return whether somebody has to say that the way is free."""


@dataclass(frozen=True)
class Answer:
    """A step that a person has done."""

    task: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Confirmation:
    """What a person said of a motion that is about to begin."""

    task: str
    is_free: bool


@dataclass(frozen=True)
class Remark:
    """A deviation in a step, or a note without one."""

    text: str
    task: str = ""


@dataclass(frozen=True)
class Order:
    """Abort, pause, or go on."""

    what: str
    reason: str = ""


Said: TypeAlias = Answer | Confirmation | Remark | Order


class PersonPort(Protocol):
    """The person at the robot; nothing here waits longer than it is told."""

    def show(self, tasks: Sequence[PersonTask], motions: Sequence[RobotTask]) -> None:
        """Show what waits: steps, and motions that need a free way."""

    def said(self, seconds: float) -> Said | None:
        """Return what the person said, after so many seconds at the latest."""

    def tell(self, event: RunEvent) -> None:
        """Show something that has happened."""

    def refuse(self, error: AmberboxError) -> None:
        """Show why what the person said cannot be done."""


LOOK_S = 0.2


@dataclass
class LocalRunner:
    """Carries a run on, one ``step`` after the other, until ``run.is_closed``.

    ``keep`` stores the state and the events that are new, before what follows from them is done.
    ``value`` evaluates an expression over the robot's live values and the run's variables.
    """

    run: ExperimentRun
    robot: RobotPort
    person: PersonPort
    who: str
    keep: Callable[[bytes, Sequence[RunEvent]], None]
    value: Callable[[Expression, Mapping[str, Value]], Value]
    now_ns: Callable[[], int]
    must_confirm: bool = True
    _at_work: dict[str, ActionAtWork] = field(default_factory=dict)
    _until_ns: dict[str, int] = field(default_factory=dict)
    _free: set[str] = field(default_factory=set)
    _seen: int = 0

    def resume(self) -> None:
        """Give up the actions that an earlier process had begun: nobody knows how they ended."""
        self._seen = len(self.run.events)
        reason = "the process that carried out the run has ended"
        lost = [task.id for task in self.run.running()]
        lost += [order.task for order in self.run.stop_orders()]
        for task in lost:
            self.run.robot_ended(task, "outcome_unknown", self.now_ns(), reason)
        self._save()

    def step(self) -> None:
        """Do what is due, and wait a moment for the person or the robot."""
        self.run.tick(self.now_ns())
        self._save()
        for order in self.run.stop_orders():
            self._at_work[order.task].abort(order.reason)
        for task in self.run.robot_tasks():
            if task.id in self._free or not self._needs_confirmation(task):
                self._start(task)
        self._attend()
        self._save()
        motions = [t for t in self.run.robot_tasks() if t.id not in self._free]
        self.person.show(self.run.person_tasks(), motions)
        said = None if self.run.is_closed else self.person.said(LOOK_S)
        if said is not None:
            try:
                self._heed(said)
            except UsageError as error:
                self.person.refuse(error)
        self._save()

    def abort(self, reason: str) -> None:
        """Abort the run."""
        self.run.abort(self.who, reason, self.now_ns())
        self._save()

    def _save(self) -> None:
        new = self.run.events[self._seen :]
        if new:
            self._seen += len(new)
            self.keep(self.run.state(), new)
            for event in new:
                self.person.tell(event)

    def _needs_confirmation(self, task: RobotTask) -> bool:
        with suppress(UsageError):  # one that is not declared: it is refused when it begins
            return self.must_confirm and self.robot.moves(task.action)
        return False

    def _start(self, task: RobotTask) -> None:
        why = self._unmet(task)
        if why:
            self.run.robot_ended(task.id, "requirement", self.now_ns(), why)
            self._save()
            return
        self.run.robot_started(task.id, new_command_id(), self.now_ns())
        self._save()
        parameters = json.dumps(task.parameters)
        try:
            limit_s = self.robot.timeout_s(task.action)
            limit_s = limit_s if task.timeout_s is None else min(limit_s, task.timeout_s)
            report = self._reporter(task.id)
            self._at_work[task.id] = self.robot.begin(task.action, parameters, limit_s, report)
            self._until_ns[task.id] = self.now_ns() + int(limit_s * NS)
        except AmberboxError as error:
            self.run.robot_ended(task.id, "refused", self.now_ns(), error.what)

    def _reporter(self, task: str) -> Callable[[str], None]:
        return lambda text: self.run.robot_report(task, text, self.now_ns())

    def _unmet(self, task: RobotTask) -> str:
        """Return why a step may not begin; empty if it may."""
        if task.requires is None:
            return ""
        try:
            is_met = self.value(task.requires, self.run.variables)
        except AmberboxError as error:
            return error.what
        return "" if is_met is True else (
            f"{task.requires.text} is {'unknown' if is_met is None else 'not true'}"
        )  # fmt: skip

    def _attend(self) -> None:
        """Renew what is at work, stop what takes too long, and note what has ended."""
        for task, action in list(self._at_work.items()):
            is_late = self.now_ns() >= self._until_ns[task]
            try:
                action.renew()
                if is_late:
                    action.abort("it takes too long")
                outcome = action.wait(0.0)
            except AmberboxError as error:
                self._end(task, "outcome_unknown", error.what, {})
                continue
            if outcome is not None:
                state, reason = _end_of(outcome, is_late)
                result = msgspec.json.decode(outcome.result) if outcome.result else {}
                self._end(task, state, reason, result if isinstance(result, dict) else {})

    def _end(self, task: str, state: RobotEnd, reason: str, result: Mapping[str, Any]) -> None:
        del self._at_work[task], self._until_ns[task]
        self.run.robot_ended(task, state, self.now_ns(), reason, result)

    def _heed(self, said: Said) -> None:
        now_ns = self.now_ns()
        if isinstance(said, Answer):
            self.run.complete(said.task, said.values, self.who, now_ns)
        elif isinstance(said, Confirmation) and said.is_free:
            self._free.add(said.task)
            self.run.note(f"the way is free for {said.task}", self.who, now_ns)
        elif isinstance(said, Confirmation):
            self.run.robot_ended(said.task, "refused", now_ns, "the way is not free")
        elif isinstance(said, Remark) and said.task:
            self.run.deviation(said.task, said.text, self.who, now_ns)
        elif isinstance(said, Remark):
            self.run.note(said.text, self.who, now_ns)
        elif said.what == "pause":
            self.run.pause(self.who, said.reason, now_ns)
        elif said.what == "resume":
            self.run.resume(self.who, said.reason, now_ns)
        else:
            self.run.abort(self.who, said.reason, now_ns)


_STATES: Mapping[str, RobotEnd] = {
    "done": "done", "failed": "failed", "refused": "refused", "aborted": "aborted",
    "outcome_unknown": "outcome_unknown", "expired": "refused",
}  # fmt: skip


def _end_of(outcome: ActionOutcome, is_late: bool) -> tuple[RobotEnd, str]:
    state = _STATES.get(outcome.state, "outcome_unknown")
    if is_late and state in ("failed", "aborted"):
        return "timeout", outcome.reason
    return state, outcome.reason


def row_of(run: ExperimentRun, event: RunEvent, robot: str) -> ChannelValues:
    """Return an event as a record on the channel ``amberbox/experiment``."""
    return channels.EXPERIMENT, {
        "run": run.id,
        "experiment": run.procedure.name,
        "sha256": run.procedure.sha256,
        "robot": robot,
        "number": event.number,
        "at_ns": event.at_ns,
        "kind": event.kind,
        "element": event.element,
        "task": event.task,
        "who": event.who,
        "text": event.text,
        "values": msgspec.json.encode(event.values).decode(),
    }


@dataclass(frozen=True)
class RunFolder:
    """What is kept of a run at the robot: ``STORE/experiments/RUN``."""

    path: Path

    @classmethod
    def make(cls, store: Path, run_id: str, experiment: Experiment) -> RunFolder:
        """Make the folder of a new run, with a copy of the files of its experiment."""
        folder = cls(store / RUNS / run_id)
        files = folder.path / FILES
        files.mkdir(parents=True)
        for file in experiment.all_files:
            (files / file.name).write_bytes(file.read_bytes())
        (folder.path / NAME).write_text(experiment.path.name.removesuffix(SUFFIX))
        return folder

    @classmethod
    def find(cls, store: Path, run_id: str) -> RunFolder:
        """Return the folder of a run; raises UsageError if there is none."""
        path = below(store / RUNS, run_id)
        if not (path / STATE).is_file():
            known = ", ".join(folder.path.name for folder in run_folders(store)[-5:])
            hint = f"the last ones: {known}" if known else "amberbox experiment run FOLDER NAME"
            raise UsageError(f"there is no run '{run_id[:64]}'", hint)
        return cls(path)

    def save(self, state: bytes) -> None:
        """Save the state of the run; it survives a power cut."""
        replace_file(self.path / STATE, state.decode())

    def state(self) -> bytes:
        """Return the saved state."""
        return (self.path / STATE).read_bytes()

    def experiment(self) -> Experiment:
        """Read the experiment as it was when the run began; raises UsageError if it cannot be."""
        path = self.path / FILES / f"{(self.path / NAME).read_text()}{SUFFIX}"
        experiment, problems = read_experiment(path)
        if experiment is None:
            errors = [problem for problem in problems if problem.is_error]
            raise UsageError(f"the experiment of the run cannot be read: {errors[0]}")
        return experiment


def run_folders(store: Path) -> list[RunFolder]:
    """Return the runs that are kept in a store, by their names."""
    return [RunFolder(path.parent) for path in sorted((store / RUNS).glob(f"*/{STATE}"))]
