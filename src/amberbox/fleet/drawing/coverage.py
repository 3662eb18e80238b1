"""What recordings cover: one bar, as wide as there is room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from amberbox.fleet.drawing.axis import Axis
from amberbox.fleet.drawing.marks import bars, dots, hatching
from amberbox.fleet.drawing.svg import Element, Value, element, fluid, group, linked, title
from amberbox.fleet.drawing.words import Words

BAR, STRIP = 14.0, 5.0
"""How high what was recorded is drawn, and the strip below it with incidents."""
LEAST = 0.002

Kind: TypeAlias = Literal["recorded", "filtered", "deleted", "lost", "incident"]
KINDS: tuple[Kind, ...] = ("recorded", "filtered", "deleted", "lost", "incident")
"""What is drawn over what."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """What is the case from ``start`` to ``to``; ``text`` says more."""

    start: int
    to: int
    kind: Kind
    text: str = ""
    href: str = ""


def coverage(
    stretches: Sequence[Stretch], axis: Axis, *, label: str, name: str = "coverage",
    words: Words,
) -> Element:  # fmt: skip
    """Draw a bar; where nothing is drawn nothing is there.

    ``name`` begins the ids in the drawing: one that no other drawing of the page has.
    """
    shown = [stretch for stretch in stretches if axis.covers(stretch.start, stretch.to)]
    shown.sort(key=lambda stretch: KINDS.index(stretch.kind))
    ground = element("rect", class_="ground", x=0, y=0.5, width="100%", height=BAR - 1, rx=3)
    parts = (_stretch(stretch, axis, name, words) for stretch in shown)
    return fluid("coverage", BAR + STRIP + 2, label, (_patterns(name), ground, *parts))


def swatch(kind: Kind, *, name: str, words: Words) -> Element:
    """Return a sample of a kind for a legend; ``name`` begins its ids."""
    bar = _bar(kind, name, x=0, width=24)
    return element(
        "svg", _patterns(name), bar, class_="drawing coverage swatch", role="img", width=24,
        height=BAR + STRIP + 2, aria_label=_word(kind, words),
    )  # fmt: skip


def _patterns(name: str) -> Element:
    return element(
        "defs",
        hatching(f"{name}-lost", "lost", 6),
        dots(f"{name}-filtered", "filtered", 5),
        bars(f"{name}-deleted", "deleted", 5),
    )


def _stretch(stretch: Stretch, axis: Axis, name: str, words: Words) -> Element:
    said = _word(stretch.kind, words)
    place = axis.place(stretch.start)
    wide = axis.length(stretch.start, stretch.to, LEAST)
    part = group(
        title(f"{said}: {stretch.text}" if stretch.text else said),
        _bar(stretch.kind, name, x=place, width=wide),
        class_="stretch",
        data_from=stretch.start,
        data_to=stretch.to,
    )
    return linked(stretch.href, part)


def _bar(kind: Kind, name: str, **place: Value) -> Element:
    incident = kind == "incident"
    fill = f"url(#{name}-{kind})" if kind in ("lost", "filtered", "deleted") else None
    return element(
        "rect", class_=f"bar cover-{kind}", y=BAR + 2 if incident else 0.0,
        height=STRIP if incident else BAR, rx=2, fill=fill, **place,
    )  # fmt: skip


def _word(kind: Kind, words: Words) -> str:
    known: dict[Kind, str] = {
        "recorded": words.recorded,
        "filtered": words.filtered,
        "deleted": words.deleted,
        "lost": words.lost,
        "incident": words.incident,
    }
    return known[kind]
