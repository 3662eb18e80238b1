"""Parsed drawings: their elements and positions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree

from amberbox.core.svg import SVG, SvgElement
from amberbox.server.web.text import drawing_words

WORDS = drawing_words()
"""Texts of drawings in tests: those of pages."""

HOSTILE = (
    "<img src=x onerror=alert(1)>",
    '"><script>alert(1)</script>',
    "{{7*7}}",
    "';--",
    "\u202eright to left\u200f",
    "a & b ]]> \x00\x1b",
)


def parsed(drawing: SvgElement) -> ElementTree.Element:
    """Return the drawing as an XML parser sees it."""
    return ElementTree.fromstring(str(drawing))


def of_class(tree: ElementTree.Element, name: str) -> list[ElementTree.Element]:
    """Return all elements that have a class."""
    return [part for part in tree.iter() if name in part.get("class", "").split()]


def texts(tree: ElementTree.Element) -> list[str]:
    """Return the lines of text that are drawn."""
    return ["".join(part.itertext()) for part in tree.iter(f"{{{SVG}}}text")]


def shown(tree: ElementTree.Element) -> str:
    """Return all text in a drawing, including titles."""
    return " ".join(tree.itertext())


def titles(tree: ElementTree.Element) -> list[str]:
    """Return the tooltips."""
    return [part.text or "" for part in tree.iter(f"{{{SVG}}}title")]


@dataclass(frozen=True)
class Frame:
    """A box on the drawing."""

    x: float
    y: float
    width: float
    height: float

    def overlaps(self, other: Frame) -> bool:
        """Return whether two boxes share some room."""
        beside = self.x + self.width <= other.x + 0.1 or other.x + other.width <= self.x + 0.1
        above = self.y + self.height <= other.y + 0.1 or other.y + other.height <= self.y + 0.1
        return not (beside or above)

    def holds(self, x: float, y: float) -> bool:
        """Return whether a point is inside, and not on the edge."""
        return (
            self.x + 0.2 < x < self.x + self.width - 0.2
            and self.y + 0.2 < y < self.y + self.height - 0.2
        )


def along(path: str) -> Iterator[tuple[float, float]]:
    """Yield points of a path of M, L and C with absolute places."""
    here = (0.0, 0.0)
    for letter, numbers in re.findall(r"([MLC])([^MLC]*)", path):
        values = [float(number) for number in numbers.split()]
        places = list(zip(values[::2], values[1::2], strict=True))
        bends = [here, *places] if letter == "C" else [here, here, places[0], places[0]]
        if letter != "M":
            yield from (_bezier(bends, step / 12) for step in range(13))
        here = places[-1]


def _bezier(bends: list[tuple[float, float]], t: float) -> tuple[float, float]:
    weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
    x = sum(weight * bend[0] for weight, bend in zip(weights, bends, strict=True))
    y = sum(weight * bend[1] for weight, bend in zip(weights, bends, strict=True))
    return x, y


def overlapping(frames: list[Frame]) -> list[tuple[Frame, Frame]]:
    """Return the pairs of boxes that lie on each other."""
    return [
        (one, other)
        for place, one in enumerate(frames)
        for other in frames[place + 1 :]
        if one.overlaps(other)
    ]


def frames(tree: ElementTree.Element, kind: str, box: str = "box") -> list[Frame]:
    """Return the boxes of all parts of a class, as their transformation puts them."""
    found = []
    for part in of_class(tree, kind):
        moved = re.match(r"translate\((\S+) (\S+)\)", part.get("transform", ""))
        x, y = (float(moved[1]), float(moved[2])) if moved else (0.0, 0.0)
        for rect in (child for child in part if child.get("class") == box):
            left, top, wide, high = (float(rect.get(n, "")) for n in ("x", "y", "width", "height"))
            found.append(Frame(x + left, y + top, wide, high))
    return found
