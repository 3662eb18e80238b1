"""A fault tree as it is drawn: every gate unfolded once, and what a combination brings about."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from amberbox.diagnosis.faulttree.formula import Constant, Formula, Name, Operation
from amberbox.diagnosis.faulttree.tree import FaultTree

GateKind: TypeAlias = Literal[
    "and", "or", "vote", "pass", "xor", "not", "nand", "nor", "iff", "imply", "cardinality"
]
"""``vote`` is k out of n; ``pass`` is a gate that is its only input."""


@dataclass(frozen=True, slots=True)
class Gate:
    """A gate over gates and events; ``k`` is that of ``vote``."""

    id: str
    label: str
    kind: GateKind
    inputs: tuple[str, ...]
    k: int = 0
    probability: float | None = None
    href: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """What happens of itself; ``house`` events are switched on or off by hand."""

    id: str
    label: str
    probability: float | None = None
    kind: Literal["basic", "house", "undeveloped"] = "basic"
    href: str = ""


@dataclass(frozen=True, slots=True)
class Tree:
    """Gates and events by id; ``top`` is the gate on top."""

    top: str
    gates: Mapping[str, Gate]
    events: Mapping[str, Event]


BranchKind: TypeAlias = Literal["gate", "event", "transfer", "cut"]


@dataclass(slots=True)
class Branch:
    """A place in the drawing.

    ``transfer`` stands for a gate that is unfolded elsewhere, ``cut`` for one that is not unfolded
    for want of room.
    """

    id: str
    kind: BranchKind
    inputs: list[Branch] = field(default_factory=list)

    def all(self) -> Iterator[Branch]:
        """Yield the branch and all below it."""
        yield self
        for branch in self.inputs:
            yield from branch.all()


def unfolded(tree: Tree, depth: int, most: int) -> Branch:
    """Return the branches below the top; each gate is unfolded where it comes first from above.

    At most ``depth`` gates stand above each other. When ``most`` places are taken, further gates
    are not unfolded. Raises KeyError for an input that there is not.
    """
    top = Branch(tree.top, "gate")
    taken, count = {tree.top}, 1 + len(tree.gates[tree.top].inputs)
    waiting = deque([(top, 1)])
    while waiting:
        branch, level = waiting.popleft()
        for name in tree.gates[branch.id].inputs:
            kind = _kind_of(tree, name, taken)
            more = len(tree.gates[name].inputs) if kind == "gate" else 0
            if kind == "gate" and (level >= depth or count + more > most):
                kind = "cut"
            below = Branch(name, kind)
            branch.inputs.append(below)
            if kind == "gate":
                count += more
                taken.add(name)
                waiting.append((below, level + 1))
    return top


def _kind_of(tree: Tree, name: str, taken: Collection[str]) -> BranchKind:
    if name in tree.events:
        return "event"
    if name not in tree.gates:
        raise KeyError(name)
    return "transfer" if name in taken else "gate"


def below(tree: Tree, gate: str) -> int:
    """Return how many different gates and events a gate consists of, without itself."""
    found: set[str] = set()
    waiting = [gate]
    while waiting:
        name = waiting.pop()
        inputs = tree.gates[name].inputs if name in tree.gates else ()
        new = [name for name in dict.fromkeys(inputs) if name not in found]
        found.update(new)
        waiting += new
    return len(found - {gate})


_HOLDS: Mapping[str, Callable[[int, int, int], bool]] = {
    "and": lambda true, count, k: true == count,
    "or": lambda true, count, k: true > 0,
    "pass": lambda true, count, k: true > 0,
    "vote": lambda true, count, k: true >= k,
    "xor": lambda true, count, k: true % 2 == 1,
    "not": lambda true, count, k: true == 0,
    "nor": lambda true, count, k: true == 0,
    "nand": lambda true, count, k: true < count,
    "iff": lambda true, count, k: true in (0, count),
}
"""Whether a gate holds by how many of its inputs do; others count as not."""


def held(tree: Tree, events: Collection[str]) -> set[str]:
    """Return the events and all gates below the top that hold when just these events happen."""
    found: dict[str, bool] = {name: name in set(events) for name in tree.events}
    waiting = [tree.top]
    while waiting:
        gate = tree.gates[waiting[-1]]
        open_ = [name for name in gate.inputs if name not in found]
        if open_:
            waiting += open_
            continue
        true = sum(found[name] for name in gate.inputs)
        holds = _HOLDS.get(gate.kind)
        found[gate.id] = holds is not None and holds(true, len(gate.inputs), gate.k)
        waiting.pop()
    return {name for name, holds in found.items() if holds}


def tree_of(tree: FaultTree) -> Tree:
    """Return a fault tree of the diagnosis as it is drawn.

    Formulas inside formulas become gates without a label. What can never happen is left out of OR
    gates.
    """
    never = {name for name, gate in tree.gates.items() if gate.formula == Constant(False)}
    gates: dict[str, Gate] = {}
    events = {
        name: Event(name, event.label or name, event.probability)
        for name, event in tree.events.items()
    }
    events |= {name: Event(name, name, float(on), "house") for name, on in tree.houses.items()}
    for name, gate in tree.gates.items():
        _add(name, gate.label or name, gate.formula, never, gates, events)
    return Tree(tree.top, gates, events)


def _add(
    name: str, label: str, formula: Formula, never: Collection[str], gates: dict[str, Gate],
    events: dict[str, Event],
) -> None:  # fmt: skip
    """Add the gate of a formula, and gates for the formulas inside it."""
    if isinstance(formula, Constant):
        inputs: Sequence[Formula] = (formula,)
        kind, k = "or", 0
    elif isinstance(formula, Name):
        inputs, kind, k = (formula,), "or", 0
    else:
        inputs, kind, k = _possible(formula, never), formula.operator, formula.at_least
    names = []
    for place, part in enumerate(inputs):
        inner = part.name if isinstance(part, Name) else f"{name}/{place + 1}"
        names.append(inner)
        if isinstance(part, Constant):
            events[inner] = Event(inner, "", float(part.value), "house")
        elif isinstance(part, Operation):
            _add(inner, "", part, never, gates, events)
    gates[name] = Gate(name, label, _kind(kind, len(names)), tuple(names), k)


def _possible(formula: Operation, never: Collection[str]) -> Sequence[Formula]:
    """Return the inputs, without those that never hold where they make no difference."""
    if formula.operator != "or":
        return formula.inputs
    kept = [part for part in formula.inputs if not isinstance(part, Name) or part.name not in never]
    return kept or formula.inputs


def _kind(operator: str, inputs: int) -> GateKind:
    if inputs == 1 and operator in ("and", "or"):
        return "pass"
    kinds: dict[str, GateKind] = {
        "and": "and", "or": "or", "atleast": "vote", "xor": "xor", "not": "not", "nand": "nand",
        "nor": "nor", "iff": "iff", "imply": "imply", "cardinality": "cardinality",
    }  # fmt: skip
    return kinds[operator]
