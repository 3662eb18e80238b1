"""Level icons, arrow heads, fill patterns and legends of the pages' drawings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from amberbox.core.layered_layout import Turn
from amberbox.core.svg import SMALL, SvgElement, element, group, width

Level: TypeAlias = Literal["ok", "warn", "error", "stale", "unknown"]
LEVELS: tuple[Level, ...] = ("ok", "warn", "error", "stale", "unknown")

_GROUNDS = {
    "ok": "M8 1a7 7 0 1 1 0 14a7 7 0 1 1 0-14z",
    "warn": "M8 1.3c.5 0 .9.3 1.2.7l5.9 10.6c.5.9-.1 2.1-1.2 2.1H2.1c-1.1 0-1.7-1.2-1.2-2.1"
    "L6.8 2c.3-.4.7-.7 1.2-.7z",
    "error": "M5.2 1h5.6L15 5.2v5.6L10.8 15H5.2L1 10.8V5.2z",
    "stale": "M8 1a7 7 0 1 1 0 14a7 7 0 1 1 0-14z",
    "unknown": "M3 1h10a2 2 0 0 1 2 2v10a2 2 0 0 1-2 2H3a2 2 0 0 1-2-2V3a2 2 0 0 1 2-2z",
}
_SIGNS = {
    "ok": "M4.8 8.3l2.2 2.2l4.3-4.7",
    "warn": "M8 5.6v4M8 12.1v.1",
    "error": "M5.6 5.6l4.8 4.8M10.4 5.6l-4.8 4.8",
    "stale": "M8 4.4V8l2.5 1.8",
    "unknown": "M6 6.2a2 2 0 1 1 3 1.7c-.6.4-1 .7-1 1.5M8 11.8v.1",
}


def known_level(level: str) -> Level:
    """Return the level, or ``unknown`` for any other text."""
    return next((known for known in LEVELS if known == level), "unknown")


def level_icon(level: str, place: tuple[float, float]) -> SvgElement:
    """Return the icon of a level, 16 by 16 pixels; each level has its own shape."""
    known = known_level(level)
    return group(
        element("path", class_="ground", d=_GROUNDS[known]),
        element("path", class_="sign", d=_SIGNS[known]),
        at=place,
        class_=f"icon level-{known}",
    )


def arrow_head(place: tuple[float, float], turn: Turn) -> SvgElement:
    """Return the head of an arrow with its tip at ``place``."""
    x, y = place
    paths = {0: "l-8-4v8z", 90: "l-4-8h8z", 180: "l8-4v8z", 270: "l-4 8h8z"}
    start = element("path", d=f"M{x:.6g} {y:.6g}{paths[turn]}")
    return SvgElement("path", (("class", "tip"), *start.attributes))


def hatching(id_: str, kind: str, step: float = 7) -> SvgElement:
    """Return a pattern of oblique lines, coloured by the classes of its parts."""
    return element(
        "pattern",
        element("rect", class_=f"{kind}-ground", width=step, height=step),
        element("line", class_=f"{kind}-line", x1=0, y1=0, x2=0, y2=step),
        id=id_, width=step, height=step, patternUnits="userSpaceOnUse",
        patternTransform="rotate(45)",
    )  # fmt: skip


def dots(id_: str, kind: str, step: float = 6) -> SvgElement:
    """Return a pattern of dots."""
    return element(
        "pattern",
        element("rect", class_=f"{kind}-ground", width=step, height=step),
        element("circle", class_=f"{kind}-dot", cx=step / 2, cy=step / 2, r=1.1),
        id=id_, width=step, height=step, patternUnits="userSpaceOnUse",
    )  # fmt: skip


def bars(id_: str, kind: str, step: float = 6) -> SvgElement:
    """Return a pattern of vertical lines."""
    return element(
        "pattern",
        element("rect", class_=f"{kind}-ground", width=step, height=step),
        element("line", class_=f"{kind}-line", x1=1, y1=0, x2=1, y2=step),
        id=id_, width=step, height=step, patternUnits="userSpaceOnUse",
    )  # fmt: skip


LINE = 30.0
BETWEEN = 22.0


@dataclass(frozen=True, slots=True)
class LegendSample:
    """A kind of line, by its CSS classes, and its meaning."""

    classes: str
    word: str
    arrow: bool = True


@dataclass(frozen=True, slots=True)
class LegendRow:
    """The parts of a legend and its width in pixels; its lines run along y = 0."""

    parts: tuple[SvgElement, ...]
    width: float


def legend(samples: Sequence[LegendSample]) -> LegendRow:
    """Return a legend: a short line and a word for each sample."""
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
    return LegendRow(tuple(parts), max(0.0, x - BETWEEN))


@dataclass(frozen=True, slots=True)
class DrawingTexts:
    """All fixed texts of drawings; ``{n}`` and ``{k}`` are filled with numbers."""

    ok: str
    warn: str
    error: str
    stale: str
    unknown: str
    gap: str
    cause: str
    more_fine: str
    needs: str
    part_of: str
    indirect: str
    circle: str
    may_be_broken: str
    fails: str
    seen: str
    present: str
    absent: str
    unsure: str
    unexplained: str
    more: str
    gate_and: str
    gate_or: str
    gate_vote: str
    gate_xor: str
    gate_not: str
    gate_nand: str
    gate_nor: str
    transfer: str
    below: str
    in_cut_set: str
    severity: str
    occurrence: str
    modes: str
    recorded: str
    lost: str
    deleted: str
    filtered: str
    incident: str

    def level(self, level: str) -> str:
        """Return the word of a level, or an unknown level itself."""
        known = {
            "ok": self.ok,
            "warn": self.warn,
            "error": self.error,
            "stale": self.stale,
            "unknown": self.unknown,
            "gap": self.gap,
        }
        return known.get(level, level)
