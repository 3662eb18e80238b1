"""Routes of diagnoses and of robots' knowledge: failure modes, fault trees, rules, folders."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
from fastapi import HTTPException, Path, Query
from fastapi.responses import PlainTextResponse
from pydantic import Field, StringConstraints

from amberbox.core.api import DiagnosisLine, ModelLine
from amberbox.core.equations.structure import Causality
from amberbox.core.errors import UsageError
from amberbox.core.notes import NO_CAUSE
from amberbox.core.timestamps import format_time, ordered_span
from amberbox.diagnosis.consistency.question import Minimal
from amberbox.diagnosis.diagnose import COVERING
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import Form, From, Limit, TimeText, To
from amberbox.server.ingest.folders import FileInfo
from amberbox.server.knowledge import explanations
from amberbox.server.knowledge.diagnoses import (
    DiagnosisHistory,
    diagnoses_page,
    find_diagnosis,
    read_diagnoses,
)
from amberbox.server.knowledge.questions import (
    AskConsistency,
    AskDiagnosis,
    AskResidual,
    AskRules,
    AskStructure,
    AskTrees,
    Engine,
    RobotQuestion,
    StructureView,
    SymptomWord,
)
from amberbox.server.services import knowledge
from amberbox.server.services.context import Caller, Services, query_time_ns, robot_span_ns
from amberbox.server.services.knowledge import (
    Cause,
    DiagnosisDetail,
    FolderList,
    ServerRevision,
    TestAnswer,
    answer_tests,
    ask_worker,
    decode_answer,
    diagnosis_line,
    given_answers,
    revision_json,
)

routes = Routes("diagnoses")


_Address = Annotated[str, StringConstraints(min_length=1, max_length=300)]
_Word = Annotated[str, StringConstraints(min_length=1, max_length=100)]
Name = Annotated[str, Path(pattern=r"^[A-Za-z0-9_.:#-]{1,128}$")]
Hash = Annotated[str, StringConstraints(pattern="^([0-9a-f]{64})?$")]
Moment = Annotated[str, StringConstraints(max_length=64)]
After = Annotated[str, Query(max_length=128, description="the last id of the page before")]


class DiagnosisQuestion(Form):
    """What is asked: now or of then, what if symptoms were there, with answers to tests."""

    at: Moment = Field("", description="2026-11-21T14:00:00Z, an epoch, now-10m; -10m before the "
                       "newest status; empty: the newest status")  # fmt: skip
    diagnosis: Annotated[str, StringConstraints(max_length=128)] = ""
    symptoms: dict[_Address, SymptomWord] = Field(default_factory=dict, max_length=500)
    answers: dict[_Address, _Word] = Field(default_factory=dict, max_length=200)
    engine: Engine = COVERING
    config_hash: Hash = Field("", description="another folder of the robot than that of then")
    exposure_h: float | None = Field(None, ge=0, le=1e6, allow_inf_nan=False)


class NewAnswer(Form):
    """What a test gave: one of its outcomes, or ``cannot``.

    ``also`` is what further tests gave, where several are asked as one question.
    """

    test: _Address
    answer: _Word
    also: dict[_Address, _Word] = Field(default_factory=dict, max_length=20)


class NewCause(Form):
    """What it was."""

    failure_mode: _Address
    note: Annotated[str, StringConstraints(max_length=4000)] = ""


@routes.get("/robots/{robot}/diagnoses", "diagnoses.read")
def list_diagnoses(
    robot: OfRobot, fleet: Fleet, from_: Annotated[TimeText, Query(alias="from")] = "",
    to: TimeText = "", after: After = "", limit: Limit = 100,
) -> list[DiagnosisLine]:  # fmt: skip
    """List what a robot found to be broken, the newest first."""
    span = ordered_span(query_time_ns(from_, fleet.clock), query_time_ns(to, fleet.clock))
    return [
        diagnosis_line(one)
        for one in diagnoses_page(read_diagnoses(fleet, robot.id, *span), after, limit)
    ]


@routes.get("/robots/{robot}/diagnoses/{diagnosis}", "diagnoses.read")
def read_diagnosis(robot: OfRobot, diagnosis: Name, fleet: Fleet) -> DiagnosisDetail:
    """Return one diagnosis with all its revisions."""
    known = _known(fleet, robot, diagnosis)
    with fleet.database.reading() as connection:
        given = explanations.read_answers(connection, robot.id, diagnosis)
        causes = explanations.read_causes(connection, robot.id, diagnosis)
        made = explanations.read_revisions(connection, robot.id, diagnosis)
    return DiagnosisDetail(
        known.id, known.last.state, [revision_json(revision) for revision in known.revisions],
        [TestAnswer(a.test, a.answer, a.who, format_time(a.at_ns)) for a in given],
        [ServerRevision(r.number, r.who, format_time(r.at_ns), r.body) for r in made],
        [Cause(c.failure_mode, c.note, c.who, format_time(c.at_ns)) for c in causes],
    )  # fmt: skip


@routes.post("/robots/{robot}/diagnose", "diagnoses.write")
async def diagnose(
    robot: OfRobot, body: DiagnosisQuestion, fleet: Fleet, who: Who
) -> dict[str, Any]:
    """Ask what is broken, now or then: what ``amberbox diagnose --json`` says, with notes.

    Of a ``diagnosis``, the answers that were given to it before count as well. Nothing is kept.
    """
    asked = AskDiagnosis(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=body.at, config_hash=body.config_hash,
        exposure_h=body.exposure_h, symptoms=dict(body.symptoms), answers=dict(body.answers),
        engine=body.engine, diagnosis=body.diagnosis,
    )  # fmt: skip
    if body.diagnosis:
        before = await asyncio.to_thread(given_answers, fleet, robot.id, body.diagnosis)
        asked = msgspec.structs.replace(asked, answers={**before, **asked.answers})
    return decode_answer(await ask_worker(fleet, who, "diagnose", asked))


@routes.post("/robots/{robot}/diagnoses/{diagnosis}/answers", "diagnoses.write")
async def answer_test(
    robot: OfRobot, diagnosis: Name, body: NewAnswer, fleet: Fleet, who: Who
) -> dict[str, Any]:
    """Say what a test gave; the diagnosis is ranked anew, and kept as a revision of the server."""
    await asyncio.to_thread(_known, fleet, robot, diagnosis)
    return decode_answer(
        await answer_tests(fleet, who, robot.id, diagnosis, body.test, words_of(body))
    )


@routes.post("/robots/{robot}/diagnoses/{diagnosis}/cause", "diagnoses.write", status_code=201)
async def say_cause(
    robot: OfRobot, diagnosis: Name, body: NewCause, fleet: Fleet, who: Who
) -> Cause:
    """Say what it was in the end: a failure mode of the robot's analysis, or ``none``."""
    known = await asyncio.to_thread(_known, fleet, robot, diagnosis)
    await _check_mode(fleet, who, known, robot.id, body.failure_mode)
    cause = explanations.GivenCause(
        body.failure_mode, body.note, who.person,
        fleet.clock.wall_ns(),
    )  # fmt: skip
    await asyncio.to_thread(_keep_cause, fleet, who, robot.id, diagnosis, cause)
    fleet.bus.publish(ServerChange("diagnosis", robot.id, {"id": diagnosis}))
    return Cause(cause.failure_mode, cause.note, cause.who, format_time(cause.at_ns))


def words_of(body: NewAnswer) -> dict[str, str]:
    """Return all that is answered at once."""
    return {body.test: body.answer, **{t: a for t, a in body.also.items() if t != body.test}}


async def _check_mode(
    fleet: Services, who: Caller, known: DiagnosisHistory, robot: str, failure_mode: str
) -> None:
    """Refuse an unknown failure mode; one that the diagnosis names needs no folder."""
    if failure_mode == NO_CAUSE or any(
        failure_mode in h.faults for d in known.revisions for h in d.hypotheses
    ):
        return
    asked = RobotQuestion(
        robot=robot, now_ns=fleet.clock.wall_ns(), config_hash=known.last.config_hash
    )
    found = await ask_worker(fleet, who, "failure_modes", asked)
    if failure_mode not in json.loads(found):
        what = f"there is no failure mode '{failure_mode}' in the robot's analysis"
        raise UsageError(what, "GET .../fmea lists them; what is not in it belongs in the note")


def _known(fleet: Services, robot: KnownRobot, diagnosis: str) -> DiagnosisHistory:
    known = find_diagnosis(fleet, robot.id, diagnosis)
    if known is None:
        raise HTTPException(404, "this robot has no such diagnosis")
    return known


def _keep_cause(
    fleet: Services, who: Caller, robot: str, diagnosis: str, cause: explanations.GivenCause
) -> None:
    with fleet.database.begin() as connection:
        explanations.keep_cause(connection, robot, diagnosis, cause)
        details = {"diagnosis": diagnosis, "failure_mode": cause.failure_mode, "note": cause.note}
        who.note(connection, cause.at_ns, "diagnoses.cause", robot, details=details)


knowledge_routes = Routes("knowledge")

_AT = "as it was then; empty: now"
At = Annotated[str, Query(max_length=64, description=_AT)]
HashText = Annotated[str, Query(pattern="^([0-9a-f]{64})?$", description="a folder of the robot")]
Hours = Annotated[float | None, Query(ge=0, le=1e6, allow_inf_nan=False)]
Effect = Annotated[str, Query(max_length=200, description="a function or component; empty: all")]
Order = Annotated[int | None, Query(ge=0, le=20, description="cut sets of up to so many events")]
Count = Annotated[int, Query(ge=0, le=10_000)]
ModelName = Annotated[
    str, Query(max_length=64, description="a model's name; empty: the only one of its kind")
]
ResidualName = Annotated[
    str, Query(min_length=1, max_length=200, description="a residual of the model")
]
ModelWords = Annotated[list[Annotated[str, Query(max_length=300)]], Query(max_length=200)]
NO_WORDS: list[str] = []
Most = Annotated[int, Query(ge=1, le=10_000, description="sets, or diagnoses and conflicts")]


class RuleQuestion(Form):
    """A goal for the robot's rules, such as ``broken(X)``, with what they may look up."""

    query: Annotated[str, StringConstraints(min_length=1, max_length=4000)]
    from_: Moment = Field("", alias="from")
    to: Moment = ""
    want: Literal["", "why", "why_not"] = "why"
    config_hash: Hash = ""
    steps: int = Field(0, ge=0, le=50_000_000, description="stop after so many; 0: the default")


@knowledge_routes.get("/robots/{robot}/fmea", "diagnoses.read")
async def read_fmea(
    robot: OfRobot, fleet: Fleet, who: Who, at: At = "", config_hash: HashText = "",
    exposure_h: Hours = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the failure modes of a robot: the sheet, what matters most, what nobody sees."""
    return await knowledge.read_fmea(fleet, who, robot, at, config_hash, exposure_h)


@knowledge_routes.get("/robots/{robot}/faulttrees", "diagnoses.read")
async def read_fault_trees(
    robot: OfRobot, fleet: Fleet, who: Who, effect: Effect = "", at: At = "",
    config_hash: HashText = "", cut_sets: Count = 100, order: Order = None,
    exposure_h: Hours = None, most_probable: Count = 0,
) -> dict[str, Any]:  # fmt: skip
    """Return the fault trees of all functions; of one with cut sets and what matters in it.

    The trees of the folder's ``models/*.xml`` are among them, by their top gate. One that is too
    large has bounds and its most probable cut sets (``incomplete``). ``closest`` are the cut sets
    that the diagnosis that stands brings closest to complete.
    """
    asked = AskTrees(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at, config_hash=config_hash,
        exposure_h=exposure_h, effect=effect, cut_sets=cut_sets, order=order,
        most_probable=most_probable,
    )  # fmt: skip
    return decode_answer(await ask_worker(fleet, who, "fault_trees", asked))


@knowledge_routes.get("/robots/{robot}/models", "diagnoses.read")
async def list_models(
    robot: OfRobot, fleet: Fleet, who: Who, at: At = "", config_hash: HashText = ""
) -> list[ModelLine]:
    """List the models in a robot's folder, by kind and name, with what is wrong with them."""
    return await knowledge.list_models(fleet, who, robot, at, config_hash)


@knowledge_routes.get("/robots/{robot}/structure", "diagnoses.read")
async def read_structure(
    robot: OfRobot, fleet: Fleet, who: Who, model: ModelName = "",
    show: StructureView = "faults", causality: Causality = Causality.MIXED,
    measurable: ModelWords = NO_WORDS, fallible: bool = False, most: Most = 1000,
    at: At = "", config_hash: HashText = "",
) -> dict[str, Any]:  # fmt: skip
    """Return what a model of equations can show: which faults, or sets of equations or sensors.

    ``matrix`` are its equations and unknowns in the order of Dulmage and Mendelsohn.
    """
    asked = AskStructure(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at, config_hash=config_hash,
        model=model, show=show, causality=causality, measurable=measurable, fallible=fallible,
        most=most,
    )  # fmt: skip
    return await knowledge.ask_model(fleet, who, "structure", asked)


@knowledge_routes.get("/robots/{robot}/residual", "data.query")
async def read_residual(
    robot: OfRobot, fleet: Fleet, who: Who, residual: ResidualName, from_: From, to: To,
    model: ModelName = "", points: Annotated[int, Query(ge=1, le=5000)] = 500,
    at: At = "", config_hash: HashText = "",
) -> dict[str, Any]:  # fmt: skip
    """Return the size of a residual of a model of equations over at most six hours, for a plot.

    Of each step of ``step_s`` the size that is greatest by magnitude; null where nothing is
    concluded. Raises HTTPException for a range without an end.
    """
    from_ns, to_ns = robot_span_ns(fleet, robot.id, from_, to)
    if from_ns is None or to_ns is None:
        raise HTTPException(400, "the range needs a beginning and an end")
    asked = AskResidual(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at, config_hash=config_hash,
        model=model, residual=residual, from_ns=from_ns, to_ns=to_ns, points=points,
    )  # fmt: skip
    return await knowledge.ask_model(fleet, who, "residual", asked)


@knowledge_routes.get("/robots/{robot}/consistency", "diagnoses.read")
async def read_consistency(
    robot: OfRobot, fleet: Fleet, who: Who, model: ModelName = "",
    observe: ModelWords = NO_WORDS, minimal: Minimal = "subset", most: Most = 1000,
    at: At = "", config_hash: HashText = "",
) -> dict[str, Any]:  # fmt: skip
    """Return which modes of a model of components agree with its steps, and with ``observe``."""
    asked = AskConsistency(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at, config_hash=config_hash,
        model=model, observe=observe, minimal=minimal, most=most,
    )  # fmt: skip
    return await knowledge.ask_model(fleet, who, "consistency", asked)


@knowledge_routes.post("/robots/{robot}/rules", "diagnoses.write")
async def ask_rules(robot: OfRobot, body: RuleQuestion, fleet: Fleet, who: Who) -> dict[str, Any]:
    """Return all answers of a goal, each with what it follows from, or why there is none."""
    asked = AskRules(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), query=body.query, from_=body.from_,
        to=body.to, want=body.want, config_hash=body.config_hash, steps=body.steps,
    )  # fmt: skip
    return decode_answer(await ask_worker(fleet, who, "rules", asked))


folder_routes = Routes("folders")

FolderHash = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]
FileName = Annotated[str, Path(max_length=512)]


@dataclass(frozen=True, slots=True)
class FolderFiles:
    """The files of one folder."""

    config_hash: str
    files: list[FileInfo]


@folder_routes.get("/robots/{robot}/folder", "folder.read")
def list_folders(robot: OfRobot, fleet: Fleet) -> FolderList:
    """List the folders that a robot had, as far as they are kept."""
    return knowledge.list_folders(fleet, robot)


@folder_routes.get("/robots/{robot}/folder/{config_hash}", "folder.read")
def list_files(robot: OfRobot, config_hash: FolderHash, fleet: Fleet) -> FolderFiles:
    """List the files of a folder. Secrets in them are masked."""
    files = fleet.folders.files(robot.id, config_hash)
    if files is None:
        raise HTTPException(404, "this folder is not here")
    return FolderFiles(config_hash, list(files))


@folder_routes.get(
    "/robots/{robot}/folder/{config_hash}/{name:path}", "folder.read",
    response_class=PlainTextResponse,
)  # fmt: skip
def read_file(
    robot: OfRobot, config_hash: FolderHash, name: FileName, fleet: Fleet, who: Who
) -> PlainTextResponse:
    """Return a file of a folder, as text."""
    data = fleet.folders.read(robot.id, config_hash, name)
    if data is None:
        raise HTTPException(404, "there is no such file, or the folder is not here")
    with fleet.database.begin() as connection:
        details = {"config_hash": config_hash, "file": name}
        who.note(connection, fleet.clock.wall_ns(), "folder.read", robot.id, details=details)
    headers = {"X-Content-Type-Options": "nosniff"}
    return PlainTextResponse(data.decode("utf-8", "replace"), headers=headers)
