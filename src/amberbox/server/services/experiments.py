"""Experiments, unit tests and their runs, for API and pages: list, upload, start, take part, end.

A page shows the picture of a step with ``<img src="/api/v1/robots/R/runs/RUN/files/NAME">``, of an
experiment that does not run ``/api/v1/robots/R/experiments/EXPERIMENT/files/NAME``: ``picture``.
Whether the caller may do it is checked before; which steps they may do, here.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
from sqlalchemy import Connection

from amberbox.blackbox.robot_folder.folder import ROBOT_FILE
from amberbox.core.api import (
    ExperimentLine,
    FormField,
    PersonStep,
    Present,
    RobotStep,
    RunDetail,
    RunHappening,
    RunLine,
    RunRole,
    RunState,
    UnitTestLine,
)
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.svg import SvgElement
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.experiments.action import accept_values, read_announcement
from amberbox.experiments.drawing import draw_bpmn
from amberbox.experiments.experiment import Role
from amberbox.experiments.run import (
    TEST_PREFIX,
    ExperimentRun,
    PersonTask,
    RobotTask,
    element_states,
)
from amberbox.link.frames import AbortFrame
from amberbox.server import commands
from amberbox.server.accounts.permissions import Principal
from amberbox.server.accounts.permissions import Role as AccountRole
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.bus import ServerChange
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import HOLDING, LostRunError, RunOrder, StoredRun
from amberbox.server.experiments.shelf import FoundExperiment
from amberbox.server.knowledge.questions import AskRunAnswers
from amberbox.server.schema import ROBOT
from amberbox.server.services.commands import action_parameter
from amberbox.server.services.context import Caller, NotFoundError, NotNowError, Services
from amberbox.server.services.knowledge import (
    answer_tests,
    ask_worker,
    decode_answer,
    given_answers,
)

_LEAST: Mapping[Role, AccountRole] = {
    "technician": AccountRole.TECHNICIAN, "operator": AccountRole.OPERATOR,
}  # fmt: skip


# -- what there is


def list_experiments(fleet: Services, robot: str = "") -> list[ExperimentLine]:
    """List the experiments that a robot can run, by name; without a robot those uploaded here."""
    shelf = fleet.runner.shelf
    found = shelf.of_robot(robot) if robot else shelf.uploaded()
    return [experiment_line(one) for one in found]


def show_experiment(fleet: Services, robot: str, name: str) -> ExperimentLine:
    """Show an experiment; raises UsageError where there is none of this name."""
    return experiment_line(fleet.runner.shelf.find(robot, name))


def experiment_line(found: FoundExperiment) -> ExperimentLine:
    """Return an experiment as an answer of the API."""
    experiment, problems = found.experiment, [str(p) for p in found.problems if p.is_error]
    if experiment is None:
        return ExperimentLine(
            found.name, found.name, "", "", None, found.robot, "", [], [], [], problems,
            found.who, maybe_time(found.added_ns),
        )  # fmt: skip
    options = experiment.options
    return ExperimentLine(
        found.name, experiment.title, options.description, options.safety, options.duration,
        found.robot, experiment.sha256, _people(experiment.person_roles),
        [action_parameter(name, one) for name, one in options.parameters.items()],
        options.about, problems, found.who, maybe_time(found.added_ns),
    )  # fmt: skip


def _people(roles: Sequence[Role]) -> list[RunRole]:
    return [role for role in roles if role != "robot"]


def list_tests(fleet: Services, robot: str) -> list[UnitTestLine]:
    """List the unit tests that a robot has announced, by name."""
    with fleet.database.reading() as connection:
        said = commands.commanded(connection, robot)
    known = read_announcement(said.actions)[0] if said else {}
    return [
        UnitTestLine(
            name.removeprefix(TEST_PREFIX), one.description, one.risk, one.timeout_s, one.recovers
        )
        for name, one in sorted(known.items())
        if name.startswith(TEST_PREFIX)
    ]


def diagram(fleet: Services, robot: str, name: str, *, standalone: bool = True) -> SvgElement:
    """Return the diagram of an experiment; raises UsageError where it cannot be read.

    Without ``standalone`` its style is that of the page that it is put into.
    """
    found = fleet.runner.shelf.find(robot, name)
    if found.experiment is None:
        raise UsageError(f"the experiment '{name}' cannot be read", "its problems are listed")
    return draw_bpmn(found.experiment.model, standalone=standalone)


def run_diagram(fleet: Services, robot: str, id: str, *, standalone: bool = True) -> SvgElement:
    """Return the diagram of a run, with the states that it has come to."""
    stored = find_run(fleet, robot, id)
    if stored.kind == "unit_test":
        raise NotFoundError("a unit test has no diagram")
    experiment = fleet.runner.shelf.experiment(stored.sha256, stored.name)
    run = fleet.runner.register.read(stored)
    states = element_states(run.procedure, run.events) if run is not None else {}
    return draw_bpmn(experiment.model, states, standalone=standalone)


_PICTURES: Mapping[str, str] = {
    ".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".svg": "image/svg+xml",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture of an experiment; ``kind`` is its content type."""

    data: bytes
    kind: str


def picture(fleet: Services, robot: str, file: str, *, name: str = "", run: str = "") -> Picture:
    """Return a picture that an experiment, or that of a run, names; raises NotFoundError."""
    shelf, experiment = fleet.runner.shelf, None
    if not run:
        experiment = shelf.find(robot, name).experiment
    elif (stored := find_run(fleet, robot, run)).kind == "experiment":
        experiment = shelf.experiment(stored.sha256, stored.name)
    for path in () if experiment is None else experiment.all_files:
        kind = _PICTURES.get(path.suffix.lower())
        if path.name == file and kind is not None:
            return Picture(path.read_bytes(), kind)
    raise NotFoundError("the experiment has no such picture")


def upload(fleet: Services, who: Caller, name: str, files: Mapping[str, bytes]) -> ExperimentLine:
    """Keep an experiment that can be started on all robots; raises ConfigurationError."""
    experiment = fleet.runner.shelf.upload(name, files, who.person)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        details = {"sha256": experiment.sha256, "files": sorted(files)}
        who.note(connection, now_ns, "experiments.upload", experiment.name, details=details)
    return show_experiment(fleet, "", experiment.name)


def withdraw(fleet: Services, who: Caller, name: str) -> None:
    """Take an uploaded experiment from the list; runs of it stay."""
    with fleet.database.begin() as connection:
        if not fleet.runner.shelf.withdraw(connection, name):
            raise UsageError(f"nobody has uploaded '{name[:64]}'", "those of robots are theirs")
        who.note(connection, fleet.clock.wall_ns(), "experiments.withdraw", name)


# -- runs


def list_runs(
    fleet: Services, robots: Sequence[str] | None, *, state: Sequence[RunState] = (),
    name: str = "", series: str = "", after: int = 0, limit: int = 100,
) -> list[RunLine]:  # fmt: skip
    """List runs, the newest first; ``robots`` None is of all."""
    with fleet.database.reading() as connection:
        found = runs.listed(
            connection, robots, states=state, name=name, series=series, before=after, limit=limit
        )
    return [run_line(one) for one in found]


def run_line(one: StoredRun) -> RunLine:
    """Return a run as an answer of the API."""
    return RunLine(
        number=one.number, id=one.id, robot=one.robot, kind=one.kind, name=one.name,
        title=one.title, sha256=one.sha256, state=one.state, reason=one.reason, who=one.who,
        series=one.series, left=one.left, diagnosis=one.diagnosis, test=one.test,
        version=one.versions.get("robot", ""), created=format_time(one.created_ns),
        begun=maybe_time(one.begun_ns), ended=maybe_time(one.ended_ns), at_robot=one.at_robot,
    )  # fmt: skip


def find_run(fleet: Services, robot: str, id: str) -> StoredRun:
    """Return a run of a robot; raises NotFoundError."""
    with fleet.database.reading() as connection:
        found = runs.find(connection, id)
    if found is None or found.robot != robot:
        raise NotFoundError("there is no such run of this robot")
    return found


def show_run(fleet: Services, who: Caller, robot: KnownRobot, id: str) -> RunDetail:
    """Show a run: what waits now, and all that has happened."""
    stored = find_run(fleet, robot.id, id)
    run = fleet.runner.register.read(stored)
    present = [Present(role, name) for role, name in fleet.runner.presence.present(id)]
    contact = fleet.links.contact(robot.id)
    lease = contact.lease if contact else None
    steps = {} if stored.at_robot else fleet.runner.shelf.procedure(stored).steps
    needed = {step.role for step in steps.values() if step.person is not None}
    needs: list[RunRole] = [role for role in ("technician", "operator") if role in needed]
    verdict = msgspec.json.decode(stored.report, type=dict[str, Any]) if stored.report else {}
    return RunDetail(
        run=run_line(stored), parameters=stored.parameters,
        people=[_person_step(who, task, robot) for task in run.person_tasks()] if run else [],
        robot=list(_robot_steps(fleet, stored, run)) if run else [],
        present=present, needs=needs, holder=lease.holder if lease else "",
        events=list(_happenings(run)) if run else [], verdict=verdict,
    )  # fmt: skip


def _person_step(who: Caller, task: PersonTask, robot: KnownRobot) -> PersonStep:
    form, step = task.form, task.step
    return PersonStep(
        task=task.id, element=step.path, name=step.name, role=task.role, lane=step.lane,
        text=form.text, expected=form.expected, deviation=form.deviation, picture=form.picture,
        since=format_time(task.since_ns), mine=_may_do(who, task.role, robot),
        fields=[
            FormField(
                name, one.kind, one.label or name, one.unit, one.min, one.max, one.choices,
                one.required,
            )
            for name, one in form.fields.items()
        ],
    )  # fmt: skip


def _may_do(who: Caller, role: Role, robot: KnownRobot) -> bool:
    """Return whether the caller may do steps of a role; higher roles do those of lower ones."""
    least = _LEAST.get(role, AccountRole.ADMIN)
    own = who.principal.role
    return own is not None and own.covers(least) and who.may("experiments.step", robot)


def _robot_steps(fleet: Services, stored: StoredRun, run: ExperimentRun) -> Iterator[RobotStep]:
    contact = fleet.links.contact(stored.robot)
    waiting = contact.waiting.id if contact and contact.waiting.by_code else ""
    reports = {event.task: event.text for event in run.events if event.kind == "report"}
    with fleet.database.reading() as connection:
        for task in (*run.robot_tasks(), *run.running()):
            command = _command(fleet, connection, task)
            waits = "" if command else fleet.runner.waits_for(stored.id)
            yield RobotStep(
                task=task.id, element=task.step.path, name=task.step.name,
                action=task.action, parameters=task.parameters,
                since=format_time(task.since_ns), waits=waits, command=task.command,
                state=command.state if command else "",
                confirm=bool(waiting) and waiting == task.command,
                report=reports.get(task.id, ""),
            )  # fmt: skip


def _command(
    fleet: Services, connection: Connection, task: RobotTask
) -> commands.StoredCommand | None:
    return commands.find(connection, fleet.clock.wall_ns(), task.command) if task.command else None


def _happenings(run: ExperimentRun) -> Iterator[RunHappening]:
    for event in run.events:
        name = run.procedure.name_of(event.element) if event.element else ""
        yield RunHappening(
            event.number, format_time(event.at_ns), event.kind, event.element, name, event.task,
            event.who, event.text, event.values,
        )  # fmt: skip


# -- starting


async def start(
    fleet: Services, who: Caller, robot: KnownRobot, *, experiment: str = "", test: str = "",
    parameters: Mapping[str, Any] | None = None, repeats: int = 1, queue: bool = False,
    diagnosis: str = "", answers: str = "",
) -> RunLine:  # fmt: skip
    """Start an experiment or a unit test on a robot; with ``queue`` plan it if it is away.

    ``answers`` is the test of the ``diagnosis`` that the verdict answers. Raises UsageError for
    what cannot be run, NotNowError where the robot is reserved, or away.
    """
    order = await asyncio.to_thread(
        partial(
            _order, fleet, who, robot, experiment, test, parameters or {}, repeats, diagnosis,
            answers,
        )
    )  # fmt: skip
    is_here = bool(fleet.links.challenges(robot.id))
    if not is_here and not queue:
        hint = "plan the run, or wait until the robot is connected and 'amberbox run' runs there"
        raise NotNowError(f"{robot.id} is not connected, or takes no commands", hint)
    if is_here:
        check_free(fleet, robot.id)
    stored = await asyncio.to_thread(_add, fleet, who, order, begin=is_here)
    fleet.bus.publish(ServerChange("run", robot.id, {"id": stored.id}))
    return run_line(stored)


def check_free(fleet: Services, robot: str, run: str = "") -> None:
    """Raise NotNowError where another run, server or person holds the robot.

    The lease of a run that is over ends by itself.
    """
    contact = fleet.links.contact(robot)
    lease = contact.lease if contact else None
    with fleet.database.reading() as connection:
        other = runs.holder_of(connection, robot)
        last = runs.find(connection, lease.run) if lease is not None else None
    if other is not None and other.id != run:
        raise NotNowError(
            f"{robot} is reserved by {other.who} for {other.title}",
            "wait until that run is over, or abort it",
        )
    is_over = last is not None and last.state not in HOLDING
    if lease is not None and lease.holder and lease.run != run and not is_over:
        raise NotNowError(
            f"{robot} is held by {lease.holder} (run {lease.run})",
            "wait until it is released, or ask them to end it",
        )


def _order(
    fleet: Services, who: Caller, robot: KnownRobot, experiment: str, test: str,
    parameters: Mapping[str, Any], repeats: int, diagnosis: str, answers: str,
) -> RunOrder:  # fmt: skip
    if bool(experiment) == bool(test):
        raise UsageError("name an experiment or a unit test", "one of them, not both")
    config_hash, versions = _versions(fleet, robot.id)
    about = (robot.id, diagnosis, answers, config_hash, versions)
    if test:
        known = {one.name: one for one in list_tests(fleet, robot.id)}
        if test not in known:
            near = did_you_mean(test, known)
            raise UsageError(f"{robot.id} announces no unit test '{test[:64]}'{near}")
        return _made_order("unit_test", test, known[test].description or test, "", {}, who,
                           repeats, about)  # fmt: skip
    found = fleet.runner.shelf.find(robot.id, experiment)
    if found.experiment is None:
        errors = "\n".join(str(problem) for problem in found.problems if problem.is_error)
        raise UsageError(f"the experiment '{experiment}' cannot be run:\n{errors}")
    values = accept_values(found.experiment.options.parameters, parameters, experiment)
    fleet.runner.shelf.keep(found.experiment, who.person)
    return _made_order("experiment", found.experiment.name, found.experiment.title,
                       found.experiment.sha256, values, who, repeats, about)  # fmt: skip


def _made_order(
    kind: runs.RunKind, name: str, title: str, sha256: str, values: Mapping[str, Any],
    who: Caller, repeats: int, about: tuple[str, str, str, str, Mapping[str, str]],
) -> RunOrder:  # fmt: skip
    robot, diagnosis, answers, config_hash, versions = about
    return RunOrder(robot, kind, name, title[:300], sha256, values, who.person, diagnosis, answers,
                    config_hash, versions, repeats)  # fmt: skip


def _versions(fleet: Services, robot: str) -> tuple[str, Mapping[str, str]]:
    """Return the hash of a robot's configuration, and the versions of its software by name.

    ``robot`` is its own software, as ``robot.yaml`` says; ``amberbox`` what it said last.
    """
    with fleet.database.reading() as connection:
        chosen = ROBOT.select().where(ROBOT.c.robot == robot)
        row = connection.execute(chosen).one_or_none()
    if row is None:
        return "", {}
    text = fleet.folders.read(robot, row.config_hash, ROBOT_FILE) or b""
    node = parse_yaml(text.decode("utf-8", "replace"), ROBOT_FILE, [])
    own = ((node.mapping if node is not None else None) or {}).get("software_version")
    robots = {"robot": own.text[:128]} if own is not None and own.text else {}
    return row.config_hash, {**robots, "amberbox": row.version}


def _add(fleet: Services, who: Caller, order: RunOrder, *, begin: bool) -> StoredRun:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        stored = runs.add(connection, now_ns, order)
        details = {
            "robot": order.robot, "kind": order.kind, "name": order.name, "sha256": order.sha256,
            "parameters": dict(order.parameters), "begun": begin,
        }  # fmt: skip
        who.note(connection, now_ns, "experiments.start", stored.id, details=details)
        if begin:
            _begin(fleet, who, connection, stored)
        found = runs.find(connection, stored.id)
    assert found is not None, "it was stored"
    return found


def _begin(fleet: Services, who: Caller, connection: Connection, stored: StoredRun) -> None:
    fleet.runner.presence.note(stored.id, "technician", who.person)
    fleet.runner.register.begin(connection, stored, {"technician": who.person}, who.person)


async def begin(fleet: Services, who: Caller, robot: KnownRobot, id: str) -> RunLine:
    """Begin a run that was planned; raises NotNowError where its robot is away or reserved."""
    if not fleet.links.challenges(robot.id):
        raise NotNowError(f"{robot.id} is not connected, or takes no commands")
    check_free(fleet, robot.id, id)
    stored = await asyncio.to_thread(_begin_planned, fleet, who, robot.id, id)
    fleet.bus.publish(ServerChange("run", robot.id, {"id": id}))
    return run_line(stored)


def _begin_planned(fleet: Services, who: Caller, robot: str, id: str) -> StoredRun:
    find_run(fleet, robot, id)
    with fleet.database.begin() as connection:
        stored = runs.find(connection, id)
        if stored is None or stored.state != "planned":
            raise NotNowError("the run has begun already, or is over", "look at it again")
        _begin(fleet, who, connection, stored)
        who.note(connection, fleet.clock.wall_ns(), "experiments.begin", id)
    return find_run(fleet, robot, id)


# -- what a verdict answers


async def answer_diagnosis(fleet: Services, stored: StoredRun, verdict: str) -> None:
    """Give the open diagnosis what the verdict of a run answers, if it asks for such a run.

    An answer that was given already is not given again. Raises AmberboxError.
    """
    asked = AskRunAnswers(
        robot=stored.robot, now_ns=fleet.clock.wall_ns(), kind=stored.kind, name=stored.name,
        verdict=verdict, diagnosis=stored.diagnosis,
    )  # fmt: skip
    who = Caller(Principal("user", stored.who), "")
    found = decode_answer(await ask_worker(fleet, who, "run_answers", asked))
    diagnosis, words = found["diagnosis"], found["answers"]
    known = await asyncio.to_thread(given_answers, fleet, stored.robot, diagnosis)
    new = {test: word for test, word in words.items() if known.get(test) != word}
    if new:
        about = {"run": stored.id}
        await answer_tests(fleet, who, stored.robot, diagnosis, next(iter(new)), new, about)


# -- taking part


def present(fleet: Services, who: Caller, robot: KnownRobot, id: str, role: RunRole) -> None:
    """Note that the caller is there for a run; repeated every few seconds while they are."""
    stored = find_run(fleet, robot.id, id)
    if not _may_do(who, role, robot):
        raise UsageError(f"you cannot be there as {role}", "ask an admin for the role")
    if stored.state in HOLDING and fleet.runner.presence.note(id, role, who.person):
        _change(fleet, stored, lambda run, now_ns: run.presence(role, who.person, now_ns))


def complete(
    fleet: Services, who: Caller, robot: KnownRobot, id: str, task: str, values: Mapping[str, Any]
) -> RunDetail:
    """End a step of a person; raises NotNowError where somebody else has done it meanwhile."""
    stored = find_run(fleet, robot.id, id)

    def work(run: ExperimentRun, now_ns: int) -> None:
        found = next((one for one in run.person_tasks() if one.id == task), None)
        if found is None:
            raise NotNowError(_what_became(run, task), "look at the run again")
        if not _may_do(who, found.role, robot):
            raise UsageError(f"this step is for a {found.role}", "ask somebody who is one")
        run.complete(task, values, who.person, now_ns)

    _change(fleet, stored, work, who, "experiments.complete", {"task": task})
    return show_run(fleet, who, robot, id)


def _what_became(run: ExperimentRun, task: str) -> str:
    """Return what has become of a step that does not wait any more."""
    for event in reversed(run.events):
        if event.task == task and event.kind == "done":
            return f"{event.who} has done this step already"
        if event.task == task and event.kind == "interrupted":
            return f"this step is over: {event.text}"
    return "this step does not wait" if run.outcome is None else f"the run is over: {run.outcome}"


def deviation(
    fleet: Services, who: Caller, robot: KnownRobot, id: str, task: str, text: str
) -> RunDetail:
    """Note what was not as expected in a step."""
    stored = find_run(fleet, robot.id, id)
    _change(
        fleet, stored, lambda run, now_ns: run.deviation(task, text, who.person, now_ns), who,
        "experiments.deviation", {"task": task},
    )  # fmt: skip
    return show_run(fleet, who, robot, id)


def note(fleet: Services, who: Caller, robot: KnownRobot, id: str, text: str) -> RunDetail:
    """Note a remark about a run."""
    stored = find_run(fleet, robot.id, id)
    _change(fleet, stored, lambda run, now_ns: run.note(text, who.person, now_ns))
    return show_run(fleet, who, robot, id)


def pause(
    fleet: Services, who: Caller, robot: KnownRobot, id: str, reason: str, *, on: bool = True
) -> RunDetail:
    """Pause a run, or go on with it: timers stand, and no step of the robot begins."""
    stored = find_run(fleet, robot.id, id)

    def work(run: ExperimentRun, now_ns: int) -> None:
        (run.pause if on else run.resume)(who.person, reason, now_ns)

    what = "experiments.pause" if on else "experiments.resume"
    _change(fleet, stored, work, who, what, {"reason": reason})
    return show_run(fleet, who, robot, id)


async def abort(
    fleet: Services, who: Caller, robot: KnownRobot, id: str, reason: str = ""
) -> RunLine:
    """End a run, and have the robot stopped at once; as often as wanted."""
    await fleet.links.order(robot.id, AbortFrame(id, "", who.person))
    stored = await asyncio.to_thread(_abort, fleet, who, robot.id, id, reason)
    fleet.bus.publish(ServerChange("run", robot.id, {"id": id}))
    return run_line(stored)


def _abort(fleet: Services, who: Caller, robot: str, id: str, reason: str) -> StoredRun:
    stored = find_run(fleet, robot, id)
    text = f"aborted by {who.person}" + (f": {reason}" if reason else "")
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        runs.abort_planned(connection, now_ns, id, text)  # unless it has begun meanwhile
        details = {"reason": reason, "state": stored.state}
        who.note(connection, now_ns, "experiments.abort", id, details=details)
    stored = find_run(fleet, robot, id)
    if stored.state in HOLDING:
        try:
            _change(fleet, stored, lambda run, now_ns: run.abort(who.person, reason, now_ns))
        except LostRunError as error:
            fleet.runner.register.give_up(stored, f"{text}; {error.what}")
    return find_run(fleet, robot, id)


def _change(
    fleet: Services, stored: StoredRun, work: Any, who: Caller | None = None, action: str = "",
    details: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Change a run under way, with a line in the audit log if it has an ``action``."""
    if stored.state not in HOLDING:
        raise NotNowError(f"the run is {stored.state}", "look at it again")

    def change(run: ExperimentRun, connection: Connection, now_ns: int) -> None:
        work(run, now_ns)
        if who is not None and action:
            who.note(connection, fleet.clock.wall_ns(), action, stored.id, details=details)

    fleet.runner.register.change(stored, change)
