"""Criticality matrix: how many failure modes are how bad and how frequent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from amberbox.diagnosis.explanation.lettering import SIZE, SMALL, width
from amberbox.fleet.drawing.marks import box
from amberbox.fleet.drawing.svg import (
    Element,
    classes,
    element,
    group,
    lettering,
    linked,
    root,
    title,
)  # fmt: skip
from amberbox.fleet.drawing.words import Words

MARGIN = 4.0
CELL = (66.0, 42.0)
APART = 4.0
HEAD = 40.0
ZONES = 4


@dataclass(frozen=True, slots=True)
class Cell:
    """How many failure modes, and where they are listed; ``chosen`` marks the cell."""

    count: int
    href: str = ""
    chosen: bool = False


@dataclass(frozen=True, slots=True)
class Matrix:
    """Labels of rows from frequent to rare and of columns from harmless to fatal.

    ``cells`` are by row and column label; one that is not there is empty.
    """

    rows: Sequence[str]
    columns: Sequence[str]
    cells: Mapping[tuple[str, str], Cell]


def criticality_matrix(matrix: Matrix, *, label: str, words: Words) -> Element:
    """Draw the matrix; a cell is the darker the worse and the more frequent it is."""
    left = _left(matrix, words)
    wide = left + len(matrix.columns) * (CELL[0] + APART)
    high = HEAD + len(matrix.rows) * (CELL[1] + APART)
    cells = (
        _cell(matrix, row, column, left, words)
        for row in range(len(matrix.rows))
        for column in range(len(matrix.columns))
    )
    parts = group(*_headings(matrix, left, words), *cells, at=(MARGIN, MARGIN))
    return root("matrix", (wide + 2 * MARGIN, high + 2 * MARGIN), label, (parts,))


def zone(row: int, column: int, rows: int, columns: int) -> int:
    """Return how critical a place is, from 1 to 4: the sum of both ways to the worst corner."""
    share = (rows - 1 - row) / max(1, rows - 1) + column / max(1, columns - 1)
    return min(ZONES, 1 + int(share / 2 * ZONES))


def _left(matrix: Matrix, words: Words) -> float:
    """Return how much room the labels of rows take."""
    longest = max((width(row, SIZE) for row in matrix.rows), default=0.0)
    return min(190.0, max(longest, width(words.occurrence, SMALL, bold=True)) + 12)


def _headings(matrix: Matrix, left: float, words: Words) -> Iterator[Element]:
    yield element("text", words.occurrence, x=0, y=HEAD - 10, class_="heading")
    yield element("text", words.severity, x=left, y=10, class_="heading")
    for place, column in enumerate(matrix.columns):
        x = left + place * (CELL[0] + APART) + CELL[0] / 2
        yield lettering(column, (x, HEAD - 10), CELL[0], class_="middle")
    for place, row in enumerate(matrix.rows):
        y = HEAD + place * (CELL[1] + APART) + CELL[1] / 2 + 4.5
        yield lettering(row, (0, y), left - 8)


def _cell(matrix: Matrix, row: int, column: int, left: float, words: Words) -> Element:
    names = matrix.rows[row], matrix.columns[column]
    cell = matrix.cells.get(names, Cell(0))
    worth = zone(row, column, len(matrix.rows), len(matrix.columns))
    said = f"{words.modes.format(n=cell.count)}: {names[0]}, {names[1]}"
    part = group(
        title(said),
        box(0, 0, CELL, 6, class_="box"),
        element(
            "text", str(cell.count) if cell.count else "·", x=CELL[0] / 2, y=CELL[1] / 2 + 6,
            class_="count",
        ),
        at=(left + column * (CELL[0] + APART), HEAD + row * (CELL[1] + APART)),
        class_=classes(
            "cell", f"zone-{worth}", "" if cell.count else "none", "chosen" if cell.chosen else ""
        ),
    )  # fmt: skip
    return linked(cell.href if cell.count else "", part)
