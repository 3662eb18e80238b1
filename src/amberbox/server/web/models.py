"""Pages of the models in a robot's folder: structure of equations, consistency of components."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import HTTPException, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from amberbox.core.api import ModelLine
from amberbox.core.equations.structure import Causality
from amberbox.core.errors import AmberboxError
from amberbox.diagnosis.consistency.question import Minimal
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.drawing.graph import select_components
from amberbox.server.drawing.parts import PartBox, PartLevel, parts_graph
from amberbox.server.http.auth import Fleet, OfRobot, Who
from amberbox.server.knowledge.questions import AskConsistency, AskStructure, StructureView
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.knowledge import ask_model, list_models
from amberbox.server.services.robots import read_card
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue

Values = dict[str, Any]
Answer = Mapping[str, Any]

VIEWS: Sequence[StructureView] = (
    "matrix", "faults", "mso", "mtes", "sensor_sets", "residuals",
)  # fmt: skip
SECONDS = 5.0
"""How long a search may take for a page."""
SETS, SHOWN_SETS = 1000, 200
ROWS, COLUMNS, FAULTS = 120, 160, 100
"""Equations, unknowns and faults of a matrix; to see others, one searches."""
DRAWN = 80
RESIDUALS = 24
"""Residuals that are listed and drawn; to see others, one searches."""
PORTS = 2000
LISTED = 200
NAMES = 50
"""Names in one cell or line of a list."""
LONGEST = 60
"""Characters of a name that are shown."""


@dataclass(frozen=True, slots=True)
class ModelQuery:
    """What is chosen on a page, as in the address."""

    q: str = ""
    show: StructureView = "matrix"
    causality: Causality = Causality.MIXED
    fallible: bool = False
    observe: tuple[str, ...] = ()
    minimal: Minimal = "subset"

    def address(self, **changes: Any) -> str:
        """Return the address of this query with some of it changed."""
        known = {name: getattr(self, name) for name in self.__slots__} | changes
        default = ModelQuery()
        given = {name: value for name, value in known.items() if value != getattr(default, name)}
        return "?" + urlencode({k: "1" if v is True else v for k, v in given.items()}, doseq=True)

    def fits(self, *texts: str) -> bool:
        """Return whether each word that is searched for is in one of the texts."""
        return all(
            any(word in text.casefold() for text in texts) for word in self.q.casefold().split()
        )


routes = PageRoutes()

ModelName = Annotated[str, Path(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$")]
Text = Annotated[str, Query(max_length=128)]
Words = Annotated[list[Annotated[str, Query(max_length=300)]], Query(max_length=100)]
NOTHING: list[str] = []


@routes.get("/robots/{robot}/models/{name}", "diagnoses.read")
async def show_model(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who, name: ModelName, q: Text = "",
    show: StructureView = "matrix", causality: Causality = Causality.MIXED,
    fallible: bool = False, observe: Words = NOTHING, minimal: Minimal = "subset",
) -> Response:  # fmt: skip
    """Show a model: of equations its matrix, faults and sets, of components what agrees."""
    line = next((one for one in await list_models(fleet, who, robot) if one.name == name), None)
    if line is None:
        raise HTTPException(404, catalogue().text("models.missing", name=name))
    seen = tuple(dict.fromkeys(entry.strip() for entry in observe if entry.strip()))
    look = ModelQuery(q.strip(), show, causality, fallible, seen, minimal)
    found, problem = await _answered(fleet, who, robot, line, look)
    return await run_in_threadpool(_page, request, fleet, robot, line, look, found, problem)


async def _answered(
    fleet: Services, who: Caller, robot: KnownRobot, line: ModelLine, look: ModelQuery
) -> tuple[Answer | None, AmberboxError | None]:
    """Return what is known of a model, and what went wrong.

    Of a model of components also if nothing can be said of what somebody has observed.
    """
    if line.problems:
        return None, None
    now_ns = fleet.clock.wall_ns()
    try:
        if line.kind == "equations":
            structure = AskStructure(
                robot=robot.id, now_ns=now_ns, model=line.name, show=look.show,
                causality=look.causality, fallible=look.fallible, seconds=SECONDS, most=SETS,
            )  # fmt: skip
            return await ask_model(fleet, who, "structure", structure), None
        asked = AskConsistency(
            robot=robot.id, now_ns=now_ns, model=line.name, observe=list(look.observe),
            minimal=look.minimal, seconds=SECONDS, most=SETS,
        )  # fmt: skip
        return await ask_model(fleet, who, "components", asked), None
    except AmberboxError as error:
        if not look.observe:
            return None, error
        found, _ = await _answered(fleet, who, robot, line, replace(look, observe=()))
        return found, error


def _page(
    request: Request, fleet: Services, robot: KnownRobot, line: ModelLine, look: ModelQuery,
    found: Answer | None, problem: AmberboxError | None,
) -> Response:  # fmt: skip
    values: Values = {"problems": line.problems}
    template = "models/wrong.html"
    if found is not None:
        make = equations if line.kind == "equations" else components
        values, template = make(found, look), f"models/{line.kind}.html"
    values |= {"name": line.name, "look": look, "problem": problem}
    strings = ("plot", "data") if values.get("curves") else ()
    return render(request, template, strings=strings, card=read_card(fleet, robot), **values)


def equations(found: Answer, look: ModelQuery) -> Values:
    """Return what the page of a model of equations shows."""
    parts = {"matrix": matrix, "faults": faults, "residuals": residuals}
    part = parts.get(look.show, sets)
    return {"views": VIEWS, "incomplete": found["incomplete"], "curves": [], **part(found, look)}


def matrix(found: Answer, look: ModelQuery) -> Values:
    """Return the equations that fit the search, with a cell for each unknown in one of them."""
    every = found["equations"]
    chosen = [
        one for one in every
        if look.fits(one["name"], *one["faults"], *one["unknowns"], *one["known"])
    ]  # fmt: skip
    rows = chosen[:ROWS]
    inside = {unknown for row in rows for unknown in row["unknowns"]}
    some = [one for one in found["unknowns"] if one["name"] in inside or not look.q]
    columns = some[:COLUMNS]
    return {
        "rows": [_row(row, columns) for row in rows],
        "columns": [{"name": short(one["name"]), "part": one["part"]} for one in columns],
        "fitting": len(chosen), "equations": len(every), "unknowns": len(some),
        "parts": list(dict.fromkeys(one["part"] for one in (*every, *found["unknowns"]))),
        "faulty": any(row["faults"] for row in rows), "knows": any(row["known"] for row in rows),
    }  # fmt: skip


def _row(row: Mapping[str, Any], columns: Sequence[Mapping[str, Any]]) -> Values:
    inside = set(row["unknowns"])
    return {
        "name": short(row["name"]), "part": row["part"], "faults": some(row["faults"]),
        "known": some(row["known"]),
        "cells": [_cell(row, column, inside) for column in columns],
    }  # fmt: skip


def _cell(row: Mapping[str, Any], column: Mapping[str, Any], inside: set[str]) -> tuple[str, str]:
    """Return the class and the sign of a cell: I is integrated, D differentiated, ● any other."""
    block = column["part"] if row["block"] == column["block"] else ""
    if column["name"] not in inside:
        return block, ""
    sign = "●"
    if row["derivative"]:
        sign = "D" if column["name"] == row["derivative"] else "I"
    return f"{block} on".strip(), sign


def faults(found: Answer, look: ModelQuery) -> Values:
    """Return the faults that fit the search, and which others each may be taken for."""
    mistaken = found["not_told_from"]
    chosen = [name for name in mistaken if look.fits(name)]
    shown = chosen[:FAULTS]
    seen = set(found["detectable"])
    return {
        "faults": [
            {
                "name": short(name), "is_seen": name in seen,
                "others": some([one for one in mistaken[name] if one != name]),
                "cells": [
                    ("on" if column == name else "on other") if column in mistaken[name] else ""
                    for column in shown
                ],
            }
            for name in shown
        ],
        "fitting": len(chosen), "all": len(mistaken), "seen": len(seen),
        "redundancy": found["redundancy"], "causalities": [one.value for one in Causality],
    }  # fmt: skip


def residuals(found: Answer, look: ModelQuery) -> Values:
    """Return the residuals that fit the search, and those of them that are drawn."""
    every = found["residuals"]
    chosen = [one for one in every if look.fits(one["name"], one["checks"], *one["components"])]
    shown = chosen[:RESIDUALS]
    return {
        "residuals": [
            {
                "name": short(one["name"]), "checks": short(one["checks"]),
                "components": some(one["components"]), "threshold": one["threshold"],
                "problem": one["problem"],
            }
            for one in shown
        ],
        "curves": [
            {
                "name": one["name"], "threshold": one["threshold"],
                "item": one["reads"][0].partition(".")[0],
            }
            for one in shown if not one["problem"]
        ],
        "fitting": len(chosen), "all": len(every),
    }  # fmt: skip


def sets(found: Answer, look: ModelQuery) -> Values:
    """Return the sets that fit the search, the smallest first."""
    every = found[look.show]
    chosen = [one for one in every if look.fits(*one)]
    return {
        "sets": list(map(some, chosen[:SHOWN_SETS])),
        "fitting": len(chosen), "all": len(every),
    }  # fmt: skip


def components(found: Answer, look: ModelQuery) -> Values:
    """Return what the page of a model of components shows."""
    answer = found["answer"]
    parts = list(_parts(found))
    chosen = [part for part in parts if look.fits(part.name, part.type)]
    drawn = _drawn(parts, chosen, found["connections"], look)
    label = catalogue().text("models.parts.label", name=found["model"])
    return {
        "parts": chosen[:LISTED], "fitting": len(chosen), "all": len(parts),
        "part_modes": {
            part.name: some(found["modes"][found["components"][part.name]])
            for part in chosen[:LISTED]
        },
        "ports": found["ports"][:PORTS], "steps": list(map(some, found["steps"][:LISTED])),
        "step_count": len(found["steps"]), "answer": answer,
        "diagnoses": [] if answer is None else _ranked(answer),
        "conflicts": [] if answer is None else list(map(some, answer["conflicts"][:SHOWN_SETS])),
        "incomplete": "" if answer is None else answer["incomplete"],
        "drawn": len(drawn),
        "drawing": parts_graph(drawn, found["connections"], label=label),
    }  # fmt: skip


def _parts(found: Answer) -> Iterator[PartBox]:
    """Yield each component, with how it stands in the diagnoses if anything was observed."""
    answer = found["answer"]
    named = [
        {mode.rpartition("=")[0] for mode in diagnosis}
        for diagnosis in (answer["diagnoses"] if answer else ())
    ]
    for name, kind in found["components"].items():
        if answer is None:
            yield PartBox(name, short(kind))
        else:
            level, text = _state(name, named, answer)
            yield PartBox(name, short(kind), level, catalogue().text(text))


def _state(name: str, named: Sequence[Collection[str]], answer: Answer) -> tuple[PartLevel, str]:
    """Return the level of a component, and the name of its text: in how many diagnoses it is."""
    count = sum(name in one for one in named)
    if not answer["incomplete"] and named and count == len(named):
        return "error", "models.state.every"
    if count:
        return "warn", "models.state.some"
    if answer["incomplete"] or not named:
        return "unknown", "models.state.unknown"
    return "ok", "models.state.none"


def _drawn(
    parts: Sequence[PartBox], chosen: Sequence[PartBox], connections: Sequence[Sequence[str]],
    look: ModelQuery,
) -> list[PartBox]:  # fmt: skip
    """Return the components to draw: what is searched for or suspected, then what is nearest."""
    first = chosen if look.q else [part for part in parts if part.level in ("error", "warn")]
    pairs = [
        (ports[0].rpartition(".")[0], other.rpartition(".")[0])
        for ports in connections for other in ports[1:]
    ]  # fmt: skip
    wanted = [part.name for part in first[:DRAWN]]
    names = select_components([part.name for part in parts], wanted, pairs, DRAWN)
    return [part for part in parts if part.name in names]


def _ranked(answer: Answer) -> list[tuple[int, list[str]]]:
    """Return the diagnoses with their ranks, the most probable first."""
    ranked = sorted(zip(answer["ranks"], answer["diagnoses"], strict=True), key=lambda one: one[0])
    return [(rank, some(names)) for rank, names in ranked[:SHOWN_SETS]]


def some(names: Sequence[str]) -> list[str]:
    """Return names as they are shown, and how many more there are."""
    shown = list(map(short, names[:NAMES]))
    if len(names) > NAMES:
        shown.append(catalogue().text("models.more_names", n=len(names) - NAMES))
    return shown


def short(name: str) -> str:
    """Return a name of a robot's file as it is shown."""
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
