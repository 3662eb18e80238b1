"""What lines of a drawing mean, in one row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from amberbox.diagnosis.explanation.lettering import SMALL, width
from amberbox.fleet.drawing.marks import arrow_head
from amberbox.fleet.drawing.svg import Element, element, group

LINE = 30.0
BETWEEN = 22.0


@dataclass(frozen=True, slots=True)
class Sample:
    """A kind of line, by its classes, and what it means."""

    classes: str
    word: str
    arrow: bool = True


@dataclass(frozen=True, slots=True)
class Legend:
    """The row's parts and how wide it is; its lines run along y = 0."""

    parts: tuple[Element, ...]
    width: float


def legend(samples: Sequence[Sample]) -> Legend:
    """Return a row with a short line and a word for each sample."""
    parts = []
    x = 0.0
    for sample in samples:
        parts.append(
            group(
                element("path", class_="line", d=f"M0 0H{LINE}"),
                arrow_head((LINE, 0), 0) if sample.arrow else None,
                element("text", sample.word, x=LINE + 7, y=4, class_="small"),
                at=(x, 0),
                class_=f"key {sample.classes}",
            )
        )
        x += LINE + 7 + width(sample.word, SMALL) + BETWEEN
    return Legend(tuple(parts), max(0.0, x - BETWEEN))
