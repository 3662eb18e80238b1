"""A fault tree as a simplified graph, its independent modules, and orders of its variables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.diagnosis.faulttree.tree import (
    COHERENT,
    BooleanConstant,
    Formula,
    GateOperation,
    Name,
)

FALSE = 0
TRUE = 1


@dataclass(frozen=True, slots=True)
class FaultGraphVertex:
    """``event``, ``constant``, ``and``, ``or``, ``atleast`` (``count`` of them), ``not``, ``xor``.

    Inputs are numbers of vertices; those of an event or constant are empty.
    """

    kind: str
    inputs: tuple[int, ...] = ()
    count: int = 0
    event: str = ""


@dataclass
class FaultGraph:
    """Vertices by number; 0 is false and 1 is true."""

    vertices: list[FaultGraphVertex] = field(
        default_factory=lambda: [
            FaultGraphVertex("constant"),
            FaultGraphVertex("constant", count=1),
        ]
    )
    known: dict[tuple[object, ...], int] = field(default_factory=dict)

    def event(self, name: str) -> int:
        """Return the vertex of a basic event."""
        return self._vertex(("event", name), FaultGraphVertex("event", event=name))

    def add(self, kind: str, inputs: Iterable[int], count: int = 0) -> int:
        """Return a vertex of this kind, simplified, the same one for equal inputs."""
        entries = list(inputs)
        if kind in ("and", "or"):
            return self._and_or(kind, entries)
        if kind == "atleast":
            return self._at_least(entries, count)
        return self._not(entries[0]) if kind == "not" else self._xor(*entries)

    def parents(self, top: int) -> dict[int, int]:
        """Return every vertex below ``top`` with the number of edges that lead to it."""
        found = {top: 0}
        waiting = [top]
        while waiting:
            for entry in self.vertices[waiting.pop()].inputs:
                if entry not in found:
                    found[entry] = 0
                    waiting.append(entry)
                found[entry] += 1
        return found

    def _and_or(self, kind: str, entries: list[int]) -> int:
        neutral, absorbing = (TRUE, FALSE) if kind == "and" else (FALSE, TRUE)
        distinct = dict.fromkeys(entry for entry in entries if entry != neutral)
        if absorbing in distinct or any(self._opposite(entry) in distinct for entry in distinct):
            return absorbing
        if len(distinct) < 2:
            return next(iter(distinct), neutral)
        return self._vertex((kind, *sorted(distinct)), FaultGraphVertex(kind, tuple(distinct)))

    def _opposite(self, entry: int) -> int | None:
        vertex = self.vertices[entry]
        return vertex.inputs[0] if vertex.kind == "not" else None

    def _at_least(self, entries: list[int], count: int) -> int:
        count -= entries.count(TRUE)
        open_ = [entry for entry in entries if entry not in (FALSE, TRUE)]
        if count <= 0 or count > len(open_):
            return TRUE if count <= 0 else FALSE
        if count in (1, len(open_)):
            return self._and_or("or" if count == 1 else "and", open_)
        key = ("atleast", count, *sorted(open_))
        return self._vertex(key, FaultGraphVertex("atleast", tuple(open_), count))

    def _not(self, entry: int) -> int:
        if entry in (FALSE, TRUE):
            return TRUE - entry
        opposite = self._opposite(entry)
        if opposite is not None:
            return opposite
        return self._vertex(("not", entry), FaultGraphVertex("not", (entry,)))

    def _xor(self, left: int, right: int) -> int:
        if left == right:
            return FALSE
        for this, other in ((left, right), (right, left)):
            if this in (FALSE, TRUE):
                return self._not(other) if this == TRUE else other
        key = ("xor", *sorted((left, right)))
        return self._vertex(key, FaultGraphVertex("xor", (left, right)))

    def _vertex(self, key: tuple[object, ...], vertex: FaultGraphVertex) -> int:
        number = self.known.setdefault(key, len(self.vertices))
        if number == len(self.vertices):
            self.vertices.append(vertex)
        return number


@dataclass
class _Builder:
    """Converts formulas to vertices without recursion: ``tasks`` is the stack of open work."""

    gates: Mapping[str, Formula]
    constants: Mapping[str, bool]
    graph: FaultGraph = field(default_factory=FaultGraph)
    of_gate: dict[str, int] = field(default_factory=dict)
    tasks: list[tuple[str, Formula]] = field(default_factory=list)
    made: list[int] = field(default_factory=list)

    def build(self, top: Formula) -> int:
        """Return the vertex of a formula."""
        self.tasks.append(("visit", top))
        while self.tasks:
            step, formula = self.tasks.pop()
            if step == "name" and isinstance(formula, Name):
                self.of_gate[formula.name] = self.made[-1]
            elif step == "make" and isinstance(formula, GateOperation):
                size = len(formula.inputs)
                inputs = self.made[len(self.made) - size :]
                del self.made[len(self.made) - size :]
                self.made.append(_combine(self.graph, formula, inputs))
            else:
                self._visit(formula)
        return self.made.pop()

    def _visit(self, formula: Formula) -> None:
        if isinstance(formula, BooleanConstant):
            self.made.append(int(formula.value))
        elif isinstance(formula, GateOperation):
            self.tasks.append(("make", formula))
            self.tasks += [("visit", entry) for entry in reversed(formula.inputs)]
        elif formula.name in self.of_gate:
            self.made.append(self.of_gate[formula.name])
        elif formula.name in self.gates:
            self.tasks += [("name", formula), ("visit", self.gates[formula.name])]
        elif formula.name in self.constants:
            self.made.append(int(self.constants[formula.name]))
        else:
            self.made.append(self.graph.event(formula.name))


def _combine(graph: FaultGraph, formula: GateOperation, inputs: Sequence[int]) -> int:
    """Express an operator by ``and``, ``or``, ``atleast``, ``not`` and ``xor``."""
    operator = formula.operator
    if operator in ("nand", "nor"):
        return graph.add("not", [graph.add(operator[1:], inputs)])
    if operator == "iff":
        return graph.add("not", [graph.add("xor", inputs)])
    if operator == "imply":
        return graph.add("or", [graph.add("not", inputs[:1]), inputs[1]])
    if operator == "cardinality":
        enough = graph.add("atleast", inputs, formula.at_least)
        too_many = graph.add("atleast", inputs, formula.at_most + 1)
        return graph.add("and", [enough, graph.add("not", [too_many])])
    return graph.add(operator, inputs, formula.at_least)


def build_fault_graph(
    gates: Mapping[str, Formula], constants: Mapping[str, bool], top: Formula
) -> tuple[FaultGraph, int]:
    """Return the graph of a formula over gates, and its vertex.

    ``constants`` are the house events. Names that are neither gate nor constant are events. The
    gates must be free of cycles.
    """
    builder = _Builder(gates, constants)
    vertex = builder.build(top)
    return _flattened(builder.graph, vertex)


def _flattened(graph: FaultGraph, top: int) -> tuple[FaultGraph, int]:
    """Let a gate take over the inputs of gates of its kind that no other gate uses."""
    parents = graph.parents(top)
    flat = FaultGraph()
    moved = {FALSE: FALSE, TRUE: TRUE}
    for number in sorted(parents):  # inputs have smaller numbers
        vertex = graph.vertices[number]
        if vertex.kind == "event":
            moved[number] = flat.event(vertex.event)
        elif vertex.kind != "constant":
            inputs: list[int] = []
            for entry in vertex.inputs:
                below = flat.vertices[moved[entry]]
                takes = vertex.kind in ("and", "or") and below.kind == vertex.kind
                inputs += below.inputs if takes and parents[entry] == 1 else (moved[entry],)
            moved[number] = flat.add(vertex.kind, inputs, vertex.count)
    return flat, moved[top]


_PLAIN = frozenset({"event", "constant"}) | COHERENT


def is_plain(graph: FaultGraph, number: int) -> bool:
    """Return whether a vertex is neither NOT nor XOR."""
    return graph.vertices[number].kind in _PLAIN


@dataclass(frozen=True, slots=True)
class FaultTreeModule:
    """A vertex and the vertices below it down to events and other parts, its ``leaves``.

    ``leaves`` and ``inner`` are in the order of a walk from left to right; in ``inner`` a vertex
    comes after its inputs.
    """

    vertex: int
    leaves: tuple[int, ...]
    inner: tuple[int, ...]


def split_modules(graph: FaultGraph, top: int) -> list[FaultTreeModule]:
    """Return the parts below and including ``top``, each after those it needs.

    Only coherent parts are separated: for these the minimal cut sets of the whole tree are those of
    the remaining tree with the cut sets of the part inserted. New vertices may be added to
    ``graph``.
    """
    alone = _group(graph, top, _modules(graph, top))
    parts: dict[int, FaultTreeModule] = {}
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


def coherent(graph: FaultGraph, top: int) -> bool:
    """Return whether no failure more can repair anything: no ``not`` and no ``xor`` is left."""
    return all(graph.vertices[number].kind in _PLAIN for number in graph.parents(top))


def _part(graph: FaultGraph, top: int, alone: set[int]) -> FaultTreeModule:
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
        return FaultTreeModule(top, (top,), ())
    return FaultTreeModule(top, tuple(leaves), tuple(inner))


@dataclass(slots=True)
class _Visit:
    """The steps at which a walk first reached, left (gates: after all inputs) and last reached a
    vertex.
    """

    first: int
    left: int = 0
    last: int = 0


def _modules(graph: FaultGraph, top: int) -> set[int]:
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


def _walk(graph: FaultGraph, top: int) -> dict[int, _Visit]:
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


def _inputs_first(graph: FaultGraph, top: int) -> list[int]:
    """Return the vertices below a vertex, inputs before the gates that use them."""
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


def _group(graph: FaultGraph, top: int, found: set[int]) -> set[int]:
    """Group inputs that are used only by one AND or OR; return all parts."""
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
        graph.vertices[number] = FaultGraphVertex(vertex.kind, inputs)
    return grouped


def _stands_alone(graph: FaultGraph, number: int, found: set[int]) -> bool:
    return number in found or graph.vertices[number].kind == "event"


def _regrouped(
    graph: FaultGraph, number: int, groups: Iterable[list[int]], grouped: set[int]
) -> tuple[int, ...]:
    """Return the inputs of a vertex with each group of two or more made a part of its own."""
    vertex = graph.vertices[number]
    inputs = dict.fromkeys(vertex.inputs)
    for group in groups:
        if 1 < len(group) < len(inputs):
            for entry in group:
                del inputs[entry]
            graph.vertices.append(FaultGraphVertex(vertex.kind, tuple(group)))
            inputs[len(graph.vertices) - 1] = None
            grouped.add(len(graph.vertices) - 1)
    return tuple(inputs)


def _events_below(graph: FaultGraph, top: int) -> dict[int, int]:
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


_ROUNDS = 20


def variable_orders(graph: FaultGraph, part: FaultTreeModule) -> list[tuple[int, ...]]:
    """Return orders of the leaves of a part; the most promising ones first."""
    inputs = {number: graph.vertices[number].inputs for number in part.inner}
    if len(part.leaves) < 3 or len(part.inner) < 2:
        return [part.leaves]
    uses, sizes = _uses(inputs), _sizes(inputs)
    shared_first = _ordering_walk(part.vertex, inputs, lambda entry: -uses[entry])
    large_first = _ordering_walk(part.vertex, inputs, lambda entry: -sizes.get(entry, 0))
    small_first = _ordering_walk(part.vertex, inputs, lambda entry: sizes.get(entry, 0))
    plain = _ordering_walk(part.vertex, inputs, lambda entry: 0)
    heights = _by_place(plain, inputs, _heights(inputs), max)
    middles = _by_place(plain, inputs, _heights(inputs), _mean)
    depths = _by_place(plain, inputs, _depths(part.vertex, inputs), max)
    found = [shared_first, small_first, large_first, plain, heights, depths, middles]
    improvable = (shared_first, plain, heights, depths, large_first)
    found += [_forced(order, inputs) for order in improvable]
    return list(dict.fromkeys(found))


def _uses(inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by vertex how many gates use it."""
    uses: dict[int, int] = {}
    for entries in inputs.values():
        for entry in entries:
            uses[entry] = uses.get(entry, 0) + 1
    return uses


def _sizes(inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by gate the number of vertices below it; shared vertices count repeatedly."""
    sizes: dict[int, int] = {}
    for number, entries in inputs.items():  # inputs come before what uses them
        sizes[number] = 1 + sum(sizes.get(entry, 1) for entry in entries)
    return sizes


def _heights(inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by gate the longest way down."""
    heights: dict[int, int] = {}
    for number, entries in inputs.items():
        heights[number] = 1 + max(heights.get(entry, 0) for entry in entries)
    return heights


def _depths(top: int, inputs: Mapping[int, Sequence[int]]) -> dict[int, int]:
    """Return by gate the negative length of the longest path to the top, so that the top is
    highest.
    """
    depths = {top: 0}
    for number in reversed(list(inputs)):
        for entry in inputs[number]:
            depths[entry] = min(depths.get(entry, 0), depths[number] - 1)
    return depths


def _mean(values: Sequence[int]) -> float:
    return sum(values) / len(values)


def _by_place(
    order: Sequence[int],
    inputs: Mapping[int, Sequence[int]],
    places: Mapping[int, int],
    among: Callable[[Sequence[int]], float],
) -> tuple[int, ...]:
    """Sort leaves by the position of the gates that use them, the highest first."""
    users: dict[int, list[int]] = {leaf: [] for leaf in order}
    for number, entries in inputs.items():
        for entry in entries:
            if entry in users:
                users[entry].append(places[number])
    return tuple(sorted(order, key=lambda leaf: -among(users[leaf])))


def _ordering_walk(
    top: int, inputs: Mapping[int, Sequence[int]], key: Callable[[int], float]
) -> tuple[int, ...]:
    leaves: dict[int, None] = {}
    seen: set[int] = set()
    waiting = [top]
    while waiting:
        number = waiting.pop()
        if number not in inputs:
            leaves[number] = None
        elif number not in seen:
            seen.add(number)
            waiting += sorted(inputs[number], key=key)[::-1]  # ties stay left to right
    return tuple(leaves)


def _forced(order: tuple[int, ...], inputs: Mapping[int, Sequence[int]]) -> tuple[int, ...]:
    """Improve an order: move gates to the middle of their inputs, and inputs towards
    their gates.
    """
    best, best_span = order, _span(order, inputs)
    for _ in range(_ROUNDS):
        place = {leaf: float(n) for n, leaf in enumerate(order)}
        pulls: dict[int, list[float]] = {leaf: [] for leaf in order}
        for number, entries in inputs.items():
            place[number] = sum(place[entry] for entry in entries) / len(entries)
            for entry in entries:
                if entry in pulls:
                    pulls[entry].append(place[number])
        order = tuple(sorted(order, key=lambda leaf: sum(pulls[leaf]) / len(pulls[leaf])))
        span = _span(order, inputs)
        if span >= best_span:
            break
        best, best_span = order, span
    return best


def _span(order: Sequence[int], inputs: Mapping[int, Sequence[int]]) -> int:
    """Add up the distances between the events of each gate."""
    ranges = {leaf: (n, n) for n, leaf in enumerate(order)}
    total = 0
    for number, entries in inputs.items():
        first = min(ranges[entry][0] for entry in entries)
        last = max(ranges[entry][1] for entry in entries)
        ranges[number] = first, last
        total += last - first
    return total
