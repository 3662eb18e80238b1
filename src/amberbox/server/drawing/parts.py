"""The parts of a model of components and how they are connected, with what they may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from amberbox.core.layered_layout import LayoutBox, LayoutGaps, LinkRoute, layered
from amberbox.core.svg import (
    SIZE,
    SMALL,
    SvgElement,
    box,
    classes,
    element,
    group,
    lettering,
    root,
    title,
    width,
)
from amberbox.server.drawing.symbols import level_icon

MARGIN = 14.0
HIGH = 46.0
LEFT = 36.0  # x of the text beside an icon
NARROW, WIDE = 96.0, 208.0
GAPS = LayoutGaps(ranks=56, boxes=14)

PartLevel: TypeAlias = Literal["", "ok", "warn", "error", "unknown"]


@dataclass(frozen=True, slots=True)
class PartBox:
    """A component with its type; ``level`` is empty where nothing was observed."""

    name: str
    type: str
    level: PartLevel = ""
    state: str = ""


def parts_graph(
    parts: Sequence[PartBox], connections: Sequence[Sequence[str]], *, label: str
) -> SvgElement:
    """Draw components and lines between those with ports (``component.port``) of one value.

    Ports of components that are not in ``parts`` are left out.
    """
    names = {part.name for part in parts}
    lines = _lines(connections, names)
    wide = _width(parts)
    layout = layered([LayoutBox(part.name, wide, HIGH) for part in parts], list(lines), gaps=GAPS)
    edges = [
        _edge(ends, lines[ends], route)
        for ends, route in zip(lines, layout.routes, strict=True)
    ]  # fmt: skip
    nodes = [_node(part, layout.corners[part.name], wide) for part in parts]
    size = (layout.width + 2 * MARGIN, layout.height + 2 * MARGIN)
    return root("graph", size, label, [group(*edges, *nodes, at=(MARGIN, MARGIN))])


def _lines(
    connections: Sequence[Sequence[str]], names: set[str]
) -> Mapping[tuple[str, str], list[str]]:
    """Return the ports that each line joins: from the first component of a connection to others."""
    found: dict[tuple[str, str], list[str]] = {}
    for ports in connections:
        ends = [port for port in ports if _owner(port) in names]
        for other in ends[1:]:
            pair = _owner(ends[0]), _owner(other)
            if pair[0] != pair[1]:
                known = pair if pair in found or pair[::-1] not in found else pair[::-1]
                found.setdefault(known, []).append(f"{ends[0]} = {other}")
    return found


def _owner(port: str) -> str:
    return port.rpartition(".")[0]


def _width(parts: Sequence[PartBox]) -> float:
    longest = max(
        (max(width(p.name, SIZE, bold=True), width(_below(p), SMALL)) for p in parts), default=0.0
    )
    return min(WIDE, max(NARROW, longest + LEFT + 12))


def _below(part: PartBox) -> str:
    return f"{part.type}, {part.state}" if part.state else part.type


def _edge(ends: tuple[str, str], ports: Sequence[str], route: LinkRoute) -> SvgElement:
    return group(
        title("; ".join(ports)),
        element("path", class_="line", d=route.path),
        class_="edge",
        data_start=ends[0],
        data_end=ends[1],
    )


def _node(part: PartBox, corner: tuple[float, float], wide: float) -> SvgElement:
    left = LEFT if part.level else 12.0
    return group(
        title(f"{part.name}: {_below(part)}"),
        box(0, 0, (wide, HIGH), class_="box"),
        level_icon(part.level, (11, (HIGH - 16) / 2)) if part.level else None,
        lettering(part.name, (left, 20), wide - left - 8, bold=True, class_="name"),
        lettering(_below(part), (left, 36), wide - left - 8, SMALL, class_="small"),
        at=corner,
        class_=classes("node", f"level-{part.level}" if part.level else ""),
        data_id=part.name,
    )
