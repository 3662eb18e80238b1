"""SVG elements, and the width and line breaks of text in any sans-serif font."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from html import escape
from typing import TypeAlias

from amberbox.core.safe_text import escape_hidden

SIZE = 13
SMALL = 11

BOLDER = 1.13  # how much wider bold text is

# Widths of characters in the widest of the common fonts, in parts of the font's size
SHARES: tuple[tuple[str, float], ...] = (
    ("iIjl.,:;'|!", 0.41),
    ('frt()[]-/\\" ', 0.47),
    ("+<=>^~", 0.84),
    ("mwMW%@&#", 1.0),
)

OF_CHARACTER = {character: share for characters, share in SHARES for character in characters}

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_BREAKS = re.compile(r"(?<=[/_#.+\-])")


def escape_text(text: str) -> str:
    """Return text escaped for XML; characters that XML forbids become a question mark.

    Invisible characters are written as escapes.
    """
    return escape(escape_hidden(_FORBIDDEN.sub("\ufffd", text)))


def width(text: str, size: float = SIZE, *, bold: bool = False) -> float:
    """Return an upper estimate of the width of a line, in pixels."""
    return size * sum(map(_share, text)) * (BOLDER if bold else 1.0)


def _share(character: str) -> float:
    known = OF_CHARACTER.get(character)
    if known is not None:
        return known
    if unicodedata.combining(character):
        return 0.0
    if ord(character) > 0x2FF:
        return 1.15
    return 0.8 if character.isupper() else 0.66


def wrap_text(text: str, most: float, size: float = SIZE, *, bold: bool = False) -> list[str]:
    """Break text into lines no wider than ``most`` pixels, within a word if it must be."""
    most = most / BOLDER if bold else most
    lines = [""]
    for piece in _pieces(text, most, size):
        together = f"{lines[-1]}{piece}"
        if width(together.rstrip(), size) <= most:
            lines[-1] = together
        else:
            lines.append(piece.lstrip())
    return [line.rstrip() for line in lines if line.strip()] or [""]


def _pieces(text: str, most: float, size: float) -> Iterator[str]:
    """Yield words with the blank before them; words too wide for a line in parts."""
    plain = re.sub(r"(?<=\d) %", "\u00a0%", " ".join(text.split()))
    for word in re.findall(" *[^ ]+", plain):
        if width(word.strip(), size) <= most:
            yield word
            continue
        for part in _BREAKS.split(word):
            start = 0
            for end in range(1, len(part) + 1):
                if width(part[start : end + 1], size) > most or end == len(part):
                    yield part[start:end]
                    start = end


ELLIPSIS = "…"
SVG = "http://www.w3.org/2000/svg"

Value: TypeAlias = str | int | float | None  # what an attribute may be; None leaves it out


@dataclass(frozen=True, slots=True)
class SvgElement:
    """An element of SVG; children that are strings are text."""

    tag: str
    attributes: tuple[tuple[str, str], ...] = ()
    children: tuple[SvgElement | str, ...] = ()

    def __html__(self) -> str:
        """Return the markup, so that a template inserts it without escaping."""
        return str(self)

    def __str__(self) -> str:
        return "".join(_written(self))  # every text and value in it was escaped

    def all(self) -> Iterator[SvgElement]:
        """Yield the element and all elements inside it, outer ones first."""
        yield self
        for child in self.children:
            if isinstance(child, SvgElement):
                yield from child.all()

    def get(self, name: str) -> str:
        """Return the value of an attribute, empty if it has none."""
        return next((value for known, value in self.attributes if known == name), "")


Child: TypeAlias = SvgElement | str | None


def element(tag: str, *children: Child, **attributes: Value) -> SvgElement:
    """Return an element: ``class_`` is ``class``, ``data_from`` is ``data-from``, None is left out.

    Raises ValueError for style and event handlers, for a link that leads elsewhere than to this
    site, and for a number that is not finite.
    """
    named = ((_name(name), value) for name, value in attributes.items() if value is not None)
    checked = tuple((name, _checked(name, value)) for name, value in named)
    return SvgElement(tag, checked, tuple(child for child in children if child is not None))


def number(value: float) -> str:
    """Return a number with at most two decimals."""
    if not math.isfinite(value):
        raise ValueError(f"{value} has no place in a drawing")
    shown = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if shown == "-0" else shown


def classes(*names: str) -> str:
    """Return the names that are not empty as the value of ``class_``."""
    return " ".join(name for name in names if name)


def root(
    kind: str, size: tuple[float, float], label: str, parts: Iterable[Child], **more: Value
) -> SvgElement:
    """Return a whole drawing with its natural size; ``label`` describes it.

    To screen readers it is an image; with links inside a group, because links inside an image
    cannot be reached.
    """
    children = tuple(parts)
    wide, high = math.ceil(size[0]), math.ceil(size[1])
    whole = element("g", *children)
    role = "group" if any(part.tag == "a" for part in whole.all()) else "img"
    about: dict[str, Value] = {
        "xmlns": SVG,
        "class_": classes("drawing", kind),
        "role": role,
        "aria_label": label,
        "width": wide,
        "height": high,
        "viewBox": f"0 0 {wide} {high}",
    }
    return element("svg", *children, **(about | more))


def fluid(kind: str, high: float, label: str, parts: Iterable[Child]) -> SvgElement:
    """Return a drawing as wide as the available space; positions of its parts are percentages."""
    return root(kind, (0, high), label, parts, width="100%", viewBox=None)


def group(
    *children: Child, at: tuple[float, float] | None = None, **attributes: Value
) -> SvgElement:
    """Return a group, moved to ``at``."""
    place = None if at is None else f"translate({number(at[0])} {number(at[1])})"
    return element("g", *children, **attributes, transform=place)


def linked(href: str, part: SvgElement) -> SvgElement:
    """Return the part as a link; unchanged without an address."""
    return element("a", part, href=href) if href else part


def title(text: str) -> SvgElement:
    """Return the tooltip of the parent."""
    return element("title", text)


def fitted(text: str, most: float, size: float = SIZE, *, bold: bool = False) -> str:
    """Return the text, shortened with an ellipsis to at most ``most`` pixels."""
    plain = " ".join(text.split())
    if width(plain, size, bold=bold) <= most:
        return plain
    kept = plain
    while kept and width(f"{kept}{ELLIPSIS}", size, bold=bold) > most:
        kept = kept[:-1]
    return f"{kept.rstrip()}{ELLIPSIS}"


def broken(text: str, most: float, lines: int, *, bold: bool = False) -> list[str]:
    """Return the text in at most ``lines`` lines, the last one shortened if necessary."""
    found = wrap_text(text, most, SIZE, bold=bold)
    if len(found) <= lines:
        return found
    cut = fitted(f"{found[lines - 1]} {' '.join(found[lines:])}", most, SIZE, bold=bold)
    return [*found[: lines - 1], cut]


def lettering(
    text: str, place: tuple[float, float], most: float, size: float = SIZE, *, bold: bool = False,
    **attributes: Value,
) -> SvgElement:  # fmt: skip
    """Return a line of text that fits; one that was shortened has the whole as its title."""
    shown = fitted(text, most, size, bold=bold)
    whole = title(text) if shown.endswith(ELLIPSIS) else None
    x, y = place
    return element("text", whole, shown, x=x, y=y, **attributes)


def _name(name: str) -> str:
    plain = name.rstrip("_").replace("_", "-")
    if plain == "style" or plain.startswith("on"):
        raise ValueError(f"a drawing has no attribute '{plain}'")
    return plain


def _checked(name: str, value: str | int | float) -> str:
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return number(value)
    if name == "href" and (value[:1] not in "/?#" or value.startswith("//")):
        raise ValueError(f"a drawing does not link to '{value}'")
    return value


def _written(part: SvgElement) -> Iterator[str]:
    yield f"<{part.tag}"
    for name, value in part.attributes:
        yield f' {name}="{escape_text(value)}"'
    if not part.children:
        yield "/>"
        return
    yield ">"
    for child in part.children:
        if isinstance(child, SvgElement):
            yield from _written(child)
        else:
            yield escape_text(child)
    yield f"</{part.tag}>"


def box(
    x: float, y: float, size: tuple[float, float], radius: float = 8, **attributes: Value
) -> SvgElement:
    """Return a rectangle with round corners."""
    return element(
        "rect", x=x, y=y, width=size[0], height=size[1], rx=radius, **attributes
    )  # fmt: skip
