"""Questions of one's own to a robot's knowledge: what if, and goals for its rules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, cast

from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.knowledge.asked import AskDiagnosis, AskRules, Engine, SymptomWord
from amberbox.fleet.knowledge.explained import Answer
from amberbox.fleet.pages.diagnosis.card import card_of
from amberbox.fleet.pages.diagnosis.parts import Asked, Values

ENGINES = ("covering", "rules", "faulttree")
WORDS: tuple[SymptomWord, ...] = ("present", "absent", "unknown")
WANTS = ("why", "why_not")
INSTANTS_NS = range(10**18, 4 * 10**18)
"""Whole numbers that are times, of 2001 to 2096; nothing else of a robot is as large."""
LINES = 300
"""Lines of one proof that are shown."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a proof: how deep it stands, what it says, and by what it holds or fails."""

    depth: int
    goal: str
    by: str = ""
    fails: bool = False


async def what_if(asked: Asked, symptoms: Mapping[str, SymptomWord], engine: str) -> Values:
    """Return what can be supposed, without asking a worker: the answer comes by itself."""
    seen = await asked.look()
    names = seen.known.last.symptoms if seen.known and seen.stands and not asked.at else ()
    return {
        "symptoms": [{"id": name, "given": symptoms.get(name, "")}
                     for name in dict.fromkeys([*names, *symptoms])],
        "engine": engine if engine in ENGINES else ENGINES[0], "engines": ENGINES,
        "words": WORDS, "changed": bool(symptoms),
    }  # fmt: skip


async def supposed(asked: Asked, symptoms: Mapping[str, SymptomWord], engine: str) -> Values:
    """Return the answer if other things were seen; nothing of it is kept."""
    engine = engine if engine in ENGINES else ENGINES[0]
    found = await asked.fmea()
    error, given = None, symptoms
    try:
        answer = await _supposed(asked, symptoms, engine)
    except UsageError as refused:  # a slip in a symptom: the rest of the form stays
        error, given = refused, {}
        answer = await _supposed(asked, given, engine)
    return {
        "shown": card_of(answer), "known": _known_symptoms(found), "changed": bool(symptoms),
        "error": error,
    }  # fmt: skip


async def _supposed(asked: Asked, symptoms: Mapping[str, SymptomWord], engine: str) -> Answer:
    diagnosis, answers = await asked.standing()
    question = AskDiagnosis(
        robot=asked.robot, now_ns=asked.now_ns, at=asked.at, symptoms=dict(symptoms),
        answers=answers, diagnosis=diagnosis, engine=cast("Engine", engine),
    )  # fmt: skip
    found: Answer = await asked.ask(question)
    return found


async def rules(asked: Asked, query: str, want: str) -> Values:
    """Return what rules say to a goal, with reasons; without a goal nothing is asked."""
    want = want if want in WANTS else WANTS[0]
    values: Values = {"query": query, "want": want, "wants": WANTS, "found": None, "error": None}
    if not query:
        return values
    question = AskRules(
        robot=asked.robot, now_ns=asked.now_ns, query=query, to=asked.at, want=cast("Any", want)
    )
    try:
        found = await asked.ask(question, "rules")
    except UsageError as error:  # a slip in the goal: it stays in its field
        return {**values, "error": error}
    proofs = [*found["proof"], *([] for _ in found["answers"])]
    return {
        **values, "found": found,
        "answers": [
            {"values": {key: _value(value) for key, value in one.items()},
             "lines": _shown(_proof(proof))}
            for one, proof in zip(found["answers"], proofs, strict=False)
        ],
        "failed": _shown(line for entry in found["failed"] for line in _failed(entry, 0)),
    }  # fmt: skip


def _value(value: Any) -> Values:
    """Return a value of an answer; what can only be an instant is shown as one."""
    is_instant = isinstance(value, int) and value in INSTANTS_NS
    return {"text": str(value), "at": format_time(value) if is_instant else None}


def _known_symptoms(found: Answer) -> list[str]:
    cells = (str(row["Detection"]) for row in found["table"])
    return sorted({name.strip() for cell in cells for name in cell.split(";") if name.strip()})


def _shown(lines: Iterator[Line]) -> list[Line]:
    return list(islice(lines, LINES))


def _proof(steps: Sequence[Answer], depth: int = 0) -> Iterator[Line]:
    for step in steps:
        by = ", ".join(filter(None, (str(step["by"]), str(step.get("at", "")))))
        yield Line(depth, str(step["goal"]), by)
        yield from _proof(step.get("because", ()), depth + 1)


def _failed(entry: Answer, depth: int) -> Iterator[Line]:
    yield Line(depth, str(entry["goal"]), str(entry["what"]), fails=True)
    for tried in entry["tried"]:
        yield Line(depth + 1, str(tried["head"]), str(tried["at"]))
        yield from (Line(depth + 2, str(goal)) for goal in tried["held"])
        yield from _failed(tried["failed"], depth + 2)
