"""The pages of experiments: what can be run, on which robot, and the form that starts it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Final
from urllib.parse import quote

from fastapi import Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import QueryParams
from starlette.responses import RedirectResponse

from amberbox.core.api import ExperimentLine, RunLine, UnitTestLine
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.experiments.action import parameters_of_words
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.experiments.runs import MOST_REPEATS
from amberbox.server.http.auth import Fields, Fleet, OfRobot, Who
from amberbox.server.http.errors import status_of
from amberbox.server.services import experiments
from amberbox.server.services.context import Caller, NotNowError, Services
from amberbox.server.services.robots import read_card
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.run_view import in_page, listed_steps

routes = PageRoutes()

PARAMETER: Final = "p."
"""What the names of parameters begin with in the form."""
_LAST = 3
_LOOKED_AT = 500

ExperimentName = Annotated[str, Path(max_length=128)]
Text = Annotated[str, Query(max_length=512)]


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """An experiment with the robots that can run it, and its last runs, the newest first."""

    about: ExperimentLine
    robots: Sequence[str]
    runs: Sequence[RunLine] = ()


@dataclass(frozen=True, slots=True)
class TestEntry:
    """A unit test of a robot with its last runs, the newest first."""

    about: UnitTestLine
    runs: Sequence[RunLine] = ()


@dataclass(frozen=True, slots=True)
class AnsweredTest:
    """A unit test whose verdict answers a test of a diagnosis; all empty for none."""

    unit_test: str = ""
    diagnosis: str = ""
    test: str = ""


@dataclass(frozen=True, slots=True)
class StartForm:
    """What was filled in: ``problem`` is why it was not accepted."""

    parameters: Mapping[str, str] = field(default_factory=dict)
    repeats: str = "1"
    is_read: bool = False
    problem: AmberboxError | None = None


@dataclass(frozen=True, slots=True)
class Availability:
    """Whether a robot can begin a run now, else why not; one that is away can be planned for."""

    is_here: bool
    obstacle: NotNowError | None = None


@routes.get("/experiments", "experiments.read", each=True)
def show_all(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show the experiments of all robots, and those that were uploaded."""
    with fleet.database.reading() as connection:
        robots = [robot.id for robot in who.robots(connection, "experiments.read")]
    last = _last_runs(fleet, robots)
    found: dict[tuple[str, str], CatalogueEntry] = {}
    for robot in robots:
        for line in experiments.list_experiments(fleet, robot):
            key = line.name, line.sha256
            before = found.get(key, CatalogueEntry(line, []))
            runs = [*before.runs, *last.get((robot, "experiment", line.name), ())]
            found[key] = CatalogueEntry(before.about, [*before.robots, robot], runs)
    for line in experiments.list_experiments(fleet):
        found.setdefault((line.name, line.sha256), CatalogueEntry(line, []))
    entries = [found[key] for key in sorted(found)]
    return render(
        request, "experiments/experiments.html", entries=entries, robots=robots,
        may_upload=who.may("experiments.upload"), last=_LAST,
    )  # fmt: skip


@routes.get("/robots/{robot}/experiments", "experiments.read")
def show_robot(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, unit_test: Text = "",
    diagnosis: Text = "", test: Text = "",
) -> Response:  # fmt: skip
    """Show the experiments and the unit tests of a robot.

    A run of ``unit_test`` answers a ``test`` of a ``diagnosis``.
    """
    answers = AnsweredTest(unit_test, diagnosis, test)
    return _robot_page(request, fleet, who, robot, answers)


@routes.form("/robots/{robot}/experiments", "experiments.write")
async def start_test(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, fields: Fields
) -> Response:
    """Start a unit test of a robot."""
    about = AnsweredTest(
        fields.get("unit_test", ""), fields.get("diagnosis", "")[:128], fields.get("test", "")[:512]
    )
    try:
        run = await experiments.start(
            fleet, who, robot, test=about.unit_test, diagnosis=about.diagnosis, answers=about.test
        )
    except AmberboxError as error:
        return await run_in_threadpool(_robot_page, request, fleet, who, robot, about, error)
    return RedirectResponse(f"/runs/{run.id}", 303)


def _robot_page(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, answers: AnsweredTest,
    problem: AmberboxError | None = None,
) -> Response:  # fmt: skip
    last = _last_runs(fleet, [robot.id])
    entries = [
        CatalogueEntry(line, [robot.id], last.get((robot.id, "experiment", line.name), ()))
        for line in experiments.list_experiments(fleet, robot.id)
    ]
    tests = [
        TestEntry(line, last.get((robot.id, "unit_test", line.name), ()))
        for line in experiments.list_tests(fleet, robot.id)
    ]
    return render(
        request, "experiments/robot.html", status_of(problem) if problem else 200,
        card=read_card(fleet, robot), entries=entries, tests=tests, problem=problem,
        answers=answers,
        availability=availability(fleet, robot), may_start=who.may("experiments.write", robot),
        may_upload=who.may("experiments.upload"), last=_LAST,
    )  # fmt: skip


def _last_runs(
    fleet: Services, robots: Sequence[str]
) -> Mapping[tuple[str, str, str], list[RunLine]]:
    """Return the last runs by robot, kind and name."""
    found: dict[tuple[str, str, str], list[RunLine]] = {}
    for run in experiments.list_runs(fleet, robots, limit=_LOOKED_AT):
        kept = found.setdefault((run.robot, run.kind, run.name), [])
        if len(kept) < _LAST:
            kept.append(run)
    return found


@routes.get("/robots/{robot}/experiments/{name}", "experiments.read")
def show_one(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, name: ExperimentName,
    diagnosis: Text = "", test: Text = "",
) -> Response:  # fmt: skip
    """Show an experiment, and the form that starts it."""
    return _start_page(request, fleet, who, robot, name, diagnosis, test, StartForm())


@routes.form("/robots/{robot}/experiments/{name}", "experiments.write")
async def start_one(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, name: ExperimentName, fields: Fields
) -> Response:
    """Start an experiment; the robot is reserved for it."""
    diagnosis, test = fields.get("diagnosis", "")[:128], fields.get("test", "")[:512]
    try:
        values = await run_in_threadpool(_values, fleet, robot.id, name, fields)
        run = await experiments.start(
            fleet, who, robot, experiment=name, parameters=values, repeats=_repeats(fields),
            queue="queue" in fields, diagnosis=diagnosis, answers=test,
        )  # fmt: skip
    except AmberboxError as error:
        form = StartForm(
            _parameters(fields), fields.get("repeats", "1")[:8], "read" in fields, error
        )
        shown = partial(_start_page, request, fleet, who, robot, name, diagnosis, test, form)
        return await run_in_threadpool(shown)
    return RedirectResponse(f"/runs/{run.id}", 303)


def _values(fleet: Services, robot: str, name: str, fields: QueryParams) -> dict[str, Any]:
    """Return the parameters of a form; raises UsageError where it says nothing of safety."""
    found = fleet.runner.shelf.find(robot, name).experiment
    if found is None:
        raise UsageError(f"the experiment '{name}' cannot be run", "its problems are listed")
    if found.options.safety and "read" not in fields:
        raise UsageError("the safety notes were not confirmed", "read them, and tick the box")
    words = [f"{key}={value}" for key, value in _parameters(fields).items() if value.strip()]
    return parameters_of_words(found.options, words)


def _parameters(fields: QueryParams) -> dict[str, str]:
    return {
        name.removeprefix(PARAMETER): value[:1000]
        for name, value in fields.items()
        if name.startswith(PARAMETER)
    }


def _repeats(fields: QueryParams) -> int:
    text = fields.get("repeats", "1").strip() or "1"
    if not text.isdecimal() or not 1 <= int(text[:6]) <= MOST_REPEATS:
        raise UsageError(f"'{text[:20]}' is no number of runs", f"from 1 to {MOST_REPEATS}")
    return int(text)


def _start_page(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, name: str, diagnosis: str,
    test: str, form: StartForm,
) -> Response:  # fmt: skip
    found = fleet.runner.shelf.find(robot.id, name)
    line = experiments.experiment_line(found)
    experiment = found.experiment
    drawing = None
    if experiment is not None:
        drawing = in_page(experiments.diagram(fleet, robot.id, name, standalone=False))
    past = experiments.list_runs(fleet, [robot.id], name=name, limit=20)
    return render(
        request, "experiments/start.html", status_of(form.problem) if form.problem else 200,
        card=read_card(fleet, robot), about=line, drawing=drawing,
        steps=listed_steps(experiment) if experiment is not None else [],
        runs=[one for one in past if one.kind == "experiment"], form=form, diagnosis=diagnosis,
        test=test, availability=availability(fleet, robot), most=MOST_REPEATS,
        may_start=who.may("experiments.write", robot),
        here=f"/robots/{quote(robot.id, safe='')}/experiments/{quote(name, safe='')}",
        criteria=experiment.options.criteria if experiment is not None else (),
    )  # fmt: skip


def availability(fleet: Services, robot: KnownRobot) -> Availability:
    """Return whether a robot can begin a run now."""
    is_here = bool(fleet.links.challenges(robot.id))
    try:
        experiments.check_free(fleet, robot.id)
    except NotNowError as obstacle:
        return Availability(is_here, obstacle)
    return Availability(is_here)
