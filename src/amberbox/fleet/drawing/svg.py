"""Elements of SVG: what is text stays text, numbers are short, nothing carries style or scripts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

from markupsafe import Markup

from amberbox.diagnosis.explanation.lettering import SIZE, escaped, width, wrapped

ELLIPSIS = "…"
SVG = "http://www.w3.org/2000/svg"

Value: TypeAlias = str | int | float | None
"""What an attribute may be; None leaves it out."""


@dataclass(frozen=True, slots=True)
class Element:
    """An element of SVG; children that are strings are text."""

    tag: str
    attributes: tuple[tuple[str, str], ...] = ()
    children: tuple[Element | str, ...] = ()

    def __html__(self) -> Markup:
        """Return the markup, so that a template inserts it as it is."""
        return Markup("".join(_written(self)))  # every text and value in it was escaped

    def __str__(self) -> str:
        return str(self.__html__())

    def all(self) -> Iterator[Element]:
        """Yield the element and all elements inside it, outer ones first."""
        yield self
        for child in self.children:
            if isinstance(child, Element):
                yield from child.all()

    def get(self, name: str) -> str:
        """Return the value of an attribute, empty if it has none."""
        return next((value for known, value in self.attributes if known == name), "")


Child: TypeAlias = Element | str | None


def element(tag: str, *children: Child, **attributes: Value) -> Element:
    """Return an element: ``class_`` is ``class``, ``data_from`` is ``data-from``, None is left out.

    Raises ValueError for style and event handlers, for a link that leads elsewhere than to this
    site, and for a number that is not finite.
    """
    named = ((_name(name), value) for name, value in attributes.items() if value is not None)
    checked = tuple((name, _checked(name, value)) for name, value in named)
    return Element(tag, checked, tuple(child for child in children if child is not None))


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
) -> Element:
    """Return a whole drawing with its natural size; ``label`` tells what it shows.

    It is an image to those who cannot see it. With links inside it is a group, because what is
    inside an image cannot be reached.
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


def fluid(kind: str, high: float, label: str, parts: Iterable[Child]) -> Element:
    """Return a drawing as wide as there is room; its parts stand at percentages."""
    return root(kind, (0, high), label, parts, width="100%", viewBox=None)


def group(*children: Child, at: tuple[float, float] | None = None, **attributes: Value) -> Element:
    """Return a group, moved to ``at``."""
    place = None if at is None else f"translate({number(at[0])} {number(at[1])})"
    return element("g", *children, **attributes, transform=place)


def linked(href: str, part: Element) -> Element:
    """Return the part as a link, or as it is without an address."""
    return element("a", part, href=href) if href else part


def title(text: str) -> Element:
    """Return what a pointer that rests on the parent is told."""
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
    """Return the text in at most so many lines, the last one shortened if it is more."""
    found = wrapped(text, most, SIZE, bold=bold)
    if len(found) <= lines:
        return found
    cut = fitted(f"{found[lines - 1]} {' '.join(found[lines:])}", most, SIZE, bold=bold)
    return [*found[: lines - 1], cut]


def lettering(
    text: str, place: tuple[float, float], most: float, size: float = SIZE, *, bold: bool = False,
    **attributes: Value,
) -> Element:  # fmt: skip
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


def _written(part: Element) -> Iterator[str]:
    yield f"<{part.tag}"
    for name, value in part.attributes:
        yield f' {name}="{escaped(value)}"'
    if not part.children:
        yield "/>"
        return
    yield ">"
    for child in part.children:
        if isinstance(child, Element):
            yield from _written(child)
        else:
            yield escaped(child)
    yield f"</{part.tag}>"
