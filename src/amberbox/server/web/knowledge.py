"""Pages of robots' FMEA: failure modes, their detection, and what is not detected."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

from fastapi import Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from amberbox.core.errors import AmberboxError
from amberbox.core.robot_status import SEVERITIES
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.drawing.charts import MatrixCell, MatrixChart, criticality_matrix
from amberbox.server.http.auth import Fleet, OfRobot, Who
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.knowledge import list_folders, read_fmea
from amberbox.server.services.robots import list_cards
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue, drawing_words

OCCURRENCES = ("A frequent", "B probable", "C occasional", "D remote", "E extremely unlikely")
COLUMNS = ("Item", "Failure mode", "Severity", "S", "O", "D", "RPN", "Rate (1/h)", "Cm")
"""Columns by which one may sort; numbers go from the greatest."""
_NUMBERS = ("S", "O", "D", "RPN", "Rate (1/h)", "Cm", "Probability")


@dataclass(frozen=True, slots=True)
class SheetQuery:
    """Query of the FMEA table, as in the address."""

    q: str = ""
    severity: str = ""
    occurrence: str = ""
    seen: str = ""
    sort: str = "Cm"

    def address(self, **changes: str) -> str:
        """Return the address of this query with some of it changed."""
        known = {name: getattr(self, name) for name in self.__slots__} | changes
        return "?" + urlencode({name: value for name, value in known.items() if value})


@dataclass(frozen=True, slots=True)
class SheetRow:
    """A row of the FMEA: ``id`` as diagnoses name it, ``cell`` its place in the matrix."""

    id: str
    row: Mapping[str, str]
    cell: tuple[str, str]
    unseen: str
    weak: float

    @property
    def checks(self) -> Sequence[str]:
        """Return the checks that detect it: those of monitors, and tests by people."""
        return [check for check in self.row["Detection"].split("; ") if check]

    @property
    def is_seen(self) -> bool:
        """Return whether any monitor or test can detect it."""
        return not self.unseen


def modes_of(found: Mapping[str, Any]) -> Sequence[SheetRow]:
    """Return the rows of an FMEA that the API returned."""
    coverage = found["coverage"]
    cells = {mode: (cell["occurrence"], cell["severity"])
             for cell in found["criticality"]["matrix"] for mode in cell["modes"]}  # fmt: skip
    return [
        SheetRow(
            name,
            row,
            cells.get(name, ("", row["Severity"])),
            coverage["unseen"].get(name, ""),
            float(coverage["weak"].get(name, 0.0)),
        )
        for row in found["table"]
        for name in (f"{row['Item']}#{row['Failure mode']}",)
    ]


def chosen(modes: Sequence[SheetRow], look: SheetQuery) -> Sequence[SheetRow]:
    """Return the rows that match the query, sorted by it."""
    return sorted((mode for mode in modes if _fits(mode, look)), key=lambda m: _key(m, look.sort))


def matrix_of(modes: Sequence[SheetRow], look: SheetQuery) -> MatrixChart:
    """Return the criticality matrix; each cell links to its failure modes."""
    counts: dict[tuple[str, str], int] = {}
    for mode in modes:
        counts[mode.cell] = counts.get(mode.cell, 0) + 1
    rows = [row for row in OCCURRENCES if any(cell[0] == row for cell in counts)]
    mine = (look.occurrence, look.severity)
    return MatrixChart(rows, SEVERITIES, {
        cell: MatrixCell(count, _leads(look, cell, is_mine=cell == mine), cell == mine)
        for cell, count in counts.items()
    })  # fmt: skip


def as_csv_rows(modes: Sequence[SheetRow]) -> Iterator[Sequence[str]]:
    """Yield the FMEA as rows of text, the header first."""
    if modes:
        yield list(modes[0].row)
    yield from (list(mode.row.values()) for mode in modes)


def _leads(look: SheetQuery, cell: tuple[str, str], *, is_mine: bool) -> str:
    occurrence, severity = ("", "") if is_mine else cell
    return look.address(occurrence=occurrence, severity=severity) + "#modes"


def _fits(mode: SheetRow, look: SheetQuery) -> bool:
    words = " ".join(mode.row.values()).casefold()
    return (
        all(word in words for word in look.q.casefold().split())
        and look.severity in ("", mode.row["Severity"])
        and look.occurrence in ("", mode.cell[0])
        and look.seen in ("", "yes" if mode.is_seen else "no")
    )


def _key(mode: SheetRow, sort: str) -> tuple[Any, ...]:
    value = mode.row.get(sort, "")
    if sort == "Severity":
        return (-SEVERITIES.index(value) if value in SEVERITIES else 1, mode.id)
    if sort in _NUMBERS:
        return (-float(value) if value else 1.0, mode.id)
    return (value, mode.id)


routes = PageRoutes()

_MOST = 10_000
Text = Annotated[str, Query(max_length=128)]


@dataclass(frozen=True, slots=True)
class RuleFileLink:
    """A file of rules in a robot's folder."""

    name: str
    bytes: int
    href: str


@routes.get("/knowledge", "diagnoses.read", each=True)
def show_all(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show the robots whose folder is known."""
    cards = [card for card in list_cards(fleet, who, "", "", _MOST) if card.config_hash]
    return render(request, "knowledge/knowledge.html", cards=cards)


@routes.get("/knowledge/{robot}", "diagnoses.read")
async def show(
    request: Request, robot: OfRobot, fleet: Fleet, who: Who,
    q: Text = "", severity: Text = "", occurrence: Text = "",
    seen: Literal["", "yes", "no"] = "", sort: Text = "Cm",
) -> Response:  # fmt: skip
    """Show a robot's FMEA, its criticality, its coverage and its rules."""
    look = SheetQuery(q, severity, occurrence, seen, sort if sort in COLUMNS else "Cm")
    try:
        found = await read_fmea(fleet, who, robot)
    except AmberboxError as error:
        nothing: dict[str, Any] = {"robot": robot.id, "problem": error, "found": None}
        return await run_in_threadpool(render, request, "knowledge/robot.html", **nothing)
    return await run_in_threadpool(_sheet, request, fleet, who, robot, found, look)


def _sheet(
    request: Request, fleet: Services, who: Caller, robot: KnownRobot, found: Mapping[str, Any],
    look: SheetQuery,
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
    """Return the FMEA as CSV; cells that spreadsheets would read as formulas are quoted."""
    found = await read_fmea(fleet, who, robot)
    written = io.StringIO()
    rows = as_csv_rows(modes_of(found))
    csv.writer(written).writerows([_harmless(cell) for cell in row] for row in rows)
    name = f"failure-modes-{robot.id}.csv"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(written.getvalue(), media_type="text/csv; charset=utf-8", headers=headers)


def _harmless(cell: str) -> str:
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t", "\r") else cell


def _alike(found: Mapping[str, Any], modes: Sequence[SheetRow]) -> Sequence[Mapping[str, Any]]:
    """Return groups of failure modes with the same symptoms, with what distinguishes them."""
    texts = {mode.id: mode.row["Description"] or mode.id for mode in modes}
    return [{**group, "texts": [texts.get(one, one) for one in group["modes"]]}
            for group in found["coverage"]["alike"]]  # fmt: skip


def _rules(fleet: Services, robot: KnownRobot, who: Caller) -> Iterator[RuleFileLink]:
    """Yield the rule files of the present folder, for callers who may read it."""
    current = list_folders(fleet, robot).current
    if not current or not who.may("folder.read", robot):
        return
    for file in fleet.folders.files(robot.id, current) or ():
        if file.name.endswith(".pl"):
            href = f"/api/v1/robots/{robot.id}/folder/{current}/{quote(file.name)}"
            yield RuleFileLink(file.name, file.bytes, href)
