"""Which component needs which, how each is, and where it comes from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from amberbox.diagnosis.explanation.lettering import SIZE, SMALL, width
from amberbox.fleet.drawing.collapse import bridges, kept
from amberbox.fleet.drawing.layers import Box, Gaps, Layout, Route, layered
from amberbox.fleet.drawing.legend import Sample, legend
from amberbox.fleet.drawing.marks import arrow_head, box, known_level, level_icon
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

MARGIN = 14.0
HIGH = 46.0
LEFT = 36.0
"""Where the text of a box begins: right of its sign."""
NARROW, WIDE = 112.0, 224.0
GAPS = Gaps(ranks=60, boxes=14)
MORE = "\x00more"
"""The id of the box that counts what is not drawn; no component can have it."""

Kind: TypeAlias = Literal["needs", "part of"]
_Kind: TypeAlias = Literal["needs", "part-of", "indirect"]


@dataclass(frozen=True, slots=True)
class Component:
    """A box: ``note`` is why it is so (as its title), ``root`` marks where others suffer from.

    ``state`` stands behind the word of the level.
    """

    id: str
    name: str
    level: str
    state: str = ""
    note: str = ""
    href: str = ""
    root: bool = False


@dataclass(frozen=True, slots=True)
class Edge:
    """``start`` needs ``end``, or is part of it."""

    start: str
    end: str
    kind: Kind = "needs"


def dependency_graph(
    components: Sequence[Component], edges: Sequence[Edge], *, label: str, most: int = 60,
    more_href: str = "", down: bool = False, words: Words,
) -> Element:  # fmt: skip
    """Draw components and what they need, left to right or top down.

    Of more than ``most`` components those that are fine are counted in one box, which leads to
    ``more_href``; what is not fine is always drawn. A component that only edges name is drawn as
    unknown.
    """
    everything = _with_unnamed(components, edges)
    shown, lines, hidden = _shown(everything, edges, most)
    if hidden:
        more = words.more_fine.format(n=hidden)
        shown = [*shown, Component(MORE, more, "ok", href=more_href)]
    wide = _width(shown, words)
    boxes = [Box(component.id, wide, HIGH) for component in shown]
    layout = layered(boxes, [_ahead(line) for line in lines], down=down, gaps=GAPS)
    return _drawn(shown, lines, layout, wide, label, words)


_Line: TypeAlias = tuple[tuple[str, str], _Kind, int]
"""Start and end, what it means, and how many boxes it passes that are not drawn."""


def _ahead(line: _Line) -> tuple[str, str]:
    """Return how a line runs: from what needs to what is needed, from the whole to its part."""
    (start, end), kind, _ = line
    return (end, start) if kind == "part-of" else (start, end)


def _with_unnamed(components: Sequence[Component], edges: Sequence[Edge]) -> list[Component]:
    known = {component.id: component for component in components}
    named = dict.fromkeys(name for edge in edges for name in (edge.start, edge.end))
    unnamed = (Component(name, name, "unknown") for name in named if name not in known)
    return [*known.values(), *unnamed]


def _shown(
    components: Sequence[Component], edges: Sequence[Edge], most: int
) -> tuple[list[Component], list[_Line], int]:
    """Return the boxes and lines to draw, and how many boxes are not."""
    wrong = {c.id for c in components if c.level != "ok" or c.root}
    pairs = [(edge.start, edge.end) for edge in edges]
    names = kept([component.id for component in components], wrong, pairs, most)
    shown = [component for component in components if component.id in names]
    drawn = dict.fromkeys(edges)
    lines: list[_Line] = [
        ((edge.start, edge.end), "needs" if edge.kind == "needs" else "part-of", 0)
        for edge in drawn
        if edge.start in names and edge.end in names
    ]
    needs = [(edge.start, edge.end) for edge in edges if edge.kind == "needs"]
    lines += [(pair, "indirect", over) for pair, over in bridges(needs, names).items()]
    return shown, lines, len(components) - len(shown)


def _width(components: Sequence[Component], words: Words) -> float:
    """Return one width for all boxes, so that ranks stand in line."""
    names = (width(component.name, SIZE, bold=True) for component in components)
    below = (width(_below(component, words), SMALL) for component in components)
    longest = max((*names, *below), default=0.0)
    return min(WIDE, max(NARROW, longest + LEFT + 12))


def _below(component: Component, words: Words) -> str:
    parts = (words.level(known_level(component.level)), component.state)
    return ", ".join(part for part in parts if part)


def _drawn(
    shown: Sequence[Component], lines: Sequence[_Line], layout: Layout, wide: float, label: str,
    words: Words,
) -> Element:  # fmt: skip
    by_id = {component.id: component for component in shown}
    edges = [
        _edge(line, route, by_id, words) for line, route in zip(lines, layout.routes, strict=True)
    ]
    edges.sort(key=lambda edge: "bad" in edge.get("class").split())
    nodes = [_node(c, layout.corners[c.id], wide, words) for c in shown]
    key = legend(list(_samples(lines, layout, words)))
    bottom = layout.height + (26 if key.parts else 0)
    size = (max(layout.width, key.width) + 2 * MARGIN, bottom + 2 * MARGIN)
    parts = (
        group(*edges, *nodes, at=(MARGIN, MARGIN)),
        group(*key.parts, at=(MARGIN, layout.height + MARGIN + 22)) if key.parts else None,
    )
    return root("graph", size, label, parts)


def _edge(line: _Line, route: Route, components: Mapping[str, Component], words: Words) -> Element:
    (start, end), kind, over = line
    bad = all(components[name].level in ("error", "stale") for name in (start, end))
    said = words.needs if kind != "part-of" else words.part_of
    about = f"{components[start].name} {said} {components[end].name}"
    about += f" ({words.more_fine.format(n=over)})" if over else ""
    about += f" ({words.circle})" if route.broken else ""
    return group(
        title(about),
        element("path", class_="line", d=route.path),
        None if kind == "part-of" else arrow_head(route.tip, route.turn),
        class_=classes("edge", kind, "bad" if bad else "", "broken" if route.broken else ""),
        data_start=start,
        data_end=end,
    )


def _node(component: Component, corner: tuple[float, float], wide: float, words: Words) -> Element:
    level = known_level(component.level)
    if component.id == MORE:
        return linked(component.href, _more(component, corner, wide))
    below = _below(component, words)
    about = f"{component.name}: {below}"
    about += f". {component.note}" if component.note else ""
    about += f" ({words.cause})" if component.root else ""
    card = group(
        title(about),
        box(0, 0, (wide, HIGH), class_="box"),
        level_icon(level, (11, (HIGH - 16) / 2)),
        lettering(component.name, (LEFT, 20), wide - LEFT - 8, bold=True, class_="name"),
        lettering(below, (LEFT, 36), wide - LEFT - 8, SMALL, class_="small"),
        _root_tag(wide, words) if component.root else None,
        at=corner,
        class_=classes("node", f"level-{level}", "root" if component.root else ""),
        data_id=component.id,
    )
    return linked(component.href, card)


def _root_tag(wide: float, words: Words) -> Element:
    """Return the word on the edge of a root cause."""
    long = width(words.cause, SMALL, bold=True) + 14
    return group(
        box(0, 0, (long, 17), 8.5, class_="tag"),
        element("text", words.cause, x=long / 2, y=12.2, class_="tag-word"),
        at=(wide - long - 10, -9),
    )


def _more(component: Component, corner: tuple[float, float], wide: float) -> Element:
    shown = replace(component, level="ok")
    return group(
        box(0, 0, (wide, HIGH), class_="box"),
        level_icon(shown.level, (11, (HIGH - 16) / 2)),
        lettering(shown.name, (LEFT, 28), wide - LEFT - 8, bold=True, class_="name"),
        at=corner,
        class_="node more level-ok",
    )


def _samples(lines: Sequence[_Line], layout: Layout, words: Words) -> Iterator[Sample]:
    """Yield what the legend explains: only what is drawn."""
    kinds = {kind for _, kind, _ in lines}
    said = {"needs": words.needs, "part-of": words.part_of, "indirect": words.indirect}
    for kind, word in said.items():
        if kind in kinds:
            yield Sample(kind, word, arrow=kind != "part-of")
    if any(route.broken for route in layout.routes):
        yield Sample("broken", words.circle)
