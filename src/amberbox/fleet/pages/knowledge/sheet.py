"""The failure modes of a robot as its sheet lists them: which are looked for, in which order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from amberbox.fleet.drawing.matrix import Cell, Matrix
from amberbox.monitoring.engine.outputs import SEVERITIES

OCCURRENCES = ("A frequent", "B probable", "C occasional", "D remote", "E extremely unlikely")
COLUMNS = ("Item", "Failure mode", "Severity", "S", "O", "D", "RPN", "Rate (1/h)", "Cm")
"""Columns by which one may sort; numbers go from the greatest."""
_NUMBERS = ("S", "O", "D", "RPN", "Rate (1/h)", "Cm", "Probability")


@dataclass(frozen=True, slots=True)
class Look:
    """What somebody looks for in the sheet; it stands in the address."""

    q: str = ""
    severity: str = ""
    occurrence: str = ""
    seen: str = ""
    sort: str = "Cm"

    def address(self, **changes: str) -> str:
        """Return the address of this look with some of it changed."""
        known = {name: getattr(self, name) for name in self.__slots__} | changes
        return "?" + urlencode({name: value for name, value in known.items() if value})


@dataclass(frozen=True, slots=True)
class Mode:
    """A row of the sheet: ``id`` as diagnoses name it, ``cell`` its place in the matrix."""

    id: str
    row: Mapping[str, str]
    cell: tuple[str, str]
    unseen: str
    weak: float

    @property
    def checks(self) -> Sequence[str]:
        """Return what sees it: monitors' checks, and tests that people do."""
        return [check for check in self.row["Detection"].split("; ") if check]

    @property
    def is_seen(self) -> bool:
        """Tell whether any monitor or test can see it."""
        return not self.unseen


def modes_of(found: Mapping[str, Any]) -> Sequence[Mode]:
    """Return the rows of a sheet, as the API gives it."""
    coverage = found["coverage"]
    cells = {mode: (cell["occurrence"], cell["severity"])
             for cell in found["criticality"]["matrix"] for mode in cell["modes"]}  # fmt: skip
    return [
        Mode(name, row, cells.get(name, ("", row["Severity"])), coverage["unseen"].get(name, ""),
             float(coverage["weak"].get(name, 0.0)))
        for row in found["table"]
        for name in (f"{row['Item']}#{row['Failure mode']}",)
    ]  # fmt: skip


def chosen(modes: Sequence[Mode], look: Look) -> Sequence[Mode]:
    """Return the rows that somebody looks for, in their order."""
    return sorted((mode for mode in modes if _fits(mode, look)), key=lambda m: _key(m, look.sort))


def matrix_of(modes: Sequence[Mode], look: Look) -> Matrix:
    """Return how many failure modes are how bad and how frequent; each cell leads to them."""
    counts: dict[tuple[str, str], int] = {}
    for mode in modes:
        counts[mode.cell] = counts.get(mode.cell, 0) + 1
    rows = [row for row in OCCURRENCES if any(cell[0] == row for cell in counts)]
    mine = (look.occurrence, look.severity)
    return Matrix(rows, SEVERITIES, {
        cell: Cell(count, _leads(look, cell, is_mine=cell == mine), cell == mine)
        for cell, count in counts.items()
    })  # fmt: skip


def as_csv_rows(modes: Sequence[Mode]) -> Iterator[Sequence[str]]:
    """Yield the sheet as rows of text, its head first."""
    if modes:
        yield list(modes[0].row)
    yield from (list(mode.row.values()) for mode in modes)


def _leads(look: Look, cell: tuple[str, str], *, is_mine: bool) -> str:
    occurrence, severity = ("", "") if is_mine else cell
    return look.address(occurrence=occurrence, severity=severity) + "#modes"


def _fits(mode: Mode, look: Look) -> bool:
    words = " ".join(mode.row.values()).casefold()
    return (
        all(word in words for word in look.q.casefold().split())
        and look.severity in ("", mode.row["Severity"])
        and look.occurrence in ("", mode.cell[0])
        and look.seen in ("", "yes" if mode.is_seen else "no")
    )


def _key(mode: Mode, sort: str) -> tuple[Any, ...]:
    value = mode.row.get(sort, "")
    if sort == "Severity":
        return (-SEVERITIES.index(value) if value in SEVERITIES else 1, mode.id)
    if sort in _NUMBERS:
        return (-float(value) if value else 1.0, mode.id)
    return (value, mode.id)
