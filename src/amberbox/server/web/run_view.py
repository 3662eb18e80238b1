"""What the pages of runs and tasks show of a run, and what their forms do to it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, TypeAlias

from starlette.datastructures import QueryParams

from amberbox.core.api import FormField, PersonStep, RobotStep, RunDetail, RunHappening, RunRole
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.svg import SvgElement
from amberbox.experiments.profile import Experiment
from amberbox.experiments.run import ElementState, element_states
from amberbox.experiments.step_list import OrderedStep, ordered_steps
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import HOLDING, StoredRun
from amberbox.server.services import commands, experiments
from amberbox.server.services.context import Caller, NotFoundError, Services
from amberbox.server.web.text import catalogue

FIELD: Final = "f."
"""What the names of a step's fields begin with in its form."""
_ANSWERS: Mapping[str, bool | None] = {"pass": True, "fail": False, "skip": None}
_LONGEST: Final = 2000

# What a step of the robot waits for, or does
Situation: TypeAlias = Literal[
    "requires", "starts", "unsigned", "sent", "code", "button", "accepted", "over"
]


@dataclass(frozen=True, slots=True)
class Typed:
    """What somebody has sent that was not accepted, to be shown again with the ``problem``."""

    task: str = ""
    fields: Mapping[str, str] = field(default_factory=dict)
    text: str = ""
    problem: AmberboxError | None = None
    done: str = ""


@dataclass(frozen=True, slots=True)
class ListedStep:
    """A line of the ordered list; ``place`` is 0 for what is no step of somebody."""

    about: OrderedStep
    place: int
    state: ElementState | None
    remarks: Sequence[RunHappening] = ()


@dataclass(frozen=True, slots=True)
class RobotStepView:
    """A step of the robot, what it waits for, and whether the caller may enter its code."""

    step: RobotStep
    situation: Situation
    may_confirm: bool = False


@dataclass(frozen=True, slots=True)
class RunView:
    """A run as its caller sees it."""

    robot: KnownRobot
    detail: RunDetail
    drawing: SvgElement | None
    steps: Sequence[ListedStep]
    robot_steps: Sequence[RobotStepView]
    plots: Sequence[str]
    may_step: bool
    may_start: bool
    role: RunRole | Literal[""]

    @property
    def is_on(self) -> bool:
        """Return whether it holds its robot."""
        return self.detail.run.state in HOLDING

    @property
    def is_open(self) -> bool:
        """Return whether it can be aborted."""
        return self.is_on or self.detail.run.state == "planned"

    @property
    def news(self) -> str:
        """Return what is told to people who do not see the page change."""
        text = catalogue().text
        run = self.detail.run
        if not self.is_on or not (self.detail.people or self.robot_steps):
            return text(f"runs.news.{run.state}", reason=run.reason)
        people = [
            text("runs.news." + ("mine" if one.mine else "theirs"), name=one.name, role=one.role)
            for one in self.detail.people
        ]
        robot = [
            text(f"runs.news.robot_{one.situation}", name=one.step.name) for one in self.robot_steps
        ]
        return " ".join([*people, *robot])

    def progress(self, element: str) -> tuple[int, int]:
        """Return the place of a step among all steps of people and robot, and their number."""
        total = max((one.place for one in self.steps), default=0)
        top = element.partition("/")[0]
        return next((one.place for one in self.steps if one.about.id == top), 0), total

    def remarks_of(self, task: str) -> list[RunHappening]:
        """Return the deviations that were noted against a step."""
        return [one for one in self.detail.events if one.task == task and one.kind == "deviation"]


def visible_run(fleet: Services, who: Caller, id: str) -> tuple[KnownRobot, StoredRun]:
    """Return a run with its robot; raises NotFoundError for one that the caller may not see."""
    with fleet.database.reading() as connection:
        stored = runs.find(connection, id)
        seen = {robot.id: robot for robot in who.robots(connection, "experiments.read")}
    if stored is None or stored.robot not in seen:
        raise NotFoundError("there is no such run, or not for you")
    return seen[stored.robot], stored


def run_view(fleet: Services, who: Caller, robot: KnownRobot, stored: StoredRun) -> RunView:
    """Return a run as its caller sees it."""
    detail = experiments.show_run(fleet, who, robot, stored.id)
    experiment = None
    if stored.kind == "experiment":
        experiment = fleet.runner.shelf.experiment(stored.sha256, stored.name)
    run = fleet.runner.register.read(stored)
    states = element_states(run.procedure, run.events) if run is not None else {}
    may_step = who.may("experiments.step", robot)
    return RunView(
        robot, detail,
        experiments.run_diagram(fleet, robot.id, stored.id, standalone=False)
        if experiment is not None else None,
        listed_steps(experiment, states, detail.events) if experiment is not None else [],
        [_robot_step(fleet, who, robot, step) for step in detail.robot],
        fleet.runner.shelf.procedure(stored).options.plots,
        may_step, who.may("experiments.write", robot), own_role(who, robot) if may_step else "",
    )  # fmt: skip


def own_role(who: Caller, robot: KnownRobot) -> RunRole:
    """Return the role in which somebody who may do steps looks at a run."""
    return "technician" if who.may("experiments.write", robot) else "operator"


def listed_steps(
    experiment: Experiment, states: Mapping[str, ElementState] | None = None,
    events: Sequence[RunHappening] = (),
) -> list[ListedStep]:  # fmt: skip
    """Return the ordered list of an experiment; steps of somebody have a place from 1 on."""
    found: list[ListedStep] = []
    place = 0
    for step in ordered_steps(experiment):
        is_step = bool(step.who) or step.id in experiment.calls
        place += is_step
        state = (states or {}).get(step.id)
        remarks = [one for one in events if one.kind == "deviation" and one.element == step.id]
        found.append(ListedStep(step, place if is_step else 0, state, remarks))
    return found


def in_page(drawing: SvgElement) -> SvgElement:
    """Return a diagram for a page, where only the rules of diagrams are for it."""
    kept = ((name, "bpmn" if name == "class" else value) for name, value in drawing.attributes)
    return replace(drawing, attributes=tuple(kept))


def _robot_step(fleet: Services, who: Caller, robot: KnownRobot, step: RobotStep) -> RobotStepView:
    contact = fleet.links.contact(robot.id)
    at_robot = contact is not None and step.command and contact.waiting.id == step.command
    situation: Situation = "over"
    if not step.command:
        situation = "requires" if step.waits else "starts"
    elif step.state == "unsigned":
        situation = "unsigned"
    elif at_robot:
        situation = "code" if step.confirm else "button"
    elif step.state in ("waiting", "sent"):
        situation = "sent"
    elif step.state == "accepted":
        situation = "accepted"
    return RobotStepView(step, situation, who.may("commands.confirm", robot))


# -- what people send


_NEEDS: Mapping[str, str] = {"begin": "experiments.write", "confirm": "commands.confirm"}


async def act_on(
    fleet: Services, who: Caller, robot: KnownRobot, stored: StoredRun, fields: QueryParams
) -> str:
    """Do what a form asks for; return what was done. Raises AmberboxError where it cannot be."""
    what = fields.get("do", "")
    if not who.may(_NEEDS.get(what, "experiments.step"), robot):
        raise UsageError("you may not do this", "ask an admin for the role")
    text = fields.get("text", "")[: _LONGEST + 1]
    task = fields.get("task", "")
    about = (fleet, who, robot, stored.id)
    if what == "begin":
        await experiments.begin(*about)
    elif what == "abort":
        await experiments.abort(*about, text[:300])
    elif what == "confirm":
        await commands.confirm(
            fleet, who, robot.id, fields.get("command", ""), fields.get("code", "").strip()
        )
    elif what in ("pause", "resume"):
        await asyncio.to_thread(experiments.pause, *about, text[:300], on=what == "pause")
    elif what == "note":
        await asyncio.to_thread(experiments.note, *about, text)
    elif what == "deviation":
        await asyncio.to_thread(experiments.deviation, *about, task, text)
    elif what == "complete":
        await asyncio.to_thread(_complete, *about, task, fields)
    elif what == "present":
        role: RunRole = "technician" if fields.get("role") == "technician" else "operator"
        await asyncio.to_thread(experiments.present, *about, role)
    else:
        raise UsageError("this form asks for nothing that is known", "load the page again")
    return what


def _complete(
    fleet: Services, who: Caller, robot: KnownRobot, run: str, task: str, fields: QueryParams
) -> None:
    detail = experiments.show_run(fleet, who, robot, run)
    step = next((one for one in detail.people if one.task == task), None)
    values = form_values(step, fields) if step is not None else {}
    experiments.complete(fleet, who, robot, run, task, values)
    role: RunRole = "technician" if step is not None and step.role == "technician" else "operator"
    fleet.runner.presence.note(run, role, who.person)


def form_values(step: PersonStep, fields: QueryParams) -> dict[str, Any]:
    """Return the values of a step's form; those that cannot be read stay texts, to be refused."""
    found: dict[str, Any] = {}
    for one in step.fields:
        sent = fields.get(f"{FIELD}{one.name}")
        if sent is not None and (sent.strip() or one.kind == "text"):
            found[one.name] = _value(one, sent)
    return found


def _value(one: FormField, sent: str) -> Any:
    if one.kind == "pass_fail":
        return _ANSWERS.get(sent, sent)
    if one.kind == "confirm":
        return True
    if one.kind == "number":
        try:
            return float(sent.strip().replace(",", "."))
        except ValueError:
            return sent
    if one.kind == "text":
        return sent.replace("\r\n", "\n") if sent.strip() else None
    return sent


def typed_of(fields: QueryParams, problem: AmberboxError | None, done: str) -> Typed:
    """Return what was sent in the form of a step, to be shown again."""
    values = {
        name.removeprefix(FIELD): value[: _LONGEST + 1]
        for name, value in fields.items()
        if name.startswith(FIELD)
    }
    text = "" if done else fields.get("text", "")[: _LONGEST + 1]
    return Typed(fields.get("task", ""), values, text, problem, done)
