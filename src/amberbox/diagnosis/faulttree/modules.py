"""Parts of a fault tree that share no event with the rest, to be solved once and by themselves.

Found by times of first and last visit (Dutuit & Rauzy, "A linear-time algorithm to find modules
of fault trees", 1996). What stands alone below a gate is put together as one more part.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from amberbox.diagnosis.faulttree.formula import COHERENT
from amberbox.diagnosis.faulttree.graph import Graph, Vertex

_PLAIN = frozenset({"event", "constant"}) | COHERENT


@dataclass(frozen=True, slots=True)
class Part:
    """A vertex and the vertices below it down to events and other parts, its ``leaves``.

    ``leaves`` and ``inner`` are in the order of a walk from left to right; in ``inner`` inputs
    come before what uses them.
    """

    vertex: int
    leaves: tuple[int, ...]
    inner: tuple[int, ...]


def split(graph: Graph, top: int) -> list[Part]:
    """Return the parts below and including ``top``, each after those it needs.

    Only coherent parts are taken out: for these the minimal cut sets of the whole are those of
    the rest with the part's own put in. New vertices may be added to ``graph``.
    """
    alone = _group(graph, top, _modules(graph, top))
    parts: dict[int, Part] = {}
    waiting = [top]
    while waiting:
        vertex = waiting[-1]
        part = parts.get(vertex) or _part(graph, vertex, alone)
        missing = [leaf for leaf in part.leaves if leaf in alone and leaf not in parts]
        if missing:
            waiting += missing
        else:
            parts[waiting.pop()] = part
    return list(parts.values())


def coherent(graph: Graph, top: int) -> bool:
    """Tell whether no failure more can repair anything: no ``not`` and no ``xor`` is left."""
    return all(graph.vertices[number].kind in _PLAIN for number in graph.parents(top))


def _part(graph: Graph, top: int, alone: set[int]) -> Part:
    leaves: dict[int, None] = {}
    inner: dict[int, None] = {}
    waiting = [top] if graph.vertices[top].inputs else []
    while waiting:
        number = waiting.pop()
        if number < 0:
            inner[~number] = None
        elif number != top and (number in alone or graph.vertices[number].kind == "event"):
            leaves[number] = None
        elif number not in inner:
            waiting.append(~number)
            waiting += reversed([n for n in graph.vertices[number].inputs if n not in inner])
    if graph.vertices[top].kind == "event":
        return Part(top, (top,), ())
    return Part(top, tuple(leaves), tuple(inner))


@dataclass(slots=True)
class _Visit:
    """When a walk came first, left (gates: after all inputs) and came last."""

    first: int
    left: int = 0
    last: int = 0


def _modules(graph: Graph, top: int) -> set[int]:
    visits = _walk(graph, top)
    spans: dict[int, tuple[int, int]] = {}
    plain: dict[int, bool] = {}
    found = set()
    for number in _inputs_first(graph, top):
        vertex = graph.vertices[number]
        plain[number] = vertex.kind in _PLAIN and all(plain[n] for n in vertex.inputs)
        below = [(visits[n].first, visits[n].last) for n in vertex.inputs]
        below += [spans[n] for n in vertex.inputs if n in spans]
        if below:
            first, last = min(b[0] for b in below), max(b[1] for b in below)
            spans[number] = first, last
            if plain[number] and visits[number].first < first and last < visits[number].left:
                found.add(number)
    return found


def _walk(graph: Graph, top: int) -> dict[int, _Visit]:
    visits: dict[int, _Visit] = {}
    waiting = [top]
    time = 0
    while waiting:
        number = waiting.pop()
        time += 1
        if number < 0:
            visits[~number].left = visits[~number].last = time
        elif number in visits:
            visits[number].last = time
        else:
            visits[number] = _Visit(time, time, time)
            if graph.vertices[number].inputs:
                waiting.append(~number)
                waiting += reversed(graph.vertices[number].inputs)
    return visits


def _inputs_first(graph: Graph, top: int) -> list[int]:
    """Return what is below a vertex, inputs before what uses them."""
    order: dict[int, None] = {}
    waiting = [top]
    while waiting:
        number = waiting.pop()
        if number < 0:
            order[~number] = None
        elif number not in order:
            waiting.append(~number)
            waiting += [n for n in graph.vertices[number].inputs if n not in order]
    return list(order)


def _group(graph: Graph, top: int, found: set[int]) -> set[int]:
    """Put together what stands alone below each AND and OR; return all parts."""
    parents = graph.parents(top)
    events = _events_below(graph, top)
    grouped = set(found)
    for number in parents:
        vertex = graph.vertices[number]
        if vertex.kind not in ("and", "or"):
            continue
        own = [n for n in vertex.inputs if parents[n] == 1 and _stands_alone(graph, n, found)]
        rest = [n for n in vertex.inputs if n not in set(own)]
        groups = [own, *_apart(rest, events)] if number in found else [own]
        inputs = _regrouped(graph, number, groups, grouped)
        graph.vertices[number] = Vertex(vertex.kind, inputs)
    return grouped


def _stands_alone(graph: Graph, number: int, found: set[int]) -> bool:
    return number in found or graph.vertices[number].kind == "event"


def _regrouped(
    graph: Graph, number: int, groups: Iterable[list[int]], grouped: set[int]
) -> tuple[int, ...]:
    """Return the inputs of a vertex with each group of two or more made a part of its own."""
    vertex = graph.vertices[number]
    inputs = dict.fromkeys(vertex.inputs)
    for group in groups:
        if 1 < len(group) < len(inputs):
            for entry in group:
                del inputs[entry]
            graph.vertices.append(Vertex(vertex.kind, tuple(group)))
            inputs[len(graph.vertices) - 1] = None
            grouped.add(len(graph.vertices) - 1)
    return tuple(inputs)


def _events_below(graph: Graph, top: int) -> dict[int, int]:
    """Return the events below each vertex as bits."""
    bits: dict[int, int] = {}
    for number in _inputs_first(graph, top):
        inputs = graph.vertices[number].inputs
        bits[number] = 0 if inputs else 1 << number
        for entry in inputs:
            bits[number] |= bits[entry]
    return bits


def _apart(entries: Iterable[int], events: Mapping[int, int]) -> Iterator[list[int]]:
    """Yield groups of entries that share no event with another group."""
    groups: list[tuple[int, list[int]]] = []
    for entry in entries:
        bits, members = events[entry], [entry]
        separate = []
        for group in groups:
            if group[0] & bits:
                bits, members = bits | group[0], group[1] + members
            else:
                separate.append(group)
        groups = [*separate, (bits, members)]
    yield from (members for _, members in groups)
