"""The dependency graph of a robot's components with their levels; large ones are collapsed."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from amberbox.core.layered_layout import GraphLayout, LayoutBox, LayoutGaps, LinkRoute, layered
from amberbox.core.svg import (
    SIZE,
    SMALL,
    SvgElement,
    box,
    classes,
    element,
    group,
    lettering,
    linked,
    root,
    title,
    width,
)
from amberbox.server.drawing.symbols import (
    DrawingTexts,
    LegendSample,
    arrow_head,
    known_level,
    legend,
    level_icon,
)

Pair = tuple[str, str]


def select_components(
    names: Sequence[str], wrong: Collection[str], pairs: Sequence[Pair], most: int
) -> set[str]:
    """Return the names to draw: all in ``wrong``, then the nearest others.

    At most ``most``, but never without those in ``wrong``.
    """
    if len(names) <= most:
        return set(names)
    near: dict[str, list[str]] = {name: [] for name in names}
    for start, end in pairs:
        near[start].append(end)
        near[end].append(start)
    found = dict.fromkeys(name for name in names if name in wrong)
    order = list(found)
    for name in order:
        for other in near[name]:
            if other not in found and len(found) < most:
                found[other] = None
                order.append(other)
    return set(found) if found else set(names[:most])


def indirect_links(pairs: Sequence[Pair], shown: Collection[str]) -> dict[Pair, int]:
    """Return links between shown components over hidden ones, with the number of hidden ones.

    Links that also exist directly are left out.
    """
    outgoing: dict[str, list[str]] = {}
    for start, end in pairs:
        outgoing.setdefault(start, []).append(end)
    direct = set(pairs)
    found: dict[Pair, int] = {}
    for name in dict.fromkeys(start for start, _ in pairs if start in shown):
        for end, over in _beyond(name, outgoing, shown).items():
            if end != name and (name, end) not in direct:
                found[name, end] = over
    return found


def _beyond(
    name: str, outgoing: Mapping[str, Sequence[str]], shown: Collection[str]
) -> dict[str, int]:
    """Return the names reached over hidden names only, with their number on the shortest path."""
    distance = {other: 1 for other in outgoing[name] if other not in shown}
    reached: dict[str, int] = {}
    order = list(distance)
    for hidden in order:
        for other in outgoing.get(hidden, ()):
            if other in shown:
                reached.setdefault(other, distance[hidden])
            elif other not in distance:
                distance[other] = distance[hidden] + 1
                order.append(other)
    return reached


MARGIN = 14.0
HIGH = 46.0
LEFT = 36.0  # x of the text in a box, right of its icon
NARROW, WIDE = 112.0, 224.0
GAPS = LayoutGaps(ranks=60, boxes=14)
MORE = "\x00more"  # id of the box that counts hidden components; no component has it

Kind: TypeAlias = Literal["needs", "part of"]
_Kind: TypeAlias = Literal["needs", "part-of", "indirect"]


@dataclass(frozen=True, slots=True)
class ComponentBox:
    """A box: ``note`` is the reason of its level (as its title), ``root`` marks a root cause.

    ``state`` follows the word of the level.
    """

    id: str
    name: str
    level: str
    state: str = ""
    note: str = ""
    href: str = ""
    root: bool = False


@dataclass(frozen=True, slots=True)
class DependencyEdge:
    """``start`` needs ``end``, or is part of it."""

    start: str
    end: str
    kind: Kind = "needs"


def dependency_graph(
    components: Sequence[ComponentBox],
    edges: Sequence[DependencyEdge],
    *,
    label: str,
    most: int = 60,
    more_href: str = "",
    down: bool = False,
    words: DrawingTexts,
) -> SvgElement:
    """Draw components and their dependencies, left to right or top down.

    With more than ``most`` components, some that are ok are only counted in one box, which links to
    ``more_href``; all others are drawn. A component that only occurs in edges is drawn as unknown.
    """
    known = {component.id: component for component in components}
    named = dict.fromkeys(name for edge in edges for name in (edge.start, edge.end))
    unnamed = (ComponentBox(name, name, "unknown") for name in named if name not in known)
    everything = [*known.values(), *unnamed]
    shown, lines, hidden = _shown(everything, edges, most)
    if hidden:
        more = words.more_fine.format(n=hidden)
        shown = [*shown, ComponentBox(MORE, more, "ok", href=more_href)]
    wide = _width(shown, words)
    boxes = [LayoutBox(component.id, wide, HIGH) for component in shown]
    layout = layered(boxes, [_ahead(line) for line in lines], down=down, gaps=GAPS)
    return _drawn(shown, lines, layout, wide, label, words)


# Start and end, kind, and the number of hidden boxes on it
_Line: TypeAlias = tuple[tuple[str, str], _Kind, int]


def _ahead(line: _Line) -> tuple[str, str]:
    """Return the direction of a line: from a component to its dependency, from whole to part."""
    (start, end), kind, _ = line
    return (end, start) if kind == "part-of" else (start, end)


def _shown(
    components: Sequence[ComponentBox], edges: Sequence[DependencyEdge], most: int
) -> tuple[list[ComponentBox], list[_Line], int]:
    """Return the boxes and lines to draw, and the number of hidden boxes."""
    wrong = {c.id for c in components if c.level != "ok" or c.root}
    pairs = [(edge.start, edge.end) for edge in edges]
    names = select_components([component.id for component in components], wrong, pairs, most)
    shown = [component for component in components if component.id in names]
    drawn = dict.fromkeys(edges)
    lines: list[_Line] = [
        ((edge.start, edge.end), "needs" if edge.kind == "needs" else "part-of", 0)
        for edge in drawn
        if edge.start in names and edge.end in names
    ]
    needs = [(edge.start, edge.end) for edge in edges if edge.kind == "needs"]
    lines += [(pair, "indirect", over) for pair, over in indirect_links(needs, names).items()]
    return shown, lines, len(components) - len(shown)


def _width(components: Sequence[ComponentBox], words: DrawingTexts) -> float:
    """Return the common width of all boxes, in pixels."""
    names = (width(component.name, SIZE, bold=True) for component in components)
    below = (width(_below(component, words), SMALL) for component in components)
    longest = max((*names, *below), default=0.0)
    return min(WIDE, max(NARROW, longest + LEFT + 12))


def _below(component: ComponentBox, words: DrawingTexts) -> str:
    parts = (words.level(known_level(component.level)), component.state)
    return ", ".join(part for part in parts if part)


def _drawn(
    shown: Sequence[ComponentBox],
    lines: Sequence[_Line],
    layout: GraphLayout,
    wide: float,
    label: str,
    words: DrawingTexts,
) -> SvgElement:
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


def _edge(
    line: _Line, route: LinkRoute, components: Mapping[str, ComponentBox], words: DrawingTexts
) -> SvgElement:
    (start, end), kind, over = line
    bad = all(components[name].level in ("error", "stale") for name in (start, end))
    relation = words.needs if kind != "part-of" else words.part_of
    about = f"{components[start].name} {relation} {components[end].name}"
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


def _node(
    component: ComponentBox, corner: tuple[float, float], wide: float, words: DrawingTexts
) -> SvgElement:
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


def _root_tag(wide: float, words: DrawingTexts) -> SvgElement:
    """Return the tag on the edge of the box of a root cause."""
    long = width(words.cause, SMALL, bold=True) + 14
    return group(
        box(0, 0, (long, 17), 8.5, class_="tag"),
        element("text", words.cause, x=long / 2, y=12.2, class_="tag-word"),
        at=(wide - long - 10, -9),
    )


def _more(component: ComponentBox, corner: tuple[float, float], wide: float) -> SvgElement:
    shown = replace(component, level="ok")
    return group(
        box(0, 0, (wide, HIGH), class_="box"),
        level_icon(shown.level, (11, (HIGH - 16) / 2)),
        lettering(shown.name, (LEFT, 28), wide - LEFT - 8, bold=True, class_="name"),
        at=corner,
        class_="node more level-ok",
    )


def _samples(
    lines: Sequence[_Line], layout: GraphLayout, words: DrawingTexts
) -> Iterator[LegendSample]:
    """Yield the entries of the legend: only kinds of lines that are drawn."""
    kinds = {kind for _, kind, _ in lines}
    relations = {"needs": words.needs, "part-of": words.part_of, "indirect": words.indirect}
    for kind, word in relations.items():
        if kind in kinds:
            yield LegendSample(kind, word, arrow=kind != "part-of")
    if any(route.broken for route in layout.routes):
        yield LegendSample("broken", words.circle)
