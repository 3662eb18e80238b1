"""Small signs: levels, arrow heads, hatching. None has an id of its own but for patterns."""

from __future__ import annotations

from typing import Literal, TypeAlias

from amberbox.fleet.drawing.svg import Element, Value, element, group

Level: TypeAlias = Literal["ok", "warn", "error", "stale", "unknown"]
LEVELS: tuple[Level, ...] = ("ok", "warn", "error", "stale", "unknown")

Turn: TypeAlias = Literal[0, 90, 180, 270]
"""Where an arrow points: right, down, left, up."""

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
    """Return the level; what is none counts as unknown."""
    return next((known for known in LEVELS if known == level), "unknown")


def level_icon(level: str, place: tuple[float, float]) -> Element:
    """Return the sign of a level, 16 by 16 pixels: each has a shape of its own."""
    known = known_level(level)
    return group(
        element("path", class_="ground", d=_GROUNDS[known]),
        element("path", class_="sign", d=_SIGNS[known]),
        at=place,
        class_=f"icon level-{known}",
    )


def arrow_head(place: tuple[float, float], turn: Turn, class_: str = "tip") -> Element:
    """Return the head of an arrow whose point is at ``place``."""
    x, y = place
    paths = {0: "l-8-4v8z", 90: "l-4-8h8z", 180: "l8-4v8z", 270: "l-4 8h8z"}
    start = element("path", d=f"M{x:.6g} {y:.6g}{paths[turn]}")
    return Element("path", (("class", class_), *start.attributes))


def hatching(id_: str, kind: str, step: float = 7) -> Element:
    """Return a pattern of oblique lines; the classes of its parts give it its colours."""
    return element(
        "pattern",
        element("rect", class_=f"{kind}-ground", width=step, height=step),
        element("line", class_=f"{kind}-line", x1=0, y1=0, x2=0, y2=step),
        id=id_, width=step, height=step, patternUnits="userSpaceOnUse",
        patternTransform="rotate(45)",
    )  # fmt: skip


def dots(id_: str, kind: str, step: float = 6) -> Element:
    """Return a pattern of dots."""
    return element(
        "pattern",
        element("rect", class_=f"{kind}-ground", width=step, height=step),
        element("circle", class_=f"{kind}-dot", cx=step / 2, cy=step / 2, r=1.1),
        id=id_, width=step, height=step, patternUnits="userSpaceOnUse",
    )  # fmt: skip


def bars(id_: str, kind: str, step: float = 6) -> Element:
    """Return a pattern of upright lines."""
    return element(
        "pattern",
        element("rect", class_=f"{kind}-ground", width=step, height=step),
        element("line", class_=f"{kind}-line", x1=1, y1=0, x2=1, y2=step),
        id=id_, width=step, height=step, patternUnits="userSpaceOnUse",
    )  # fmt: skip


def box(
    x: float, y: float, size: tuple[float, float], radius: float = 8, **attributes: Value
) -> Element:
    """Return a rectangle with round corners."""
    return element(
        "rect", x=x, y=y, width=size[0], height=size[1], rx=radius, **attributes
    )  # fmt: skip
