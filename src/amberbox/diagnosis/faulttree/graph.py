"""A fault tree as a graph of few operators: constants gone, equal gates one, chains flattened."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.diagnosis.faulttree.formula import Constant, Formula, Name, Operation

FALSE = 0
TRUE = 1


@dataclass(frozen=True, slots=True)
class Vertex:
    """``event``, ``constant``, ``and``, ``or``, ``atleast`` (``count`` of them), ``not``, ``xor``.

    Inputs are numbers of vertices; those of an event or constant are empty.
    """

    kind: str
    inputs: tuple[int, ...] = ()
    count: int = 0
    event: str = ""


@dataclass
class Graph:
    """Vertices by number; 0 is false and 1 is true."""

    vertices: list[Vertex] = field(
        default_factory=lambda: [Vertex("constant"), Vertex("constant", count=1)]
    )
    known: dict[tuple[object, ...], int] = field(default_factory=dict)

    def event(self, name: str) -> int:
        """Return the vertex of a basic event."""
        return self._vertex(("event", name), Vertex("event", event=name))

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
        return self._vertex((kind, *sorted(distinct)), Vertex(kind, tuple(distinct)))

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
        return self._vertex(key, Vertex("atleast", tuple(open_), count))

    def _not(self, entry: int) -> int:
        if entry in (FALSE, TRUE):
            return TRUE - entry
        opposite = self._opposite(entry)
        if opposite is not None:
            return opposite
        return self._vertex(("not", entry), Vertex("not", (entry,)))

    def _xor(self, left: int, right: int) -> int:
        if left == right:
            return FALSE
        for this, other in ((left, right), (right, left)):
            if this in (FALSE, TRUE):
                return self._not(other) if this == TRUE else other
        key = ("xor", *sorted((left, right)))
        return self._vertex(key, Vertex("xor", (left, right)))

    def _vertex(self, key: tuple[object, ...], vertex: Vertex) -> int:
        number = self.known.setdefault(key, len(self.vertices))
        if number == len(self.vertices):
            self.vertices.append(vertex)
        return number


@dataclass
class _Builder:
    """Turns formulas into vertices without recursion: what is left to do lies on ``tasks``."""

    gates: Mapping[str, Formula]
    constants: Mapping[str, bool]
    graph: Graph = field(default_factory=Graph)
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
            elif step == "make" and isinstance(formula, Operation):
                self._make(formula)
            else:
                self._visit(formula)
        return self.made.pop()

    def _visit(self, formula: Formula) -> None:
        if isinstance(formula, Constant):
            self.made.append(int(formula.value))
        elif isinstance(formula, Operation):
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

    def _make(self, formula: Operation) -> None:
        size = len(formula.inputs)
        inputs = self.made[len(self.made) - size :]
        del self.made[len(self.made) - size :]
        self.made.append(_combine(self.graph, formula, inputs))


def _combine(graph: Graph, formula: Operation, inputs: Sequence[int]) -> int:
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


def build(
    gates: Mapping[str, Formula], constants: Mapping[str, bool], top: Formula
) -> tuple[Graph, int]:
    """Return the graph of a formula over gates, and its vertex.

    ``constants`` are the house events. Names that are neither gate nor constant are events. The
    gates must be free of cycles.
    """
    builder = _Builder(gates, constants)
    vertex = builder.build(top)
    return _flattened(builder.graph, vertex)


def _flattened(graph: Graph, top: int) -> tuple[Graph, int]:
    """Let a gate take over the inputs of gates of its kind that nobody else uses."""
    parents = graph.parents(top)
    flat = Graph()
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
