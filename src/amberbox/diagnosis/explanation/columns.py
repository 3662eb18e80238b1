"""Which column a node of the graph stands in, and in what order, so that few lines cross."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from amberbox.diagnosis.explanation.explanation import Graph, NodeKind

PASSES = 4
"""How often columns are put in order by where their neighbours stand."""


@dataclass(frozen=True, slots=True)
class Slot:
    """A box, or a lane where the lines from one box pass a column."""

    id: str
    lane: bool = False
    leading: bool = False


@dataclass(frozen=True, slots=True)
class Link:
    """A line from one column to the next."""

    start: str
    end: str
    missing: bool = False
    leading: bool = False
    into_lane: bool = False


@dataclass(frozen=True, slots=True)
class Columns:
    """Slots from left to right and from top to bottom, what each column is about, and lines."""

    slots: tuple[tuple[Slot, ...], ...]
    kinds: tuple[NodeKind, ...]
    links: tuple[Link, ...]


def columns_of(graph: Graph) -> Columns:
    """Put causes left, symptoms right, and what is lost between them by its distance."""
    levels = _levels(graph)
    last = max(levels.values(), default=0)
    stacks: list[list[Slot]] = [[] for _ in range(last + 1)]
    for node in graph.nodes:
        stacks[levels[node.id]].append(Slot(node.id))
    links = dict.fromkeys(_links(graph, levels, stacks))
    for turn in range(PASSES):
        _sort(stacks, tuple(links), forward=turn % 2 == 0)
    between: list[NodeKind] = ["lost"] * (last - 1)
    kinds: list[NodeKind] = ["cause", *between, "symptom"]
    return Columns(tuple(map(tuple, stacks)), tuple(kinds[: last + 1]), tuple(links))


def _levels(graph: Graph) -> dict[str, int]:
    """Return the column of each node: what is lost stands right of all that leads to it."""
    lost = {node.id for node in graph.nodes if node.kind == "lost"}
    levels = {node.id: 1 if node.id in lost else 0 for node in graph.nodes}
    for _ in lost:
        for edge in graph.edges:
            if edge.start in lost and edge.end in lost:
                levels[edge.end] = max(levels[edge.end], levels[edge.start] + 1)
    last = max(levels.values(), default=0) + 1
    return levels | {node.id: last for node in graph.nodes if node.kind == "symptom"}


def _links(graph: Graph, levels: Mapping[str, int], stacks: Sequence[list[Slot]]) -> Iterator[Link]:
    """Yield lines between neighbouring columns; lanes that they need are added to the stacks."""
    lanes: set[str] = set()
    leading = {edge.start for edge in graph.edges if edge.leading}
    for edge in graph.edges:
        start, leads = edge.start, edge.start in leading
        for level in range(levels[edge.start] + 1, levels[edge.end]):
            lane = f"lane:{level}:{edge.start}"
            if lane not in lanes:
                lanes.add(lane)
                stacks[level].append(Slot(lane, lane=True, leading=leads))
            yield Link(start, lane, leading=leads, into_lane=True)
            start = lane
        yield Link(start, edge.end, edge.missing, edge.leading)


def _sort(stacks: Sequence[list[Slot]], links: Sequence[Link], *, forward: bool) -> None:
    """Put each column in the order of the middles of its neighbours (barycentres).

    The first column keeps its order, the most probable causes first, and so does the last, what
    was seen first.
    """
    order = range(1, len(stacks) - 1) if forward else range(len(stacks) - 2, 0, -1)
    for level in order:
        places = {slot.id: place for stack in stacks for place, slot in enumerate(stack)}
        near = _neighbours(links, forward=forward)
        stacks[level].sort(key=lambda slot: _middle(near.get(slot.id, ()), places))


def _neighbours(links: Sequence[Link], *, forward: bool) -> dict[str, list[str]]:
    near: dict[str, list[str]] = {}
    for link in links:
        here, there = (link.end, link.start) if forward else (link.start, link.end)
        near.setdefault(here, []).append(there)
    return near


def _middle(names: Sequence[str], places: Mapping[str, int]) -> float:
    return sum(places[name] for name in names) / len(names) if names else 1e9
