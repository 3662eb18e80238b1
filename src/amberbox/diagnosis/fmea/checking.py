"""What is wrong between the entries of the file: names, circles, effects, modes nobody sees."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.expression_tree import of_monitors
from amberbox.core.needs import cycles
from amberbox.core.nodes import Node
from amberbox.diagnosis.fmea.findings import named_by_findings
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.model import Effects, FailureMode, Fmea
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.propagation import Structure, links_by_mode
from amberbox.diagnosis.fmea.reading import Sheet


def check(fmea: Fmea, sheet: Sheet, known: Known | None, problems: list[Problem]) -> Fmea | None:
    """Return the analysis with all effects filled in; None if names or needs are wrong."""
    found = [*_name_problems(fmea, sheet, known), *_circles(fmea, sheet)]
    problems += _not_analysed(fmea, sheet, known) if known else ()
    problems += found
    if any(problem.is_error for problem in found):
        return None
    places = {f"{part.component}#{name}": part.mode_node(name)
              for part in sheet.parts for name in part.modes}  # fmt: skip
    reach = _Reach.of(fmea)
    problems += _mode_problems(fmea, reach, places, sheet)
    modes = {
        name: replace(mode, effects=_effects(fmea, reach, mode))
        for name, mode in fmea.modes.items()
    }
    return replace(fmea, modes=modes)


@dataclass(frozen=True, slots=True)
class _Reach:
    """What needs each component: next to it, and in the end."""

    next: Mapping[str, tuple[str, ...]]
    all: Mapping[str, frozenset[str]]

    @classmethod
    def of(cls, fmea: Fmea) -> _Reach:
        structure = Structure.of(fmea.needs())
        reached = {name: structure.dependents([name]) for name in fmea.components}
        return cls(structure.users, reached)


def _name_problems(fmea: Fmea, sheet: Sheet, known: Known | None) -> Iterator[Problem]:
    names = {*fmea.components, *sheet.names}
    for name in fmea.functions:
        if name in fmea.components:
            what = f"'{name}' is a component and a function"
            yield child(sheet.root, "functions", name).problem(f"functions.{name}", what)
    for user, of in fmea.needs().items():
        for name in of.names():
            if name not in names:
                what = f"there is no component or function '{name}'{did_you_mean(name, names)}"
                hint = "" if known else "components of a robot folder are known with the folder"
                yield _needs_node(user, sheet, name).problem(f"{user}.needs", what, hint)


def _not_analysed(fmea: Fmea, sheet: Sheet, known: Known) -> Iterator[Problem]:
    """Note the components of the folder of whose failures the file says nothing."""
    needed = {name: user for user, of in fmea.needs().items() for name in of.names()}
    read = [a for of in fmea.symptoms.values() if of.condition for a in of.condition.addresses()]
    symptoms = {said[0] for name in (*fmea.symptoms, *read) if (said := of_monitors(name))}
    hint = f"give it failure_modes under 'types' of {sheet.root.file}"
    for name in sheet.folder:
        user = needed.get(name, "")
        if user in fmea.functions or any(part.component == user for part in sheet.parts):
            what = f"of '{name}' no failure mode is known: it fails only with what it needs"
            place = _needs_node(user, sheet, name)
            yield place.problem(f"{user}.needs", what, hint, is_error=False)
        elif name in known.files and name not in symptoms:
            what = f"'{name}' is monitored, but no failure mode is known: no diagnosis names it"
            yield Problem(known.files[name], 1, "component", what, hint, is_error=False)


def _needs_node(user: str, sheet: Sheet, name: str = "") -> Node:
    """Find where it is said what a component or function needs, best the name itself."""
    part = next((part for part in sheet.parts if part.component == user), None)
    node = child(part.node if part else child(sheet.root, "functions", user), "needs")
    return next((leaf for leaf in _leaves(node) if name and leaf.text == name), node)


def _leaves(node: Node) -> Iterator[Node]:
    for entry in (*(node.items or ()), *(node.mapping or {}).values()):
        yield from _leaves(entry)
    if node.items is None and node.mapping is None:
        yield node


def _circles(fmea: Fmea, sheet: Sheet) -> Iterator[Problem]:
    for circle in cycles(fmea.needs()):
        what = f"needs itself: {' -> '.join((*circle, circle[0]))}"
        yield _needs_node(circle[-1], sheet, circle[0]).problem(f"{circle[-1]}.needs", what)


def _mode_problems(
    fmea: Fmea, reach: _Reach, places: Mapping[str, Node], sheet: Sheet
) -> Iterator[Problem]:
    links = links_by_mode(fmea)
    found = named_by_findings(fmea)
    for mode in fmea.modes.values():
        node = places.get(mode.id) or _member_node(mode, sheet)
        yield from _effect_problems(fmea, reach, mode, node, sheet)
        has_none = child(node, "symptoms") is node  # wrong ones have been told
        shows = links[mode.id] or mode.id in found
        if has_none and not mode.unobservable and not shows:
            what = "nothing shows it: give symptoms, or 'unobservable:' with the reason"
            yield node.problem(mode.name, what)


def _member_node(mode: FailureMode, sheet: Sheet) -> Node:
    robot, _, function = mode.component.partition(":")
    return child(sheet.root, "robots", robot, "functions", function)


def _effect_problems(
    fmea: Fmea, reach: _Reach, mode: FailureMode, node: Node, sheet: Sheet
) -> Iterator[Problem]:
    names = {*fmea.components, *sheet.names}
    reached = reach.all[mode.component]
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


def _effects(fmea: Fmea, reach: _Reach, mode: FailureMode) -> Effects:
    """Fill in what follows from needs: users next to it, and functions of the system."""
    stated = mode.effects
    if not mode.takes_down:
        return stated
    users = reach.next.get(mode.component, ())
    reached = reach.all[mode.component]
    system = tuple(name for name in fmea.system_functions() if name in reached)
    return Effects(stated.local, stated.next or users, stated.system or system)
