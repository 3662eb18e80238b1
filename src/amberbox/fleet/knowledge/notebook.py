"""What people say about diagnoses: answers to tests, what it was in the end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
from sqlalchemy import Connection, Row, Table, select

from amberbox.fleet.knowledge.tables import ANSWER, CAUSE, REVISION


@dataclass(frozen=True, slots=True)
class Given:
    """An answer to a test: what, by whom, when."""

    test: str
    answer: str
    who: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class Cause:
    """What it was, as somebody says."""

    failure_mode: str
    note: str
    who: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class Revision:
    """What the server made of a diagnosis with an answer more."""

    number: int
    who: str
    at_ns: int
    body: dict[str, Any]


def given(connection: Connection, robot: str, diagnosis: str) -> list[Given]:
    """Return all answers that were given to a diagnosis, in order."""
    rows = _rows(connection, ANSWER, robot, diagnosis)
    return [Given(row.test, row.answer, row.who, row.at_ns) for row in rows]


def counting(answers: list[Given]) -> dict[str, str]:
    """Return the answers that count: of several to one test the last."""
    return {one.test: one.answer for one in answers}


def causes(connection: Connection, robot: str, diagnosis: str) -> list[Cause]:
    """Return what it was, by everybody who has said so."""
    rows = _rows(connection, CAUSE, robot, diagnosis)
    return [Cause(row.failure_mode, row.note, row.who, row.at_ns) for row in rows]


def modes_named(
    connection: Connection, robot: str, diagnoses: Sequence[str]
) -> dict[str, list[str]]:
    """Return by diagnosis which failure modes people said it was, in order."""
    chosen = select(CAUSE).where(CAUSE.c.robot == robot, CAUSE.c.diagnosis.in_(diagnoses))
    found: dict[str, list[str]] = {one: [] for one in diagnoses}
    for row in connection.execute(chosen.order_by(CAUSE.c.number)):
        found[row.diagnosis].append(row.failure_mode)
    return found


def revisions(connection: Connection, robot: str, diagnosis: str) -> list[Revision]:
    """Return what the server made of a diagnosis, in order; numbers count from 1."""
    rows = _rows(connection, REVISION, robot, diagnosis)
    return [
        Revision(number, row.who, row.at_ns, msgspec.json.decode(row.body))
        for number, row in enumerate(rows, 1)
    ]


def keep_answer(
    connection: Connection, robot: str, diagnosis: str, one: Given, body: bytes,
    also: Sequence[Given] = (),
) -> None:  # fmt: skip
    """Keep an answer, with others that were given at once, and what follows."""
    about = {"robot": robot, "diagnosis": diagnosis, "who": one.who, "at_ns": one.at_ns}
    rows = [{**about, "test": of.test, "answer": of.answer} for of in (one, *also)]
    connection.execute(ANSWER.insert(), rows)
    connection.execute(REVISION.insert(), [{**about, "body": body.decode()}])


def keep_cause(connection: Connection, robot: str, diagnosis: str, cause: Cause) -> None:
    """Keep what it was."""
    row = {
        "robot": robot, "diagnosis": diagnosis, "failure_mode": cause.failure_mode,
        "note": cause.note, "who": cause.who, "at_ns": cause.at_ns,
    }  # fmt: skip
    connection.execute(CAUSE.insert(), [row])


def _rows(connection: Connection, table: Table, robot: str, diagnosis: str) -> list[Row[Any]]:
    chosen = select(table).where(table.c.robot == robot, table.c.diagnosis == diagnosis)
    return list(connection.execute(chosen.order_by(table.c.number)))
