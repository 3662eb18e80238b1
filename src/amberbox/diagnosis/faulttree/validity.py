"""What may be wrong with a fault tree: cycles, names that nobody defines, gates without input."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.diagnosis.faulttree.expression import count_problem
from amberbox.diagnosis.faulttree.formula import ARITY, Operation, names, parts
from amberbox.diagnosis.faulttree.tree import FaultTree, Gate


@dataclass(frozen=True, slots=True)
class Places:
    """Where the elements of a tree stand: file and line of each name."""

    file: str = "fault tree"
    places: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    def problem(self, name: str, what: str, hint: str = "") -> Problem:
        """Say something about an element."""
        file, line = self.places.get(name, (self.file, 1))
        return Problem(file, line, name, what, hint)


NOWHERE = Places()


def problems(tree: FaultTree, places: Places = NOWHERE) -> list[Problem]:
    """Return everything for which a tree cannot be analysed."""
    found = [*_of_gates(tree, places), *_of_events(tree, places)]
    if tree.top not in tree.gates:
        hint = did_you_mean(tree.top, tree.gates).removeprefix("; ")
        found.append(places.problem(tree.top, "there is no such gate to be the top", hint))
    path = cycle(tree.gates)
    if path:
        what = f"the gate depends on itself: {' > '.join(path)}"
        found.append(places.problem(path[0], what, "take one of these inputs out"))
    return found


def _of_gates(tree: FaultTree, places: Places) -> Iterator[Problem]:
    known = {*tree.gates, *tree.events, *tree.houses}
    for gate in tree.gates.values():
        for name in names(gate.formula):
            if name not in known:
                yield places.problem(gate.name, f"'{name}' is not defined", _similar(name, known))
        for part in parts(gate.formula):
            what = operation_problem(part) if isinstance(part, Operation) else ""
            if what:
                yield places.problem(gate.name, what)


def _similar(name: str, known: set[str]) -> str:
    return did_you_mean(name, known).removeprefix("; ")


def operation_problem(operation: Operation) -> str:
    """Say what is wrong with an operator and its inputs; empty if nothing is."""
    kind, size = operation.operator, len(operation.inputs)
    if size == 0:
        return f"'{kind}' has no input"
    wrong = count_problem(kind, size, *ARITY[kind])
    if wrong:
        return wrong
    if kind in ("atleast", "cardinality") and not 0 <= operation.at_least <= size:
        return f"'{kind}' asks for {operation.at_least} of {size} inputs"
    if kind == "cardinality" and operation.at_most < operation.at_least:
        return f"'{kind}' asks for at least {operation.at_least}, at most {operation.at_most}"
    return ""


def _of_events(tree: FaultTree, places: Places) -> Iterator[Problem]:
    for event in tree.events.values():
        chance = event.probability
        if chance is not None and not 0.0 <= chance <= 1.0:
            yield places.problem(event.name, f"the probability {chance:g} is not between 0 and 1")
    for name in tree.gates:
        if name in tree.events or name in tree.houses:
            yield places.problem(name, "this is the name of a gate and of an event")


def cycle(gates: Mapping[str, Gate]) -> list[str]:
    """Return the path of gates from one back to itself; empty if there is none."""
    return path_back({name: names(gate.formula) for name, gate in gates.items()})


def path_back(uses: Mapping[str, list[str]]) -> list[str]:
    """Return a path that leads from a name back to itself; empty if there is none."""
    finished: set[str] = set()
    for start in uses:
        path: dict[str, Iterator[str]] = {}
        following: str | None = start
        while following is not None or path:
            if following in path:
                steps = list(path)
                return [*steps[steps.index(following) :], following]
            if following is not None and following in uses and following not in finished:
                path[following] = iter(uses[following])
            following = _next(path, finished)
    return []


def _next(path: dict[str, Iterator[str]], finished: set[str]) -> str | None:
    """Return what the last name of a path leads to; drop names that lead to nothing more."""
    if not path:
        return None
    last = next(reversed(path))
    following = next(path[last], None)
    if following is None:
        finished.add(last)
        del path[last]
    return following
