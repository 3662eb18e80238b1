"""Routes of experiments and unit tests: what there is, runs, and taking part in them."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fastapi import Path, Query, Response
from fastapi.responses import HTMLResponse
from pydantic import Field

from amberbox.core.api import (
    ExperimentLine,
    RunDetail,
    RunLine,
    RunRole,
    RunState,
    UnitTestLine,
)
from amberbox.core.errors import UsageError
from amberbox.server.experiments.runs import MOST_REPEATS
from amberbox.server.experiments.shelf import MOST_BYTES, MOST_FILES
from amberbox.server.http.auth import Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import Form, Limit
from amberbox.server.services import experiments, reports

routes = Routes("experiments")

_NAME = r"^[A-Za-z0-9_.-]{1,128}$"
ExperimentName = Annotated[str, Path(pattern=_NAME, description="an experiment")]
RunId = Annotated[str, Path(pattern=r"^r-[0-9a-f]{16}$", description="the id of a run")]
After = Annotated[int, Query(ge=0, le=2**62, description="last number of the page before")]
PictureName = Annotated[
    str, Path(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$", description="a picture of a step")
]
_Name = Annotated[str, Field(pattern=r"^([A-Za-z0-9_.-]{1,128})?$")]
_Text = Annotated[str, Field(min_length=1, max_length=2000, pattern=r"\S")]
_Task = Annotated[str, Field(min_length=1, max_length=300)]
_File = Annotated[str, Field(max_length=MOST_BYTES * 4 // 3 + 8)]


class UploadedExperiment(Form):
    """Files of an experiment, and of those that it calls, by name; contents are Base64."""

    name: Annotated[str, Field(pattern=_NAME, description="without .bpmn")]
    files: Annotated[dict[str, _File], Field(min_length=1, max_length=MOST_FILES)]


class NewRun(Form):
    """What to run: an experiment with its parameters, or a unit test.

    ``queue`` plans the run where the robot is away. ``answers`` is the test of the ``diagnosis``
    that the verdict answers.
    """

    experiment: _Name = ""
    test: _Name = ""
    parameters: Annotated[dict[str, Any], Field(max_length=50, default_factory=dict)]
    repeats: Annotated[int, Field(ge=1, le=MOST_REPEATS)] = 1
    queue: bool = False
    diagnosis: Annotated[str, Field(max_length=128)] = ""
    answers: Annotated[str, Field(max_length=512)] = ""


class Presence(Form):
    """The role in which one is there."""

    role: RunRole


class DoneStep(Form):
    """The values of a step's form, by field; null skips one of pass and fail."""

    task: _Task
    values: Annotated[dict[str, Any], Field(max_length=100, default_factory=dict)]


class Deviation(Form):
    """What was not as expected in a step."""

    task: _Task
    text: _Text


class RunNote(Form):
    """A remark about a run."""

    text: _Text


class Why(Form):
    """Why it is done."""

    reason: Annotated[str, Field(max_length=300)] = ""


_LATE: Mapping[int | str, dict[str, Any]] = {
    409: {"description": "the robot is away or reserved, or the run does not wait for this now"}
}


@routes.get("/experiments", "experiments.read", each=True)
def list_uploaded(fleet: Fleet) -> list[ExperimentLine]:
    """List the experiments that were uploaded, by name; they can be run on all robots."""
    return experiments.list_experiments(fleet)


@routes.post("/experiments", "experiments.upload", status_code=201)
def upload_experiment(fleet: Fleet, who: Who, body: UploadedExperiment) -> ExperimentLine:
    """Upload an experiment; one of the same name is replaced, its runs stay as they are."""
    files = {}
    for name, text in body.files.items():
        try:
            files[name] = base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError):
            raise UsageError(f"the file '{name[:80]}' is no Base64") from None
    return experiments.upload(fleet, who, body.name, files)


@routes.delete("/experiments/{name}", "experiments.upload", status_code=204)
def withdraw_experiment(fleet: Fleet, who: Who, name: ExperimentName) -> None:
    """Take an uploaded experiment from the list; runs of it stay."""
    experiments.withdraw(fleet, who, name)


@routes.get("/robots/{robot}/experiments", "experiments.read")
def list_experiments(fleet: Fleet, robot: OfRobot) -> list[ExperimentLine]:
    """List the experiments that a robot can run, by name: its own, and those uploaded."""
    return experiments.list_experiments(fleet, robot.id)


@routes.get("/robots/{robot}/experiments/{name}", "experiments.read")
def show_experiment(fleet: Fleet, robot: OfRobot, name: ExperimentName) -> ExperimentLine:
    """Show an experiment."""
    return experiments.show_experiment(fleet, robot.id, name)


@routes.get(
    "/robots/{robot}/experiments/{name}/diagram", "experiments.read", response_class=Response,
    responses={200: {"content": {"image/svg+xml": {}}}},
)  # fmt: skip
def draw_experiment(fleet: Fleet, robot: OfRobot, name: ExperimentName) -> Response:
    """Draw the diagram of an experiment as SVG."""
    return Response(str(experiments.diagram(fleet, robot.id, name)), media_type="image/svg+xml")


# A picture comes from a robot or a person: nothing in it runs, also where it is opened alone
_PICTURE_HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; sandbox",
    "X-Content-Type-Options": "nosniff",
}


@routes.get(
    "/robots/{robot}/experiments/{name}/files/{file}", "experiments.read", response_class=Response
)
def read_picture(fleet: Fleet, robot: OfRobot, name: ExperimentName, file: PictureName) -> Response:
    """Return a picture of an experiment: PNG, JPEG or SVG."""
    return _picture(experiments.picture(fleet, robot.id, file, name=name))


def _picture(found: experiments.Picture) -> Response:
    return Response(found.data, media_type=found.kind, headers=dict(_PICTURE_HEADERS))


@routes.get("/robots/{robot}/tests", "experiments.read")
def list_tests(fleet: Fleet, robot: OfRobot) -> list[UnitTestLine]:
    """List the unit tests that a robot has announced, by name."""
    return experiments.list_tests(fleet, robot.id)


@routes.get("/runs", "experiments.read", each=True)
def list_all_runs(
    fleet: Fleet, who: Who,
    state: Annotated[list[RunState], Query(max_length=10, description="several fit")] = [],  # noqa: B006 - FastAPI copies it
    name: Annotated[str, Query(max_length=128)] = "",
    after: After = 0,
    limit: Limit = 100,
) -> list[RunLine]:  # fmt: skip
    """List runs, the newest first, of the robots that the caller may see."""
    with fleet.database.reading() as connection:
        mine = [robot.id for robot in who.robots(connection, "experiments.read")]
    return experiments.list_runs(fleet, mine, state=state, name=name, after=after, limit=limit)


@routes.get("/robots/{robot}/runs", "experiments.read")
def list_runs(
    fleet: Fleet, robot: OfRobot,
    state: Annotated[list[RunState], Query(max_length=10, description="several fit")] = [],  # noqa: B006 - FastAPI copies it
    name: Annotated[str, Query(max_length=128)] = "",
    series: Annotated[str, Query(max_length=64, description="runs that repeat this one")] = "",
    after: After = 0,
    limit: Limit = 100,
) -> list[RunLine]:  # fmt: skip
    """List the runs on a robot, the newest first."""
    return experiments.list_runs(
        fleet, [robot.id], state=state, name=name, series=series, after=after, limit=limit
    )


@routes.post("/robots/{robot}/runs", "experiments.write", status_code=201, responses=_LATE)
async def start_run(fleet: Fleet, who: Who, robot: OfRobot, body: NewRun) -> RunLine:
    """Start an experiment or a unit test; the robot is reserved for it."""
    return await experiments.start(
        fleet, who, robot, experiment=body.experiment, test=body.test, parameters=body.parameters,
        repeats=body.repeats, queue=body.queue, diagnosis=body.diagnosis, answers=body.answers,
    )  # fmt: skip


@routes.get("/robots/{robot}/runs/{id}", "experiments.read")
def show_run(fleet: Fleet, who: Who, robot: OfRobot, id: RunId) -> RunDetail:
    """Show a run: what waits now, and all that has happened."""
    return experiments.show_run(fleet, who, robot, id)


@routes.get(
    "/robots/{robot}/runs/{id}/diagram", "experiments.read", response_class=Response,
    responses={200: {"content": {"image/svg+xml": {}}}},
)  # fmt: skip
def draw_run(fleet: Fleet, robot: OfRobot, id: RunId) -> Response:
    """Draw the diagram of a run as SVG, with what is done and what is under way marked."""
    return Response(str(experiments.run_diagram(fleet, robot.id, id)), media_type="image/svg+xml")


@routes.get(
    "/robots/{robot}/runs/{id}/files/{file}", "experiments.read", response_class=Response
)  # fmt: skip
def read_run_picture(fleet: Fleet, robot: OfRobot, id: RunId, file: PictureName) -> Response:
    """Return a picture of the experiment of a run, as it was when the run began."""
    return _picture(experiments.picture(fleet, robot.id, file, run=id))


@routes.post("/robots/{robot}/runs/{id}/begin", "experiments.write", responses=_LATE)
async def begin_run(fleet: Fleet, who: Who, robot: OfRobot, id: RunId) -> RunLine:
    """Begin a run that was planned while the robot was away."""
    return await experiments.begin(fleet, who, robot, id)


@routes.post("/robots/{robot}/runs/{id}/present", "experiments.step", status_code=204)
def be_present(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: Presence) -> None:
    """Say that one is there for a run; said again every 10 s."""
    experiments.present(fleet, who, robot, id, body.role)


@routes.post("/robots/{robot}/runs/{id}/complete", "experiments.step", responses=_LATE)
def complete_step(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: DoneStep) -> RunDetail:
    """End a step of a person with the values of its form."""
    return experiments.complete(fleet, who, robot, id, body.task, body.values)


@routes.post("/robots/{robot}/runs/{id}/deviation", "experiments.step", responses=_LATE)
def note_deviation(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: Deviation) -> RunDetail:
    """Note what was not as expected in a step."""
    return experiments.deviation(fleet, who, robot, id, body.task, body.text)


@routes.post("/robots/{robot}/runs/{id}/note", "experiments.step", responses=_LATE)
def note_run(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: RunNote) -> RunDetail:
    """Note a remark about a run."""
    return experiments.note(fleet, who, robot, id, body.text)


@routes.post("/robots/{robot}/runs/{id}/pause", "experiments.step", responses=_LATE)
def pause_run(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: Why) -> RunDetail:
    """Stop the timers of a run, and begin no step of the robot until it is resumed."""
    return experiments.pause(fleet, who, robot, id, body.reason)


@routes.post("/robots/{robot}/runs/{id}/resume", "experiments.step", responses=_LATE)
def resume_run(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: Why) -> RunDetail:
    """Go on with a run that is paused."""
    return experiments.pause(fleet, who, robot, id, body.reason, on=False)


@routes.post("/robots/{robot}/runs/{id}/abort", "experiments.step")
async def abort_run(fleet: Fleet, who: Who, robot: OfRobot, id: RunId, body: Why) -> RunLine:
    """End a run and have the robot stopped at once; as often as wanted.

    This is no emergency stop: it needs the link to the robot, and its computer.
    """
    return await experiments.abort(fleet, who, robot, id, body.reason)


@routes.get(
    "/robots/{robot}/runs/{id}/report", "experiments.read", response_class=Response,
    responses=_LATE,
)  # fmt: skip
async def read_report(
    fleet: Fleet, who: Who, robot: OfRobot, id: RunId,
    format: Annotated[Literal["json", "html", "junit"], Query()] = "json",
) -> Response:  # fmt: skip
    """Return the report of a run: JSON, one HTML page to print, or JUnit XML."""
    data = await reports.report(fleet, who, robot.id, id, format)
    if format == "html":
        return HTMLResponse(data)
    kind = "application/xml" if format == "junit" else "application/json"
    return Response(data, media_type=kind)


@routes.get("/robots/{robot}/comparison", "experiments.read", responses=_LATE)
async def compare_runs(
    fleet: Fleet, who: Who, robot: OfRobot,
    run: Annotated[list[str], Query(min_length=2, max_length=100, description="ids of runs")],
    since: Annotated[str, Query(max_length=128, description="change since this version")] = "",
    software: Annotated[str, Query(max_length=64, description="whose version; else robot")] = "",
) -> dict[str, Any]:  # fmt: skip
    """Compare runs of one experiment: statistics of its measures, and what changed."""
    return await reports.compare(fleet, who, robot.id, run, since, software)
