"""Diagnoses: what robots found, what the server makes of it, what people add."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
from fastapi import HTTPException, Path, Query
from pydantic import Field, StringConstraints

from amberbox.consult.plain import diagnosis_json, plain
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time, in_order
from amberbox.core.types import Diagnosis
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form, Limit, TimeText, time_of
from amberbox.fleet.bus import Change
from amberbox.fleet.knowledge import notebook
from amberbox.fleet.knowledge.asked import AboutRobot, AskDiagnosis, Engine, SymptomWord, written
from amberbox.fleet.knowledge.listing import Known, diagnoses, find, page
from amberbox.fleet.services import Services

routes = Routes("diagnoses")

WORKER = "amberbox.fleet.knowledge.worker"
LIMIT_S = 20.0
MEMORY_BYTES = 1 << 30
_TRIES = 5
"""So often an answer is ranked anew because somebody else has answered meanwhile."""

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
    engine: Engine = "covering"
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


@dataclass(frozen=True, slots=True)
class DiagnosisLine:
    """A diagnosis in a list; ``faults`` and ``probability`` are those of the leading hypothesis.

    ``first`` and ``last`` are when its first and its last revision was made.
    """

    id: str
    state: Literal["open", "healed"]
    first: str
    last: str
    revisions: int
    faults: list[str]
    probability: float | None
    config_hash: str


@dataclass(frozen=True, slots=True)
class TestAnswer:
    """An answer that somebody gave."""

    test: str
    answer: str
    who: str
    at: str


@dataclass(frozen=True, slots=True)
class Cause:
    """What it was, as somebody says."""

    failure_mode: str
    note: str
    who: str
    at: str


@dataclass(frozen=True, slots=True)
class ServerRevision:
    """What the server made of it with an answer more; ``diagnosis`` is as asking gives it."""

    number: int
    who: str
    at: str
    diagnosis: dict[str, Any]


@dataclass(frozen=True, slots=True)
class DiagnosisDetail:
    """All of a diagnosis: what the robot said, revision by revision, and what people added."""

    id: str
    state: Literal["open", "healed"]
    revisions: list[dict[str, Any]]
    answers: list[TestAnswer]
    server_revisions: list[ServerRevision]
    causes: list[Cause]


@routes.get("/robots/{robot}/diagnoses", "diagnoses.read")
def list_diagnoses(
    robot: OfRobot, fleet: Fleet, from_: Annotated[TimeText, Query(alias="from")] = "",
    to: TimeText = "", after: After = "", limit: Limit = 100,
) -> list[DiagnosisLine]:  # fmt: skip
    """List what a robot found to be broken, the newest first."""
    span = in_order(time_of(from_, fleet.clock), time_of(to, fleet.clock))
    return [line_of(one) for one in page(diagnoses(fleet, robot.id, *span), after, limit)]


@routes.get("/robots/{robot}/diagnoses/{diagnosis}", "diagnoses.read")
def read_diagnosis(robot: OfRobot, diagnosis: Name, fleet: Fleet) -> DiagnosisDetail:
    """Return one diagnosis with all its revisions."""
    known = _known(fleet, robot, diagnosis)
    with fleet.database.reading() as connection:
        given = notebook.given(connection, robot.id, diagnosis)
        said = notebook.causes(connection, robot.id, diagnosis)
        made = notebook.revisions(connection, robot.id, diagnosis)
    return DiagnosisDetail(
        known.id, known.last.state, [revision_json(revision) for revision in known.revisions],
        [TestAnswer(a.test, a.answer, a.who, format_time(a.at_ns)) for a in given],
        [ServerRevision(r.number, r.who, format_time(r.at_ns), r.body) for r in made],
        [Cause(c.failure_mode, c.note, c.who, format_time(c.at_ns)) for c in said],
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
        before = await asyncio.to_thread(_given, fleet, robot.id, body.diagnosis)
        asked = _with_answers(asked, before)
    return _loaded(await _ask(fleet, who, asked))


@routes.post("/robots/{robot}/diagnoses/{diagnosis}/answers", "diagnoses.write")
async def answer_test(
    robot: OfRobot, diagnosis: Name, body: NewAnswer, fleet: Fleet, who: Who
) -> dict[str, Any]:
    """Say what a test gave; the diagnosis is ranked anew, and kept as a revision of the server."""
    await asyncio.to_thread(_known, fleet, robot, diagnosis)
    for _ in range(_TRIES):
        before = await asyncio.to_thread(_given, fleet, robot.id, diagnosis)
        asked = AskDiagnosis(robot=robot.id, now_ns=fleet.clock.wall_ns(), diagnosis=diagnosis,
                             answers={**before, **_said(body)})  # fmt: skip
        answer = await _ask(fleet, who, asked)
        kept = await asyncio.to_thread(
            _keep_answer, fleet, who, robot.id, diagnosis, body, before, answer
        )
        if kept:
            fleet.bus.publish(Change("diagnosis", robot.id, {"id": diagnosis}))
            return _loaded(answer)
    raise UsageError("others answer tests of this diagnosis just now", "try again")


@routes.post("/robots/{robot}/diagnoses/{diagnosis}/cause", "diagnoses.write", status_code=201)
async def say_cause(
    robot: OfRobot, diagnosis: Name, body: NewCause, fleet: Fleet, who: Who
) -> Cause:
    """Say what it was in the end: a failure mode of the robot's analysis."""
    known = await asyncio.to_thread(_known, fleet, robot, diagnosis)
    await _check_mode(fleet, who, known, robot.id, body.failure_mode)
    cause = notebook.Cause(
        body.failure_mode, body.note, who.principal.owner or who.principal.id,
        fleet.clock.wall_ns(),
    )  # fmt: skip
    await asyncio.to_thread(_keep_cause, fleet, who, robot.id, diagnosis, cause)
    fleet.bus.publish(Change("diagnosis", robot.id, {"id": diagnosis}))
    return Cause(cause.failure_mode, cause.note, cause.who, format_time(cause.at_ns))


def _said(body: NewAnswer) -> dict[str, str]:
    """Return all that is answered at once."""
    return {body.test: body.answer, **{t: a for t, a in body.also.items() if t != body.test}}


async def _ask(fleet: Services, who: Caller, asked: AskDiagnosis) -> bytes:
    name = f"{WORKER}:diagnose"
    return await fleet.asking.ask(name, written(asked), LIMIT_S, MEMORY_BYTES, asker=who.asker)


async def _check_mode(
    fleet: Services, who: Caller, known: Known, robot: str, failure_mode: str
) -> None:
    """Refuse what is no failure mode; one that the diagnosis names needs no folder."""
    if any(failure_mode in h.faults for d in known.revisions for h in d.hypotheses):
        return
    asked = AboutRobot(
        robot=robot, now_ns=fleet.clock.wall_ns(), config_hash=known.last.config_hash
    )
    found = await fleet.asking.ask(
        f"{WORKER}:failure_modes", written(asked), LIMIT_S, MEMORY_BYTES, asker=who.asker
    )
    if failure_mode not in json.loads(found):
        what = f"there is no failure mode '{failure_mode}' in the robot's analysis"
        raise UsageError(what, "GET .../fmea lists them; what is not in it belongs in the note")


def _known(fleet: Services, robot: KnownRobot, diagnosis: str) -> Known:
    known = find(fleet, robot.id, diagnosis)
    if known is None:
        raise HTTPException(404, "this robot has no such diagnosis")
    return known


def _given(fleet: Services, robot: str, diagnosis: str) -> dict[str, str]:
    with fleet.database.reading() as connection:
        return notebook.counting(notebook.given(connection, robot, diagnosis))


def _with_answers(asked: AskDiagnosis, before: dict[str, str]) -> AskDiagnosis:
    return msgspec.structs.replace(asked, answers={**before, **asked.answers})


def _keep_answer(
    fleet: Services, who: Caller, robot: str, diagnosis: str, body: NewAnswer,
    before: dict[str, str], answer: bytes,
) -> bool:  # fmt: skip
    """Keep an answer and what follows; False if somebody else has answered since ``before``."""
    now_ns, person = fleet.clock.wall_ns(), who.principal.owner or who.principal.id
    given, *also = [
        notebook.Given(test, word, person, now_ns) for test, word in _said(body).items()
    ]
    with fleet.database.begin() as connection:
        if notebook.counting(notebook.given(connection, robot, diagnosis)) != before:
            return False
        notebook.keep_answer(connection, robot, diagnosis, given, answer, also)
        details: dict[str, Any] = {"diagnosis": diagnosis, "test": body.test, "answer": body.answer}
        details |= {"also": dict(body.also)} if body.also else {}
        who.note(connection, now_ns, "diagnoses.answer", robot, details=details)
    return True


def _keep_cause(
    fleet: Services, who: Caller, robot: str, diagnosis: str, cause: notebook.Cause
) -> None:
    with fleet.database.begin() as connection:
        notebook.keep_cause(connection, robot, diagnosis, cause)
        details = {"diagnosis": diagnosis, "failure_mode": cause.failure_mode, "note": cause.note}
        who.note(connection, cause.at_ns, "diagnoses.cause", robot, details=details)


def line_of(one: Known) -> DiagnosisLine:
    """Return a diagnosis as a list shows it."""
    leading = one.peak.hypotheses[:1]
    return DiagnosisLine(
        one.id, one.last.state, format_time(one.revisions[0].at_ns), format_time(one.last.at_ns),
        len(one.revisions), sorted(leading[0].faults) if leading else [],
        leading[0].probability if leading else None, one.last.config_hash,
    )  # fmt: skip


def revision_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return a revision as the robot wrote it."""
    shown = diagnosis_json(diagnosis)
    return {**{key: plain(value) for key, value in shown.items()},
            "symptoms": list(diagnosis.symptoms)}  # fmt: skip


def _loaded(answer: bytes) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(answer)
    return found
