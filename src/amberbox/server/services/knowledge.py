"""Diagnoses, failure modes and configuration folders of robots as API and pages show them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from amberbox.core.api import DiagnosisLine, ModelLine
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.report.serialiser import diagnosis_json, to_json
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.bus import ServerChange
from amberbox.server.ingest.folders import KnownFolder
from amberbox.server.knowledge import explanations
from amberbox.server.knowledge.diagnoses import DiagnosisHistory
from amberbox.server.knowledge.questions import (
    LIMIT_S,
    MEMORY_BYTES,
    MODELS_WORKER,
    WORKER,
    AskDiagnosis,
    AskModel,
    RobotQuestion,
    encode_question,
)
from amberbox.server.services.context import Caller, Services


async def read_fmea(
    fleet: Services, who: Caller, robot: KnownRobot, at: str = "", config_hash: str = "",
    exposure_h: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the failure modes of a robot: the sheet, criticality, and undetected faults."""
    asked = RobotQuestion(robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at,
                       config_hash=config_hash, exposure_h=exposure_h)  # fmt: skip
    return decode_answer(await ask_worker(fleet, who, "fmea", asked))


async def ask_worker(
    fleet: Services, who: Caller, name: str, asked: RobotQuestion, worker: str = WORKER
) -> bytes:
    """Let a worker answer a question about a robot; return its JSON."""
    op = f"{worker}:{name}"
    return await fleet.worker_pool.ask(
        op, encode_question(asked), LIMIT_S, MEMORY_BYTES, origin=who.person
    )


async def list_models(
    fleet: Services, who: Caller, robot: KnownRobot, at: str = "", config_hash: str = ""
) -> list[ModelLine]:
    """Return the models of a robot's folder, and what is wrong with them."""
    asked = RobotQuestion(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at, config_hash=config_hash
    )
    found = await ask_worker(fleet, who, "listed", asked, MODELS_WORKER)
    return [ModelLine(**line) for line in json.loads(found)]


async def ask_model(
    fleet: Services, who: Caller,
    name: Literal["structure", "consistency", "components", "residual"], asked: AskModel,
) -> dict[str, Any]:  # fmt: skip
    """Return what a worker answers about a model."""
    return decode_answer(await ask_worker(fleet, who, name, asked, MODELS_WORKER))


_TRIES = 5
"""Number of times an answer is ranked again because another person has answered meanwhile."""


async def answer_tests(
    fleet: Services, who: Caller, robot: str, diagnosis: str, test: str, words: Mapping[str, str],
    details: Mapping[str, Any] | None = None,
) -> bytes:  # fmt: skip
    """Store answers to tests of a diagnosis and rank it anew; return the new ranking, JSON.

    ``test`` is the first of ``words``, answers by test. The robot is told as well. Raises
    UsageError where others answer all the time.
    """
    for _ in range(_TRIES):
        before = await asyncio.to_thread(given_answers, fleet, robot, diagnosis)
        asked = AskDiagnosis(robot=robot, now_ns=fleet.clock.wall_ns(), diagnosis=diagnosis,
                             answers={**before, **words})  # fmt: skip
        answer = await ask_worker(fleet, who, "diagnose", asked)
        about = {"diagnosis": diagnosis, "test": test, "answer": words[test], **(details or {})}
        kept = await asyncio.to_thread(
            _keep_answers, fleet, who, robot, about, words, before, answer
        )  # fmt: skip
        if kept is not None:
            if kept:
                fleet.bus.publish(ServerChange("command", robot, {"ids": []}))
            fleet.bus.publish(ServerChange("diagnosis", robot, {"id": diagnosis}))
            return answer
    raise UsageError("others answer tests of this diagnosis just now", "try again")


def given_answers(fleet: Services, robot: str, diagnosis: str) -> dict[str, str]:
    """Return the last answer to each test of a diagnosis."""
    with fleet.database.reading() as connection:
        return explanations.latest_by_test(explanations.read_answers(connection, robot, diagnosis))


def _keep_answers(
    fleet: Services, who: Caller, robot: str, about: Mapping[str, Any], words: Mapping[str, str],
    before: Mapping[str, str], answer: bytes,
) -> bool | None:  # fmt: skip
    """Store answers and the new ranking; return whether the robot is told.

    None, and nothing is stored, if another answer was stored since ``before``.
    """
    now_ns, person, diagnosis = fleet.clock.wall_ns(), who.person, str(about["diagnosis"])
    others = {test: word for test, word in words.items() if test != about["test"]}
    given, *also = [
        explanations.GivenAnswer(test, word, person, now_ns)
        for test, word in {about["test"]: about["answer"], **others}.items()
    ]
    with fleet.database.begin() as connection:
        known = explanations.read_answers(connection, robot, diagnosis)
        if explanations.latest_by_test(known) != before:
            return None
        explanations.keep_answer(connection, robot, diagnosis, given, answer, also)
        is_told = explanations.send_answers(connection, now_ns, robot, diagnosis, [given, *also])
        details = {**about, **({"also": others} if others else {})}
        who.note(connection, now_ns, "diagnoses.answer", robot, details=details)
    return is_told


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder that a robot had; ``masked`` files had secrets in them when they came."""

    config_hash: str
    received: str
    files: int
    bytes: int
    masked: int
    current: bool


@dataclass(frozen=True, slots=True)
class FolderList:
    """The folders of a robot, the newest first; ``current`` is what it stated last."""

    current: str
    folders: list[Folder]


def list_folders(fleet: Services, robot: KnownRobot) -> FolderList:
    """List the stored versions of a robot's folder."""
    current = fleet.folders.current(robot.id)
    found = fleet.folders.kept(robot.id)
    return FolderList(current, [_shown(folder, current) for folder in found])


def _shown(folder: KnownFolder, current: str) -> Folder:
    return Folder(
        folder.config_hash, format_time(folder.received_ns), folder.files, folder.bytes,
        folder.masked, folder.config_hash == current,
    )  # fmt: skip


def decode_answer(answer: bytes) -> dict[str, Any]:
    """Return an answer in its published form."""
    found: dict[str, Any] = json.loads(answer)
    return found


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


def diagnosis_line(one: DiagnosisHistory) -> DiagnosisLine:
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
    return {**{key: to_json(value) for key, value in shown.items()},
            "symptoms": list(diagnosis.symptoms)}  # fmt: skip
