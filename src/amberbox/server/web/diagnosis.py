"""The page of a robot's diagnosis: effects, fault trees, history, rules and what-if questions."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Annotated, Any, cast

import msgspec
from fastapi import Query, Request, Response

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timestamps import format_time
from amberbox.core.types import UNKNOWN_FAULT
from amberbox.core.units import percent
from amberbox.diagnosis.diagnose import engine_names
from amberbox.diagnosis.report.wording import capitalize
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.drawing.effects import effect_diagram, effect_graph
from amberbox.server.drawing.faulttree import TreeDrawing, fault_tree
from amberbox.server.http.auth import Fleet, OfRobot, Who
from amberbox.server.knowledge import explanations
from amberbox.server.knowledge.diagnoses import DiagnosisHistory, read_diagnoses
from amberbox.server.knowledge.explanations import Answer
from amberbox.server.knowledge.questions import (
    AskDiagnosis,
    AskRules,
    AskTrees,
    RobotQuestion,
    SymptomWord,
)
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.knowledge import (
    ask_worker,
    diagnosis_line,
    list_models,
    revision_json,
)
from amberbox.server.services.robots import current_status, read_card
from amberbox.server.web.diagnosis_card import (
    CardNextStep,
    CardReason,
    DiagnosisCard,
    DiagnosisView,
    card_now,
    card_of,
    choices_of,
    explained_card,
    leading_faults,
    look,
    minutes,
    missing,
    read_explanation,
    reason_of,
    view_diagnosis_at,
)
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue, drawing_words, moment_href

SHOWN = 50
"""Diagnoses in the history."""

Values = dict[str, Any]


@dataclass(frozen=True, slots=True)
class DiagnosisRequest:
    """A request about a diagnosis of a robot, or about an instant ``at``."""

    fleet: Services
    who: Caller
    robot: str
    diagnosis: str = ""
    at: str = ""

    @property
    def now_ns(self) -> int:
        """The server's time in ns."""
        return self.fleet.clock.wall_ns()

    async def look(self) -> DiagnosisView:
        """Return the requested diagnosis."""
        return await asyncio.to_thread(look, self.fleet, self.robot, self.diagnosis)

    async def standing(self) -> tuple[str, dict[str, str]]:
        """Return id and answers of the open or chosen diagnosis; empty if there is none."""
        seen = await self.look()
        if self.at or seen.known is None or not seen.stands:
            return "", {}
        return seen.known.id, seen.answers

    async def at_then(self) -> Answer:
        """Return the diagnosis at the instant."""
        question = AskDiagnosis(robot=self.robot, now_ns=self.now_ns, at=self.at)
        found: Answer = await self.ask(question)
        return found

    async def answer(self) -> Answer | None:
        """Return the explained diagnosis; None if nothing is known to be broken."""
        if self.at:
            found = await self.at_then()
        else:
            seen = await self.look()
            if not seen.stands:
                return None
            found = await read_explanation(self.fleet, self.who, seen)
        return found if found["explanation"] else None

    async def ask(self, question: RobotQuestion, name: str = "diagnose") -> Any:
        """Return the answer of a worker."""
        return json.loads(await ask_worker(self.fleet, self.who, name, question))

    async def fmea(self, at: str = "") -> Any:
        """Return the robot's FMEA."""
        return await self.ask(RobotQuestion(robot=self.robot, now_ns=self.now_ns, at=at), "fmea")


@dataclass(frozen=True, slots=True)
class Candidate:
    """A possible cause, with the evidence for it, against it, and the symptoms it leaves
    unexplained.
    """

    text: str
    share: str
    leads: bool
    comes_from: Sequence[str] = ()
    remedies: Sequence[str] = ()
    speaks_for: Sequence[CardReason] = ()
    against: Sequence[CardReason] = ()
    open: Sequence[CardReason] = ()
    ids: Sequence[str] = ()
    proof: str = ""


async def others(asked: DiagnosisRequest) -> Values:
    """Return all candidates with their evidence, and all tests."""
    answer = await asked.answer()
    if answer is None:
        return {"answer": None}
    return {
        "answer": answer, "candidates": list(_candidates(answer)), "tests": list(_tests(answer)),
        "given": answer["answers"], "notes": answer["notes"],
        "card": card_of(answer),
    }  # fmt: skip


async def effects(asked: DiagnosisRequest) -> Values:
    """Return the graph from causes to symptoms, as a drawing and as a list."""
    answer = await asked.answer()
    if answer is None:
        return {"answer": None}
    graph = answer["explanation"]["graph"]
    texts = {node["id"]: node["text"] for node in graph["nodes"]}
    label = catalogue().text("diagnosis.details.effects.label", robot=asked.robot)
    return {
        "answer": answer,
        "drawing": effect_graph(
            effect_diagram(graph, _links(answer)), label=label, words=drawing_words()
        ),
        "rows": [
            {"start": texts[e["start"]], "end": texts[e["end"]], "missing": e["missing"]}
            for e in graph["edges"]
        ],
    }  # fmt: skip


async def history(asked: DiagnosisRequest) -> Values:
    """Return earlier diagnoses, and the revisions of the chosen one."""
    seen = await asked.look()
    found = await asyncio.to_thread(_history, asked, seen)
    texts, symptoms = await _texts(asked)
    return {**found, "texts": texts, "symptom_texts": symptoms}


async def cause(asked: DiagnosisRequest) -> Values:
    """Return the causes that can be entered for a diagnosis, and those that were."""
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
    explanation, robot = answer["explanation"], str(answer["robot"])
    hypotheses = {entry["id"]: entry for entry in answer["hypotheses"]}
    seen = _seen(answer)
    groups = (
        [explanation["broken"], *explanation["others"]]
        if explanation["broken"]
        else explanation["others"]
    )
    for place, group in enumerate(groups):
        for member in group["members"]:
            entry = hypotheses.get(member["id"], {})
            kinds = ("explains", "contradicted", "unexplained")
            for_, against, open_ = (
                [_evidence(robot, seen, name) for name in entry.get(kind, ())] for kind in kinds
            )
            yield Candidate(
                capitalize(member["text"]), percent(member["probability"]),
                place == 0 and bool(explanation["broken"]),
                [fault["cause"] for fault in member["faults"] if fault["cause"]],
                [fault["remedy"] for fault in member["faults"] if fault["remedy"]],
                for_, against, open_, [fault["id"] for fault in member["faults"]], member["proof"],
            )  # fmt: skip


def _seen(answer: Answer) -> dict[str, Answer]:
    """Return the details of each symptom, by its id."""
    explanation = answer["explanation"]
    nodes = explanation["graph"]["nodes"]
    found = {n["id"].removeprefix("symptom:"): n for n in nodes if n["kind"] == "symptom"}
    whole = (
        *explanation["because"],
        *explanation["unexplained"],
        *explanation["against"],
        *explanation["blocked"],
    )
    return {**found, **{entry["id"]: entry for entry in whole}}


def _evidence(robot: str, seen: Mapping[str, Answer], name: str) -> CardReason:
    entry = seen.get(name, {"text": name})
    if "measured_from" in entry:
        return reason_of(robot, entry)
    return CardReason(str(entry["text"]), None, "")


def _tests(answer: Answer) -> Iterator[CardNextStep]:
    """Yield all tests; that of the card with the consequences of its answers."""
    step = answer["explanation"]["next"]
    for test in answer["next_tests"]:
        yield CardNextStep(
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
    """Return the description of each failure mode, by its id."""
    return {
        f"{row['Item']}#{row['Failure mode']}": str(row["Description"]) for row in fmea["table"]
    }


async def _texts(asked: DiagnosisRequest) -> tuple[dict[str, str], dict[str, str]]:
    """Return descriptions of failure modes and symptoms; almost none without the robot's folder."""
    other = {UNKNOWN_FAULT: catalogue().text("diagnosis.card.other")}
    try:
        found = await asked.fmea()
    except UsageError:
        return other, {}
    return {**mode_texts(found), **other}, dict(found["symptoms"])


def remarks(seen: DiagnosisView) -> Values:
    """Return answers and causes that people entered, with times as RFC 3339."""
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


def _history(asked: DiagnosisRequest, seen: DiagnosisView) -> Values:
    found = read_diagnoses(asked.fleet, asked.robot)[:SHOWN]
    with asked.fleet.database.reading() as connection:
        causes = explanations.modes_named(connection, asked.robot, [one.id for one in found])
    lines = [{"line": diagnosis_line(one), "causes": causes[one.id]} for one in found]
    return {"lines": lines, "seen": seen, "revisions": _revisions(seen.known), **remarks(seen)}


def _revisions(known: DiagnosisHistory | None) -> list[Values]:
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


async def models(asked: DiagnosisRequest, robot: KnownRobot) -> Values:
    """Return the models of the robot's folder."""
    return {"models": await list_models(asked.fleet, asked.who, robot, asked.at)}


CUT_SETS = 300
"""Number of sets that are evaluated, those with the fewest failures first."""
PATTERNS = 20
"""Number of kinds of sets that are listed."""
IMPORTANT = 10
DEPTH, PLACES = 3, 60
"""How much of a tree is drawn: gates above each other, and places in all."""


async def tree(asked: DiagnosisRequest, effect: str) -> Values:
    """Return the fault tree of a function, by default of one that the diagnosis finds lost.

    Only this tree is solved; the others are listed.
    """
    chosen = effect or await _lost(asked)
    every = await asked.ask(
        AskTrees(
            robot=asked.robot, now_ns=asked.now_ns, at=asked.at, effect=chosen, cut_sets=CUT_SETS
        ),
        "one_tree",
    )
    if every["tree"] is None:
        return {"effects": [], "chosen": "", "tree": None}
    found, shown = every["tree"], msgspec.convert(every["shape"], TreeDrawing)
    near = _near(found)
    texts = {name: event.label or name for name, event in shown.events.items()}
    chosen = found["effect"]
    label = catalogue().text("diagnosis.details.tree.label", text=found["description"] or chosen)
    return {
        "effects": every["functions"], "chosen": chosen, "tree": found, "notes": found["notes"],
        "chance": _chance(found), "closest": _named(near, texts),
        "important": _important(found, texts), "patterns": _patterns(found["cut_sets"], texts),
        "probable": _probable(found, texts),
        "drawing": fault_tree(
            shown, label=label, depth=DEPTH, most=PLACES, cut_set=_happened(near),
            words=drawing_words(),
        ),
    }  # fmt: skip


async def _lost(asked: DiagnosisRequest) -> str:
    """Return the first of the functions that the diagnosis finds lost; empty for none."""
    try:
        answer = await asked.answer()
    except UsageError:
        return ""
    lost = answer["explanation"]["use"]["lost"] if answer else ()
    return next((str(one["id"]) for one in lost), "")


def _patterns(sets: Sequence[Sequence[str]], texts: Mapping[str, str]) -> list[Values]:
    """Group cut sets that differ only in which of several like components fails."""
    found: dict[tuple[tuple[str, str], ...], list[list[str]]] = {}
    for one in sets:
        key = tuple(sorted(_pattern(name) for name in one))
        found.setdefault(key, []).append([texts.get(name, name) for name in one])
    return [{"first": alike[0], "others": alike[1:]} for alike in islice(found.values(), PATTERNS)]


def _pattern(name: str) -> tuple[str, str]:
    """Return the kind of a component and its failure, which like components have in common."""
    part, _, mode = name.partition("#")
    return part.partition("_")[0], mode


def _near(found: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    near = next((one for one in found["closest"] if one["effect"] == found["effect"]), None)
    return near["closest"] if near else ()


def _happened(near: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(near[0]["happened"]) if near else []


def _named(near: Sequence[Mapping[str, Any]], texts: Mapping[str, str]) -> list[Values]:
    return [
        {
            "happened": [texts.get(name, name) for name in one["happened"]],
            "missing": [texts.get(name, name) for name in one["missing"]],
            "share": percent(one["probability"]),
        }
        for one in near
        if one["happened"]
    ]  # fmt: skip


def _important(found: Mapping[str, Any], texts: Mapping[str, str]) -> list[Values]:
    ranked = sorted((found["importance"] or {}).items(), key=lambda item: -(item[1]["cif"] or 0))
    return [{"text": texts.get(name, name), "share": percent(of["cif"] or 0)}
            for name, of in ranked[:IMPORTANT]]  # fmt: skip


def _chance(found: Mapping[str, Any]) -> str:
    """Return the probability, or its two bounds where it is not known exactly."""
    exact, bounds = found["top_probability"], found["probability_bounds"]
    if exact is not None or bounds is None:
        return _small(exact)
    low, high = (f"{value:.3g}" for value in bounds)
    return catalogue().text("diagnosis.details.tree.between", low=low, high=high)


def _probable(found: Mapping[str, Any], texts: Mapping[str, str]) -> Values | None:
    """Return the most probable cut sets of a tree that is too large, and their share."""
    best = found.get("most_probable")
    if best is None or found["minimal_cut_sets"] is not None:
        return None
    share = best["share"]
    return {
        "sets": [
            {
                "events": [texts.get(name, name) for name in one["events"]],
                "chance": _small(one["probability"]),
            }
            for one in best["cut_sets"]
        ],
        "low": percent(share[0]) if share else "",
        "high": percent(share[1]) if share else "",
    }


def _small(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


ENGINES = engine_names()
WORDS: tuple[SymptomWord, ...] = ("present", "absent", "unknown")
WANTS = ("why", "why_not")
INSTANTS_NS = range(10**18, 4 * 10**18)
"""Whole numbers that are times, of 2001 to 2096; nothing else of a robot is as large."""
LINES = 300
"""Lines of one proof that are shown."""


@dataclass(frozen=True, slots=True)
class ProofLine:
    """A line of a proof: depth, goal, and the rule or fact by which it holds or fails."""

    depth: int
    goal: str
    by: str = ""
    fails: bool = False


async def what_if(
    asked: DiagnosisRequest, symptoms: Mapping[str, SymptomWord], engine: str
) -> Values:
    """Return the form for assumed symptoms; its answer is loaded separately."""
    seen = await asked.look()
    names = seen.known.last.symptoms if seen.known and seen.stands and not asked.at else ()
    return {
        "symptoms": [{"id": name, "given": symptoms.get(name, "")}
                     for name in dict.fromkeys([*names, *symptoms])],
        "engine": engine if engine in ENGINES else ENGINES[0], "engines": ENGINES,
        "words": WORDS, "changed": bool(symptoms),
    }  # fmt: skip


async def supposed(
    asked: DiagnosisRequest, symptoms: Mapping[str, SymptomWord], engine: str
) -> Values:
    """Return the diagnosis with assumed symptoms; it is not stored."""
    engine = engine if engine in ENGINES else ENGINES[0]
    found = await asked.fmea()
    error, given = None, symptoms
    try:
        answer = await _supposed(asked, symptoms, engine)
    except UsageError as refused:  # a mistyped symptom: keep the form
        error, given = refused, {}
        answer = await _supposed(asked, given, engine)
    return {
        "shown": card_of(answer), "known": _known_symptoms(found), "changed": bool(symptoms),
        "error": error,
    }  # fmt: skip


async def _supposed(
    asked: DiagnosisRequest, symptoms: Mapping[str, SymptomWord], engine: str
) -> Answer:
    diagnosis, answers = await asked.standing()
    question = AskDiagnosis(
        robot=asked.robot, now_ns=asked.now_ns, at=asked.at, symptoms=dict(symptoms),
        answers=answers, diagnosis=diagnosis, engine=engine,
    )  # fmt: skip
    found: Answer = await asked.ask(question)
    return found


async def rules(asked: DiagnosisRequest, query: str, want: str) -> Values:
    """Return the answers of the rules to a goal, with proofs; no answers without a goal."""
    want = want if want in WANTS else WANTS[0]
    values: Values = {"query": query, "want": want, "wants": WANTS, "found": None, "error": None}
    if not query:
        return values
    question = AskRules(
        robot=asked.robot, now_ns=asked.now_ns, query=query, to=asked.at, want=cast("Any", want)
    )
    try:
        found = await asked.ask(question, "rules")
    except UsageError as error:  # a mistyped goal stays in its field
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
    """Return a value of an answer; an integer in the range of times also as a time."""
    is_instant = isinstance(value, int) and value in INSTANTS_NS
    return {"text": str(value), "at": format_time(value) if is_instant else None}


def _known_symptoms(found: Answer) -> list[str]:
    cells = (str(row["Detection"]) for row in found["table"])
    return sorted({name.strip() for cell in cells for name in cell.split(";") if name.strip()})


def _shown(lines: Iterator[ProofLine]) -> list[ProofLine]:
    return list(islice(lines, LINES))


def _proof(steps: Sequence[Answer], depth: int = 0) -> Iterator[ProofLine]:
    for step in steps:
        by = ", ".join(filter(None, (str(step["by"]), str(step.get("at", "")))))
        yield ProofLine(depth, str(step["goal"]), by)
        yield from _proof(step.get("because", ()), depth + 1)


def _failed(entry: Answer, depth: int) -> Iterator[ProofLine]:
    yield ProofLine(depth, str(entry["goal"]), str(entry["what"]), fails=True)
    for tried in entry["tried"]:
        yield ProofLine(depth + 1, str(tried["head"]), str(tried["at"]))
        yield from (ProofLine(depth + 2, str(goal)) for goal in tried["held"])
        yield from _failed(tried["failed"], depth + 2)


routes = PageRoutes()

TABS = ("others", "effects", "tree", "models", "rules", "whatif", "history", "cause")
WORKER_TABS = ("rules", "whatif")
"""Tabs in which one asks the robot's knowledge something: for operators, as over the API."""

Id = Annotated[str, Query(pattern=r"^[A-Za-z0-9_.:#-]{0,128}$")]
At = Annotated[str, Query(max_length=64)]
Word = Annotated[str, Query(max_length=300)]
Words = Annotated[list[Annotated[str, Query(max_length=300)]], Query(max_length=100)]
NOTHING: list[str] = []
Revision = Annotated[int, Query(ge=0, le=2**62)]
Goal = Annotated[str, Query(max_length=4000)]


@routes.get("/robots/{robot}/diagnosis", "diagnoses.read")
def show(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    tab: Word = "",
) -> Response:  # fmt: skip
    """Show the page of the diagnosis; it does not wait for a worker."""
    now, seen = current_status(fleet, robot), look(fleet, robot.id, diagnosis)
    card, shown = read_card(fleet, robot), card_now(fleet, seen, now)
    may = who.may("diagnoses.write", robot)
    tabs = [name for name in TABS if may or name not in WORKER_TABS]
    lacks = missing(fleet, robot.id, card.last_seen is not None) if not seen.stands else ""
    return render(
        request, "diagnosis/diagnosis.html", card=card, seen=seen, shown=shown, at=at, lacks=lacks,
        tabs=tabs, tab=tab if tab in tabs else tabs[0], may=may,
        before=_before(fleet, seen),
    )  # fmt: skip


@routes.get("/robots/{robot}/diagnosis/card", "diagnoses.read")
async def show_card(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    link: bool = False, revision: Revision = 0,
) -> Response:  # fmt: skip
    """Return the fragment with the card and its explanation.

    ``link``: it links to the page of the diagnosis, for other pages. ``revision``: the diagnosis at
    this revision.
    """
    may = who.may("diagnoses.write", robot)
    then = partial(view_diagnosis_at, revision=revision) if diagnosis and revision else look
    seen = await asyncio.to_thread(then, fleet, robot.id, diagnosis)
    now = await asyncio.to_thread(current_status, fleet, robot)
    try:
        if at:
            answer = await DiagnosisRequest(fleet, who, robot.id, at=at).at_then()
            card, may = replace(card_of(answer), answers={}), False
        else:
            card = await explained_card(fleet, who, seen, now)
    except AmberboxError as error:
        plain = None if at else await asyncio.to_thread(card_now, fleet, seen, now)
        return render(request, "diagnosis/trouble.html", error=error, plain=plain, may=may)
    return render(request, "diagnosis/part.html", shown=card, seen=seen, may=may, link=link)


@routes.get("/robots/{robot}/diagnosis/others", "diagnoses.read")
async def show_others(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = ""
) -> Response:
    """Return the fragment with all candidates and their evidence."""
    asked = DiagnosisRequest(fleet, who, robot.id, diagnosis, at)
    return await _part(request, "others", asked, robot, others(asked))


@routes.get("/robots/{robot}/diagnosis/effects", "diagnoses.read")
async def show_effects(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = ""
) -> Response:
    """Return the fragment with the graph from causes to symptoms."""
    asked = DiagnosisRequest(fleet, who, robot.id, diagnosis, at)
    return await _part(request, "effects", asked, robot, effects(asked))


@routes.get("/robots/{robot}/diagnosis/tree", "diagnoses.read")
async def show_tree(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, at: At = "", effect: Word = ""
) -> Response:
    """Return the fragment with the fault tree of one function."""
    asked = DiagnosisRequest(fleet, who, robot.id, at=at)
    return await _part(request, "tree", asked, robot, tree(asked, effect))


@routes.get("/robots/{robot}/diagnosis/models", "diagnoses.read")
async def show_models(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, at: At = ""
) -> Response:
    """Return the fragment with the models of the robot's folder."""
    asked = DiagnosisRequest(fleet, who, robot.id, at=at)
    return await _part(request, "models", asked, robot, models(asked, robot))


@routes.get("/robots/{robot}/diagnosis/history", "diagnoses.read")
async def show_history(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = ""
) -> Response:
    """Return the fragment with earlier diagnoses and revisions."""
    asked = DiagnosisRequest(fleet, who, robot.id, diagnosis)
    return await _part(request, "history", asked, robot, history(asked))


@routes.get("/robots/{robot}/diagnosis/cause", "diagnoses.read")
async def show_cause(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = ""
) -> Response:
    """Return the fragment with the causes that people entered, and the form for one."""
    asked = DiagnosisRequest(fleet, who, robot.id, diagnosis)
    return await _part(request, "cause", asked, robot, cause(asked))


@routes.get("/robots/{robot}/diagnosis/rules", "diagnoses.write")
async def show_rules(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, at: At = "", q: Goal = "",
    want: Word = "",
) -> Response:  # fmt: skip
    """Return the fragment with the answers of the robot's rules to a goal."""
    asked = DiagnosisRequest(fleet, who, robot.id, at=at)
    return await _part(request, "rules", asked, robot, rules(asked, q.strip(), want))


@routes.get("/robots/{robot}/diagnosis/whatif", "diagnoses.write")
async def show_what_if(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    present: Words = NOTHING, absent: Words = NOTHING, unknown: Words = NOTHING, engine: Word = "",
) -> Response:  # fmt: skip
    """Return the fragment with the form for assumed symptoms."""
    asked = DiagnosisRequest(fleet, who, robot.id, diagnosis, at)
    given = _given(present, absent, unknown)
    return await _part(request, "whatif", asked, robot, what_if(asked, given, engine))


@routes.get("/robots/{robot}/diagnosis/whatif/answer", "diagnoses.write")
async def show_supposed(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, diagnosis: Id = "", at: At = "",
    present: Words = NOTHING, absent: Words = NOTHING, unknown: Words = NOTHING, engine: Word = "",
) -> Response:  # fmt: skip
    """Return the fragment with the diagnosis by assumed symptoms."""
    asked = DiagnosisRequest(fleet, who, robot.id, diagnosis, at)
    given = _given(present, absent, unknown)
    return await _part(request, "supposed", asked, robot, supposed(asked, given, engine))


def _given(present: list[str], absent: list[str], unknown: list[str]) -> dict[str, SymptomWord]:
    return {
        **dict.fromkeys(unknown, "unknown"), **dict.fromkeys(absent, "absent"),
        **dict.fromkeys(present, "present"),
    }  # fmt: skip


async def _part(
    request: Request, tab: str, asked: DiagnosisRequest, robot: KnownRobot,
    made: Awaitable[Values],
) -> Response:  # fmt: skip
    """Return the fragment of a tab, or of the error that prevents it."""
    may = asked.who.may("diagnoses.write", robot)
    try:
        values = await made
    except AmberboxError as error:
        return render(request, "diagnosis/trouble.html", error=error, plain=None, may=may)
    return render(request, f"diagnosis/{tab}.html", asked=asked, may=may, **values)


def _before(fleet: Services, seen: DiagnosisView) -> DiagnosisCard | None:
    """Return the card of the last diagnosis if it has healed, else None."""
    if seen.known is None or seen.stands:
        return None
    return card_now(fleet, replace(seen, is_newest=False))
