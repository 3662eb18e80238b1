"""Fault trees out of Open-PSA Model Exchange Format files (XML, version 2.0d).

What would change the result and is not read here (common-cause groups, substitutions, includes,
event trees) is an error that names the line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath

from amberbox.core.config import did_you_mean, refuse
from amberbox.core.errors import Problem, UsageError
from amberbox.diagnosis.faulttree.expression import Expression, Number, parameter_names, value
from amberbox.diagnosis.faulttree.formula import Constant, Formula
from amberbox.diagnosis.faulttree.mef_formula import boolean, content, expression, formula
from amberbox.diagnosis.faulttree.mef_scope import (
    ID_ATTRIBUTE,
    KINDS,
    OTHER_FILES,
    Definition,
    Path,
    Scope,
    attribute,
)
from amberbox.diagnosis.faulttree.tree import (
    DEFAULT_MISSION_TIME_H,
    BasicEvent,
    FaultTree,
    Gate,
    Parameter,
    tops,
)
from amberbox.diagnosis.faulttree.validity import Places, cycle, path_back, problems
from amberbox.diagnosis.faulttree.xmltext import Element, parse

_CONTAINERS = ("define-fault-tree", "define-component")
_NOT_READ = {
    "include": "included files",
    "define-CCF-group": "common-cause groups",
    "define-substitution": "substitutions",
    "define-event-tree": "event trees",
    "define-initiating-event": "event trees",
    "define-initiating-event-group": "event trees",
    "define-sequence": "event trees",
    "define-rule": "event trees",
    "define-consequence": "event trees",
    "define-consequence-group": "event trees",
    "define-alignment": "mission phases",
    "define-extern-library": "external functions",
    "define-extern-function": "external functions",
}


def read_mef(
    path: FilePath | str | Sequence[FilePath | str],
    top: str = "",
    mission_time_h: float = DEFAULT_MISSION_TIME_H,
) -> FaultTree:
    """Read the fault tree of a file, or of several that name each other's gates and events.

    ``top`` is the gate to analyse; without, the one that no other gate uses. Raises
    ConfigurationError with the line of everything that is wrong, UsageError when there are
    several gates to choose from.
    """
    paths = [path] if isinstance(path, str | FilePath) else list(path)
    scope = Scope([])
    roots = [root for given in paths if (root := _root(str(given), scope.problems)) is not None]
    _refuse(scope)
    for root in roots:
        _collect(root, scope)
    tree = _tree(scope, roots, top, mission_time_h)
    _refuse(scope)
    return tree


def _root(file: str, problems: list[Problem]) -> Element | None:
    """Read one file; None and a problem if it is no Open-PSA file."""
    try:
        data = FilePath(file).read_bytes()
    except OSError as error:
        problems.append(Problem(file, 1, "file", f"cannot be read: {error.strerror}"))
        return None
    before = len(problems)
    root = parse(data, file, problems)
    if len(problems) == before and (root is None or root.tag != "opsa-mef"):
        line = root.line if root is not None else 1
        hint = "fault trees are read from Open-PSA MEF files"
        problems.append(Problem(file, line, "file", "does not begin with <opsa-mef>", hint))
    return root


def _refuse(scope: Scope) -> None:
    """Raise ConfigurationError with all problems, in the order of the files."""
    files = list(dict.fromkeys(problem.file for problem in scope.problems))
    refuse(sorted(scope.problems, key=lambda p: (files.index(p.file), p.line)))


def _collect(root: Element, scope: Scope) -> None:
    """Note all definitions of a file with the components around them."""
    waiting: list[tuple[Element, Path, bool]] = [(root, (), False)]
    while waiting:
        element, path, private = waiting.pop()
        allowed = _allowed(element.tag)
        for child in content(element):
            role = child.attributes.get("role", "private" if private else "public")
            if child.tag not in allowed:
                _unknown(child, element, scope)
            elif child.tag in KINDS:
                scope.define(child, path, role == "private")
            elif child.tag == "model-data":
                waiting.append((child, (), False))
            else:
                name = child.attributes.get("name", "")
                if not name:
                    scope.fail(child, f"<{child.tag}>", "has no name")
                waiting.append((child, (*path, name), role == "private"))


def _allowed(tag: str) -> tuple[str, ...]:
    if tag == "opsa-mef":
        return ("define-fault-tree", "model-data")
    return (*KINDS, "define-component") if tag in _CONTAINERS else tuple(KINDS)


def _unknown(element: Element, inside: Element, scope: Scope) -> None:
    if element.tag in _NOT_READ:
        what, hint = f"{_NOT_READ[element.tag]} are not supported", "write the gates out"
        hint = OTHER_FILES if element.tag == "include" else hint
    else:
        known = (*_allowed(inside.tag), "label", "attributes")
        what = f"unknown element in <{inside.tag}>"
        hint = did_you_mean(element.tag, known).removeprefix("; ")
    scope.fail(element, f"<{element.tag}>", what, hint)


def _tree(scope: Scope, roots: Sequence[Element], top: str, mission_time_h: float) -> FaultTree:
    gates = {entry.name: _gate(entry, scope) for entry in scope.of_kind("gate")}
    houses = {entry.name: _house(entry, scope) for entry in scope.of_kind("house event")}
    parameters = {entry.name: _parameter(entry, scope) for entry in scope.of_kind("parameter")}
    values = _values(parameters, scope, mission_time_h)
    events = {
        entry.name: _event(entry, scope, values, mission_time_h)
        for entry in scope.of_kind("basic event")
    }
    files = [root.file for root in roots]
    _check_gates(gates, files[0], scope)
    _refuse(scope)
    chosen = _top(gates, top, ", ".join(files))
    name = _tree_name(scope.known[False, chosen], roots)
    tree = FaultTree(name, chosen, gates, events, houses, parameters, mission_time_h)
    scope.problems += problems(tree, _places(scope))
    return tree


def _places(scope: Scope) -> Places:
    return Places(places={d.name: (d.element.file, d.element.line) for d in scope.by_path.values()})


def _gate(definition: Definition, scope: Scope) -> Gate:
    inside = content(definition.element)
    read: Formula = Constant(False)
    if not inside:
        scope.fail(definition.element, definition.name, "the gate has no input")
    elif len(inside) > 1:
        hint = "put <and> or <or> around them"
        scope.fail(inside[1], definition.name, "a gate has one formula only", hint)
    else:
        read = formula(inside[0], definition.path, scope)
    return Gate(definition.name, read, definition.label)


def _house(definition: Definition, scope: Scope) -> bool:
    inside = content(definition.element)
    if not inside:
        return False
    if len(inside) > 1 or inside[0].tag != "constant":
        scope.fail(inside[-1], definition.name, "a house event is a <constant>")
        return False
    return boolean(inside[0], scope)


def _parameter(definition: Definition, scope: Scope) -> Parameter:
    read = _one_expression(definition, scope)
    if read is None:
        scope.fail(definition.element, definition.name, "the parameter has no value")
        return Parameter(definition.name, Number(0.0))
    return Parameter(definition.name, read, definition.element.attributes.get("unit", ""))


def _one_expression(definition: Definition, scope: Scope) -> Expression | None:
    inside = content(definition.element)
    if len(inside) > 1:
        scope.fail(inside[1], definition.name, "there is more than one expression")
    return expression(inside[0], definition.path, scope) if inside else None


def _values(
    parameters: Mapping[str, Parameter], scope: Scope, mission_time_h: float
) -> dict[str, float]:
    """Compute the parameters, each after those it uses."""
    places = _places(scope)
    uses = {name: parameter_names([entry.expression]) for name, entry in parameters.items()}
    path = path_back(uses)
    if path:
        what = f"the parameter depends on itself: {' > '.join(path)}"
        scope.problems.append(places.problem(path[0], what))
        return dict.fromkeys(parameters, 0.0)
    values: dict[str, float] = {}
    waiting = list(parameters)
    while waiting:
        name = waiting[-1]
        missing = [used for used in uses[name] if used not in values]
        if missing:
            waiting += missing
            continue
        waiting.pop()
        if name not in values:
            values[name] = _value(parameters[name].expression, values, mission_time_h, scope, name)
    return values


def _value(
    entry: Expression,
    values: Mapping[str, float],
    mission_time_h: float,
    scope: Scope,
    name: str,
) -> float:
    try:
        return value(entry, values, mission_time_h)
    except (ArithmeticError, ValueError, TypeError) as error:
        scope.problems.append(_places(scope).problem(name, f"has no value: {error}"))
        return 0.0


def _event(
    definition: Definition, scope: Scope, values: Mapping[str, float], mission_time_h: float
) -> BasicEvent:
    read = _one_expression(definition, scope)
    if read is None:
        return BasicEvent(definition.name, None, definition.label)
    chance = _value(read, values, mission_time_h, scope, definition.name)
    if not 0.0 <= chance <= 1.0:
        what = f"the probability {chance:g} is not between 0 and 1"
        scope.fail(definition.element, definition.name, what)
    written = None if isinstance(read, Number) else read
    return BasicEvent(definition.name, chance, definition.label, written)


def _check_gates(gates: Mapping[str, Gate], file: str, scope: Scope) -> None:
    path = cycle(gates)
    if path:
        what = f"the gate depends on itself: {' > '.join(path)}"
        hint = "take one of these inputs out"
        scope.problems.append(_places(scope).problem(path[0], what, hint))
    elif not gates and not scope.problems:
        scope.problems.append(Problem(file, 1, "file", "defines no gate"))


def _top(gates: Mapping[str, Gate], wanted: str, file: str) -> str:
    if wanted:
        if wanted not in gates:
            raise UsageError(f"{file} has no gate '{wanted}'{did_you_mean(wanted, gates)}")
        return wanted
    found = tops(gates)
    if len(found) > 1:
        what = f"{file} has {len(found)} top events: {', '.join(sorted(found)[:10])}"
        raise UsageError(what, "choose one by its name (--effect NAME)")
    return found[0]


def _tree_name(definition: Definition, roots: Sequence[Element]) -> str:
    """Return the name of the fault tree that a gate stands in."""
    if not definition.path:
        return ""
    name = definition.path[0]
    trees = (tree for root in roots for tree in root.of_tag("define-fault-tree"))
    own = (attribute(tree, ID_ATTRIBUTE) for tree in trees if tree.attributes.get("name") == name)
    return next(filter(None, own), name)
