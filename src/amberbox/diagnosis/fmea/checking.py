"""What is wrong between the entries of the file: names, circles, effects, modes nobody sees."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.needs import cycles
from amberbox.core.nodes import Node
from amberbox.diagnosis.fmea.entries import Part
from amberbox.diagnosis.fmea.model import Effects, FailureMode, Fmea
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.propagation import dependents, links_of


def check(
    fmea: Fmea,
    root: Node,
    parts: Sequence[Part],
    names: Collection[str],
    problems: list[Problem],
) -> Fmea | None:
    """Return the analysis with all effects filled in; None if names or needs are wrong.

    ``names`` are all components and functions of the file, those that cannot be read, too.
    """
    found = [*_name_problems(fmea, root, parts, names), *_circles(fmea, root, parts)]
    problems += found
    if any(problem.is_error for problem in found):
        return None
    places = {f"{part.component}#{name}": part.mode_node(name)
              for part in parts for name in part.file.failure_modes}  # fmt: skip
    problems += _mode_problems(fmea, places, root)
    modes = {name: replace(mode, effects=_effects(fmea, mode)) for name, mode in fmea.modes.items()}
    return replace(fmea, modes=modes)


def _name_problems(
    fmea: Fmea, root: Node, parts: Sequence[Part], names: Collection[str]
) -> Iterator[Problem]:
    for name in fmea.functions:
        if name in fmea.components:
            what = f"'{name}' is a component and a function"
            yield child(root, "functions", name).problem(f"functions.{name}", what)
    for user, of in fmea.needs().items():
        for name in of.names():
            if name not in names:
                what = f"there is no component or function '{name}'{did_you_mean(name, names)}"
                yield _needs_node(user, root, parts, name).problem(f"{user}.needs", what)


def _needs_node(user: str, root: Node, parts: Sequence[Part], name: str = "") -> Node:
    """Find where it is said what a component or function needs, best the name itself."""
    part = next((part for part in parts if part.component == user), None)
    node = child(part.node if part else child(root, "functions", user), "needs")
    return next((leaf for leaf in _leaves(node) if name and leaf.text == name), node)


def _leaves(node: Node) -> Iterator[Node]:
    for entry in (*(node.items or ()), *(node.mapping or {}).values()):
        yield from _leaves(entry)
    if node.items is None and node.mapping is None:
        yield node


def _circles(fmea: Fmea, root: Node, parts: Sequence[Part]) -> Iterator[Problem]:
    for circle in cycles(fmea.needs()):
        what = f"needs itself: {' -> '.join((*circle, circle[0]))}"
        yield _needs_node(circle[-1], root, parts, circle[0]).problem(f"{circle[-1]}.needs", what)


def _mode_problems(fmea: Fmea, places: Mapping[str, Node], root: Node) -> Iterator[Problem]:
    for mode in fmea.modes.values():
        node = places.get(mode.id) or child(root, "robots", *mode.component.split(":"))
        yield from _effect_problems(fmea, mode, node)
        if not mode.unobservable and not links_of(fmea, mode.id):
            what = "nothing shows it: give symptoms, or 'unobservable:' with the reason"
            yield node.problem(mode.name, what)


def _effect_problems(fmea: Fmea, mode: FailureMode, node: Node) -> Iterator[Problem]:
    names = {*fmea.components, *fmea.functions}
    reached = dependents(fmea, [mode.component])
    for key, stated in (("next", mode.effects.next), ("system", mode.effects.system)):
        for place, name in enumerate(stated):
            where = f"{mode.name}.effects.{key}"
            at = child(node, "effects", key, place)
            if name not in names:
                what = f"there is no function '{name}'{did_you_mean(name, names)}"
                yield at.problem(where, what)
            elif name not in reached and mode.takes_down:
                what = f"{name} does not need {mode.component}, directly or not"
                yield at.problem(where, what, is_error=False)


def _effects(fmea: Fmea, mode: FailureMode) -> Effects:
    """Fill in what follows from needs: users next to it, and functions of the system."""
    stated = mode.effects
    if not mode.takes_down:
        return stated
    users = (name for name, of in fmea.needs().items() if mode.component in of.names())
    reached = dependents(fmea, [mode.component])
    system = (name for name in fmea.system_functions() if name in reached)
    return Effects(stated.local, stated.next or tuple(users), stated.system or tuple(system))
