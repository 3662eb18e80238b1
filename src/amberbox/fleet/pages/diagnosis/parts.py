"""What stands behind "Details" of a diagnosis: one function per tab, each returns what it shows."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.core.errors import UsageError
from amberbox.core.sureness import percent
from amberbox.core.timetext import format_time
from amberbox.core.types import UNKNOWN_FAULT
from amberbox.fleet.api.access import Caller
from amberbox.fleet.api.diagnoses import LIMIT_S, MEMORY_BYTES, WORKER, line_of, revision_json
from amberbox.fleet.drawing.effects import effect_graph, effects_of
from amberbox.fleet.knowledge import notebook
from amberbox.fleet.knowledge.asked import AboutRobot, AskDiagnosis, written
from amberbox.fleet.knowledge.explained import Answer
from amberbox.fleet.knowledge.listing import Known, diagnoses
from amberbox.fleet.pages.datalinks import moment_href
from amberbox.fleet.pages.diagnosis.card import (
    Next,
    Reason,
    card_of,
    choices_of,
    minutes,
    reason_of,
)
from amberbox.fleet.pages.diagnosis.look import Look, answer_told, leading_faults, look
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.pages.wording import capital
from amberbox.fleet.services import Services

SHOWN = 50
"""Diagnoses in the history."""

Values = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Asked:
    """Who asks about which diagnosis of a robot, or about what was at an instant."""

    fleet: Services
    who: Caller
    robot: str
    diagnosis: str = ""
    at: str = ""

    @property
    def now_ns(self) -> int:
        """The server's time."""
        return self.fleet.clock.wall_ns()

    async def look(self) -> Look:
        """Return what is looked at."""
        return await asyncio.to_thread(look, self.fleet, self.robot, self.diagnosis)

    async def standing(self) -> tuple[str, dict[str, str]]:
        """Return which diagnosis is looked at, and the answers to tests that count for it."""
        seen = await self.look()
        if self.at or seen.known is None or not seen.stands:
            return "", {}
        return seen.known.id, seen.answers

    async def at_then(self) -> Answer:
        """Return the answer as of the instant."""
        question = AskDiagnosis(robot=self.robot, now_ns=self.now_ns, at=self.at)
        found: Answer = await self.ask(question)
        return found

    async def answer(self) -> Answer | None:
        """Return the explained answer; None where nothing is known to be broken."""
        if self.at:
            found = await self.at_then()
        else:
            seen = await self.look()
            if not seen.stands:
                return None
            found = await answer_told(self.fleet, self.who, seen)
        return found if found["explanation"] else None

    async def ask(self, question: AboutRobot, name: str = "diagnose") -> Any:
        """Return what a worker says."""
        found = await self.fleet.asking.ask(
            f"{WORKER}:{name}", written(question), LIMIT_S, MEMORY_BYTES, asker=self.who.asker
        )
        return json.loads(found)

    async def fmea(self, at: str = "") -> Any:
        """Return the robot's failure modes."""
        return await self.ask(AboutRobot(robot=self.robot, now_ns=self.now_ns, at=at), "fmea")


@dataclass(frozen=True, slots=True)
class Candidate:
    """One cause that may be, with what speaks for it, against it, and what it leaves open."""

    text: str
    share: str
    leads: bool
    comes_from: Sequence[str] = ()
    remedies: Sequence[str] = ()
    speaks_for: Sequence[Reason] = ()
    against: Sequence[Reason] = ()
    open: Sequence[Reason] = ()
    ids: Sequence[str] = ()
    proof: str = ""


async def others(asked: Asked) -> Values:
    """Return every candidate with its evidence, and all tests that can be answered."""
    answer = await asked.answer()
    if answer is None:
        return {"answer": None}
    return {
        "answer": answer, "candidates": list(_candidates(answer)), "tests": list(_tests(answer)),
        "given": answer["answers"], "notes": answer["notes"],
        "card": card_of(answer),
    }  # fmt: skip


async def effects(asked: Asked) -> Values:
    """Return the graph from causes to what is seen, drawn and as a list."""
    answer = await asked.answer()
    if answer is None:
        return {"answer": None}
    graph = answer["explanation"]["graph"]
    texts = {node["id"]: node["text"] for node in graph["nodes"]}
    label = catalogue().text("diagnosis.details.effects.label", robot=asked.robot)
    return {
        "answer": answer,
        "drawing": effect_graph(
            effects_of(graph, _links(answer)), label=label, words=drawing_words()
        ),
        "rows": [
            {"start": texts[e["start"]], "end": texts[e["end"]], "missing": e["missing"]}
            for e in graph["edges"]
        ],
    }  # fmt: skip


async def history(asked: Asked) -> Values:
    """Return what was found before, and the revisions of the one that is looked at."""
    seen = await asked.look()
    found = await asyncio.to_thread(_history, asked, seen)
    texts, symptoms = await _texts(asked)
    return {**found, "texts": texts, "symptom_texts": symptoms}


async def cause(asked: Asked) -> Values:
    """Return what can be said of what it was, and what was said."""
    seen = await asked.look()
    if seen.known is None:
        return {"seen": seen}
    texts = mode_texts(await asked.fmea())
    modes = [{"id": name, "text": text} for name, text in texts.items()]
    named = leading_faults(asked.fleet, seen)
    leading = [{"id": name, "text": texts[name]} for name in dict.fromkeys(named) if name in texts]
    rest = sorted((m for m in modes if m not in leading), key=lambda mode: str(mode["id"]))
    return {"seen": seen, "modes": rest, "leading": leading, "texts": texts,
            **remarks(seen)}  # fmt: skip


def _candidates(answer: Answer) -> Iterator[Candidate]:
    told, robot = answer["explanation"], str(answer["robot"])
    hypotheses = {entry["id"]: entry for entry in answer["hypotheses"]}
    seen = _seen(answer)
    groups = [told["broken"], *told["others"]] if told["broken"] else told["others"]
    for place, group in enumerate(groups):
        for member in group["members"]:
            entry = hypotheses.get(member["id"], {})
            kinds = ("explains", "contradicted", "unexplained")
            for_, against, open_ = (
                [_evidence(robot, seen, name) for name in entry.get(kind, ())] for kind in kinds
            )
            yield Candidate(
                capital(member["text"]), percent(member["probability"]),
                place == 0 and bool(told["broken"]),
                [fault["cause"] for fault in member["faults"] if fault["cause"]],
                [fault["remedy"] for fault in member["faults"] if fault["remedy"]],
                for_, against, open_, [fault["id"] for fault in member["faults"]], member["proof"],
            )  # fmt: skip


def _seen(answer: Answer) -> dict[str, Answer]:
    """Return what is known in words of each symptom."""
    told = answer["explanation"]
    nodes = told["graph"]["nodes"]
    found = {n["id"].removeprefix("symptom:"): n for n in nodes if n["kind"] == "symptom"}
    whole = (*told["because"], *told["unexplained"], *told["against"], *told["blocked"])
    return {**found, **{entry["id"]: entry for entry in whole}}


def _evidence(robot: str, seen: Mapping[str, Answer], name: str) -> Reason:
    entry = seen.get(name, {"text": name})
    if "measured_from" in entry:
        return reason_of(robot, entry)
    return Reason(str(entry["text"]), None, "")


def _tests(answer: Answer) -> Iterator[Next]:
    """Yield all tests, the one of the card first with what its answers would mean."""
    step = answer["explanation"]["next"]
    for test in answer["next_tests"]:
        yield Next(
            test["text"], test["id"], test["role"], minutes(test["cost_s"]),
            choices=choices_of(test, step if step["test"] == test["id"] else None),
        )  # fmt: skip


def _links(answer: Answer) -> dict[str, str]:
    robot = str(answer["robot"])
    return {
        f"symptom:{name}": moment_href(robot, entry["measured_from"], entry["onset_ns"])
        for name, entry in _seen(answer).items() if "measured_from" in entry
    }  # fmt: skip


def mode_texts(fmea: Answer) -> dict[str, str]:
    """Return what each failure mode is called, by its id."""
    return {
        f"{row['Item']}#{row['Failure mode']}": str(row["Description"]) for row in fmea["table"]
    }


async def _texts(asked: Asked) -> tuple[dict[str, str], dict[str, str]]:
    """Return what failure modes and symptoms are called; without the robot's folder nothing."""
    other = {UNKNOWN_FAULT: catalogue().text("diagnosis.card.other")}
    try:
        found = await asked.fmea()
    except UsageError:
        return other, {}
    return {**mode_texts(found), **other}, dict(found["symptoms"])


def remarks(seen: Look) -> Values:
    """Return what people said of a diagnosis, with times as pages show them."""
    return {
        "given": [
            {"test": one.test, "answer": one.answer, "who": one.who, "at": format_time(one.at_ns)}
            for one in seen.given
        ],
        "causes": [
            {"failure_mode": one.failure_mode, "note": one.note, "who": one.who,
             "at": format_time(one.at_ns)}
            for one in seen.causes
        ],
    }  # fmt: skip


def _history(asked: Asked, seen: Look) -> Values:
    found = diagnoses(asked.fleet, asked.robot)[:SHOWN]
    with asked.fleet.database.reading() as connection:
        said = notebook.modes_named(connection, asked.robot, [one.id for one in found])
    lines = [{"line": line_of(one), "causes": said[one.id]} for one in found]
    return {"lines": lines, "seen": seen, "revisions": _revisions(seen.known), **remarks(seen)}


def _revisions(known: Known | None) -> list[Values]:
    shown = [revision_json(one) for one in known.revisions] if known else []
    return [
        {
            "number": one["revision"], "at": one["at"], "state": one["state"],
            "faults": one["hypotheses"][0]["faults"] if one["hypotheses"] else [],
            "share": percent(one["hypotheses"][0]["probability"]) if one["hypotheses"] else "",
            "symptoms": one["symptoms"],
        }
        for one in reversed(shown)
    ]  # fmt: skip
