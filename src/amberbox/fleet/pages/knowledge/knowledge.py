"""What robots know: their failure modes, how these are seen, and what nobody sees."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import quote

from fastapi import Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from amberbox.core.errors import AmberboxError
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Who
from amberbox.fleet.api.folders import list_folders
from amberbox.fleet.api.knowledge import read_fmea
from amberbox.fleet.api.robots import list_cards
from amberbox.fleet.drawing.matrix import criticality_matrix
from amberbox.fleet.pages.drawingwords import drawing_words
from amberbox.fleet.pages.knowledge.sheet import (
    COLUMNS,
    Look,
    Mode,
    as_csv_rows,
    chosen,
    matrix_of,
    modes_of,
)
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.pages.strings import catalogue
from amberbox.fleet.services import Services

routes = Pages()

_MOST = 10_000
Text = Annotated[str, Query(max_length=128)]


@dataclass(frozen=True, slots=True)
class RuleFile:
    """A file of rules in a robot's folder."""

    name: str
    bytes: int
    href: str


@routes.get("/knowledge", "diagnoses.read", each=True)
def show_all(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show of which robots failure modes are known."""
    cards = [card for card in list_cards(fleet, who, "", "", _MOST) if card.config_hash]
    return render(request, "knowledge/knowledge.html", cards=cards)


@routes.get("/knowledge/{robot}", "diagnoses.read")
async def show(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who,
    q: Text = "", severity: Text = "", occurrence: Text = "",
    seen: Literal["", "yes", "no"] = "", sort: Text = "Cm",
) -> Response:  # fmt: skip
    """Show a robot's sheet, what matters most in it, its coverage and its rules."""
    look = Look(q, severity, occurrence, seen, sort if sort in COLUMNS else "Cm")
    try:
        found = await read_fmea(robot, fleet, who, "", "", None)
    except AmberboxError as error:
        nothing: dict[str, Any] = {"robot": robot.id, "problem": error, "found": None}
        return await run_in_threadpool(render, request, "knowledge/robot.html", **nothing)
    return await run_in_threadpool(_sheet, request, fleet, who, robot, found, look)


def _sheet(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, found: Mapping[str, Any],
    look: Look,
) -> Response:  # fmt: skip
    modes = modes_of(found)
    return render(
        request, "knowledge/robot.html", robot=robot.id, problem=None, found=found, look=look,
        modes=chosen(modes, look), all=modes, alike=_alike(found, modes),
        matrix=criticality_matrix(matrix_of(modes, look),
                                  label=catalogue().text("knowledge.matrix.label"),
                                  words=drawing_words()),
        rules=list(_rules(fleet, robot, who)), may_read=who.may("folder.read", robot),
    )  # fmt: skip


@routes.get("/knowledge/{robot}/modes.csv", "diagnoses.read")
async def download(robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Return the sheet for a spreadsheet; nothing in it is taken for a formula there."""
    found = await read_fmea(robot, fleet, who, "", "", None)
    written = io.StringIO()
    rows = as_csv_rows(modes_of(found))
    csv.writer(written).writerows([_harmless(cell) for cell in row] for row in rows)
    name = f"failure-modes-{robot.id}.csv"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(written.getvalue(), media_type="text/csv; charset=utf-8", headers=headers)


def _harmless(cell: str) -> str:
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t", "\r") else cell


def _alike(found: Mapping[str, Any], modes: Sequence[Mode]) -> Sequence[Mapping[str, Any]]:
    """Return groups of failure modes that look alike, with what tells them apart."""
    texts = {mode.id: mode.row["Description"] or mode.id for mode in modes}
    return [{**group, "texts": [texts.get(one, one) for one in group["modes"]]}
            for group in found["coverage"]["alike"]]  # fmt: skip


def _rules(fleet: Services, robot: KnownRobot, who: Caller) -> Iterator[RuleFile]:
    """Yield the rules of the folder that counts, for those who may read it."""
    current = list_folders(robot, fleet).current
    if not current or not who.may("folder.read", robot):
        return
    for file in fleet.folders.files(robot.id, current) or ():
        if file.name.endswith(".pl"):
            href = f"/api/v1/robots/{robot.id}/folder/{current}/{quote(file.name)}"
            yield RuleFile(file.name, file.bytes, href)
