"""Read and write fault trees as Open-PSA model exchange files (MEF)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import get_args
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

from amberbox.core.config import raise_errors
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.diagnosis.faulttree.tree import (
    DEFAULT_MISSION_TIME_H,
    FUNCTIONS,
    BasicEvent,
    BooleanConstant,
    DefinitionLines,
    Expression,
    FaultTree,
    Formula,
    FunctionCall,
    Gate,
    GateOperation,
    MefParameter,
    MissionTime,
    Name,
    Number,
    Operator,
    ParameterName,
    count_problem,
    cycle,
    operation_problem,
    parameter_names,
    path_back,
    problems,
    tops,
    value,
)

_DEEPEST = 100


@dataclass(slots=True)
class MefElement:
    """An element of an XML file; ``text`` is its direct text."""

    tag: str
    attributes: Mapping[str, str]
    line: int
    children: list[MefElement] = field(default_factory=list)
    text: str = ""
    file: str = ""

    def of_tag(self, tag: str) -> Iterator[MefElement]:
        """Yield the elements of a kind directly inside."""
        return (child for child in self.children if child.tag == tag)


class _RefusedError(Exception):
    """Something that is well-formed and not read all the same."""


def parse(data: bytes, file: str, problems: list[Problem]) -> MefElement | None:
    """Return the root element; None and a problem if the text cannot be read."""
    builder = _Builder(expat.ParserCreate(), file)
    try:
        builder.parser.Parse(data, True)
    except expat.ExpatError as error:
        what = f"is no XML: {expat.errors.messages[error.code]}"
        problems.append(Problem(file, error.lineno, "syntax", what))
    except _RefusedError as error:
        problems.append(Problem(file, builder.parser.CurrentLineNumber, "syntax", str(error)))
    except (LookupError, ValueError) as error:  # an unknown encoding
        problems.append(Problem(file, 1, "syntax", str(error), "save it as UTF-8"))
    else:
        return builder.root
    return None


class _Builder:
    """Builds elements from the calls of the parser."""

    def __init__(self, parser: expat.XMLParserType, file: str) -> None:
        self.parser = parser
        self.file = file
        self.root: MefElement | None = None
        self.open: list[MefElement] = []
        parser.buffer_text = True
        parser.StartElementHandler = self.start
        parser.EndElementHandler = self.end
        parser.CharacterDataHandler = self.text
        parser.EntityDeclHandler = self.refuse
        parser.SkippedEntityHandler = self.refuse

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Open an element."""
        if len(self.open) >= _DEEPEST:
            raise _RefusedError(f"elements are nested deeper than {_DEEPEST}")
        element = MefElement(tag, attributes, self.parser.CurrentLineNumber, file=self.file)
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def end(self, tag: str) -> None:
        """Close an element."""
        self.open.pop()

    def text(self, text: str) -> None:
        """Add text to the element that is open."""
        self.open[-1].text += text

    def refuse(self, *what: object) -> None:
        """Refuse entities: they can grow without end and fetch files."""
        raise _RefusedError("entities are not allowed")


Path = tuple[str, ...]  # the fault tree and the components around an element

ID_ATTRIBUTE = "amberbox_id"  # attribute that keeps a name which the format does not allow

OTHER_FILES = "a model of several files is read when all are named: amberbox faulttree A.xml B.xml"

KINDS = {
    "define-gate": "gate",
    "define-basic-event": "basic event",
    "define-house-event": "house event",
    "define-parameter": "parameter",
}


@dataclass(frozen=True, slots=True)
class MefDefinition:
    """One gate, event or parameter: its element, and the name by which the tree knows it."""

    name: str
    kind: str
    element: MefElement
    path: Path

    @property
    def label(self) -> str:
        """Return its label."""
        return next((child.text.strip() for child in self.element.of_tag("label")), "")


@dataclass
class MefScope:
    """All definitions of a model by their full path, and the public ones by their bare name.

    Parameters (True) and events or gates (False) have separate names. ``known`` holds the name of
    each in the tree.
    """

    problems: list[Problem]
    by_path: dict[tuple[bool, Path], MefDefinition] = field(default_factory=dict)
    public: dict[tuple[bool, str], MefDefinition] = field(default_factory=dict)
    known: dict[tuple[bool, str], MefDefinition] = field(default_factory=dict)

    def define(self, element: MefElement, path: Path, private: bool) -> None:
        """Add a definition."""
        kind, name = KINDS[element.tag], element.attributes.get("name", "")
        if not name:
            self.fail(element, f"<{element.tag}>", "has no name")
            return
        plain = ".".join((*path, name)) if private else name
        known_as = attribute(element, ID_ATTRIBUTE) or plain
        definition = MefDefinition(known_as, kind, element, path)
        is_parameter = kind == "parameter"
        first = self.by_path.setdefault((is_parameter, (*path, name)), definition)
        first = first if first is not definition else self._first(definition, is_parameter)
        if not private and first is definition:
            first = self.public.setdefault((is_parameter, name), definition)
        if first is not definition:
            there = first.element
            place = "line " if there.file == element.file else f"{there.file}:"
            what = f"is defined twice, first in {place}{there.line}"
            self.fail(element, name, what)

    def of_kind(self, kind: str) -> Iterator[MefDefinition]:
        """Yield the definitions of a kind in the order of the file."""
        return (entry for entry in self.by_path.values() if entry.kind == kind)

    def find(self, element: MefElement, path: Path, kinds: tuple[str, ...]) -> MefDefinition | None:
        """Return the definition that an element refers to; None and a problem if there is none."""
        name = element.attributes.get("name", "")
        is_parameter = kinds == ("parameter",)
        found = self._lookup(is_parameter, name, path)
        if found is None:
            known = {entry for parameter, entry in self.public if parameter == is_parameter}
            hint = did_you_mean(name, known).removeprefix("; ") or OTHER_FILES
            self.fail(element, name or f"<{element.tag}>", f"no such {_either(kinds)}", hint)
        elif found.kind not in kinds:
            self.fail(element, name, f"is a {found.kind}, not a {_either(kinds)}")
            return None
        return found

    def fail(self, element: MefElement, where: str, what: str, hint: str = "") -> None:
        """Note a problem at an element."""
        self.problems.append(Problem(element.file, element.line, where, what, hint))

    def _first(self, definition: MefDefinition, is_parameter: bool) -> MefDefinition:
        return self.known.setdefault((is_parameter, definition.name), definition)

    def _lookup(self, is_parameter: bool, name: str, path: Path) -> MefDefinition | None:
        """Find a definition in the component itself, in those around it, then among public ones."""
        steps = tuple(name.split("."))
        for depth in range(len(path), -1, -1):
            for full in ((*path[:depth], name), (*path[:depth], *steps)):
                if (is_parameter, full) in self.by_path:
                    return self.by_path[is_parameter, full]
        return self.public.get((is_parameter, name))


def attribute(element: MefElement, name: str) -> str:
    """Return one of the ``attributes`` of an element; empty if it has no such one."""
    for entries in element.of_tag("attributes"):
        for entry in entries.of_tag("attribute"):
            if entry.attributes.get("name") == name:
                return entry.attributes.get("value", "")
    return ""


def _either(kinds: tuple[str, ...]) -> str:
    return " or ".join(kinds)


REFERENCES: dict[str, tuple[str, ...]] = {
    "gate": ("gate",),
    "basic-event": ("basic event",),
    "house-event": ("house event",),
    "event": ("gate", "basic event", "house event"),
}
_DESCRIBING = ("label", "attributes")
_BOOLEAN = {"true": True, "false": False}
_OPERATORS: dict[str, Operator] = {name: name for name in get_args(Operator)}
_NOTHING = BooleanConstant(False)  # stands for what cannot be read until the problems are reported
_ZERO = Number(0.0)


def content(element: MefElement) -> list[MefElement]:
    """Return the children of an element without its description."""
    return [child for child in element.children if child.tag not in _DESCRIBING]


def formula(element: MefElement, path: Path, scope: MefScope) -> Formula:
    """Read a formula; its errors are added to the problems of the scope."""
    if element.tag in REFERENCES:
        found = scope.find(element, path, REFERENCES[element.tag])
        return _NOTHING if found is None else Name(found.name)
    if element.tag == "constant":
        return BooleanConstant(boolean(element, scope))
    operator = _OPERATORS.get(element.tag)
    if operator is None:
        scope.fail(element, f"<{element.tag}>", "is no gate that is known")
        return _NOTHING
    inputs = tuple(formula(child, path, scope) for child in content(element))
    at_least, at_most = 0, 0
    if operator in ("atleast", "cardinality"):
        at_least = _count(element, "min", scope)
    if operator == "cardinality":
        at_most = _count(element, "max", scope)
    operation = GateOperation(operator, inputs, at_least, at_most)
    what = operation_problem(operation)
    if what:
        scope.fail(element, f"<{element.tag}>", what)
    return operation


def boolean(element: MefElement, scope: MefScope) -> bool:
    """Read the value of a constant."""
    text = element.attributes.get("value", "")
    if text not in _BOOLEAN:
        scope.fail(element, f"<{element.tag}>", f"'{text}' is neither true nor false")
    return _BOOLEAN.get(text, False)


def expression(element: MefElement, path: Path, scope: MefScope) -> Expression:
    """Read an expression; its errors are added to the problems of the scope."""
    tag = element.tag
    if tag in ("float", "int"):
        return Number(_number(element, scope))
    if tag == "bool":
        return Number(float(boolean(element, scope)))
    if tag == "parameter":
        found = scope.find(element, path, ("parameter",))
        return _ZERO if found is None else ParameterName(found.name)
    if tag == "system-mission-time":
        return MissionTime()
    if tag not in FUNCTIONS:
        scope.fail(element, f"<{tag}>", "is no expression that is known")
        return _ZERO
    arguments = tuple(expression(child, path, scope) for child in content(element))
    fewest, most, _ = FUNCTIONS[tag]
    what = count_problem(tag, len(arguments), fewest, most)
    if what:
        scope.fail(element, f"<{tag}>", what)
    return FunctionCall(tag, arguments)


def _count(element: MefElement, name: str, scope: MefScope) -> int:
    text = element.attributes.get(name, "")
    if not (text.isascii() and text.isdigit()) or len(text) > 9:
        scope.fail(element, f"<{element.tag}>", f"{name}='{text}' is no whole number")
        return 0
    return int(text)


def _number(element: MefElement, scope: MefScope) -> float:
    text = element.attributes.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        scope.fail(element, f"<{element.tag}>", f"'{text}' is no number")
        return 0.0
    return value


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
_NEEDED = {
    "included files": OTHER_FILES,
    "event trees": "write each sequence as a gate: <and> of the initiating event, as a basic event "
    "with a probability, of the gates of the branches that fail, and <not> of those that succeed; "
    "then choose it with --effect",
    "mission phases": "give the phase's time with --mission-time and set its house events",
}


def read_mef(
    path: FilePath | str | Sequence[FilePath | str],
    top: str = "",
    mission_time_h: float = DEFAULT_MISSION_TIME_H,
) -> FaultTree:
    """Read the fault tree of a file, or of several that refer to each other's gates and events.

    ``top`` is the gate to analyse; by default the one that no other gate uses. Raises
    ConfigurationError with the line of every error, UsageError when there are several gates to
    choose from.
    """
    paths = [path] if isinstance(path, str | FilePath) else list(path)
    model = _model(paths, mission_time_h)
    return model.tree(_top(model.gates, top, ", ".join(map(str, paths))))


def read_mef_trees(
    paths: Sequence[FilePath | str], mission_time_h: float = DEFAULT_MISSION_TIME_H
) -> list[FaultTree]:
    """Read files as one model and return a tree for each gate that no other gate uses.

    Raises ConfigurationError with the line of every error.
    """
    model = _model(paths, mission_time_h)
    return [model.tree(top) for top in tops(model.gates)]


def _root(file: str, problems: list[Problem]) -> MefElement | None:
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


def _refuse(scope: MefScope) -> None:
    """Raise ConfigurationError with all problems, in the order of the files."""
    files = list(dict.fromkeys(problem.file for problem in scope.problems))
    raise_errors(sorted(scope.problems, key=lambda p: (files.index(p.file), p.line)))


def _collect(root: MefElement, scope: MefScope) -> None:
    """Note all definitions of a file with the components around them."""
    waiting: list[tuple[MefElement, Path, bool]] = [(root, (), False)]
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


def _unknown(element: MefElement, inside: MefElement, scope: MefScope) -> None:
    if element.tag in _NOT_READ:
        what = f"{_NOT_READ[element.tag]} are not supported"
        hint = _NEEDED.get(_NOT_READ[element.tag], "write the gates out")
    else:
        known = (*_allowed(inside.tag), "label", "attributes")
        what = f"unknown element in <{inside.tag}>"
        hint = did_you_mean(element.tag, known).removeprefix("; ")
    scope.fail(element, f"<{element.tag}>", what, hint)


@dataclass(frozen=True)
class _Model:
    """What files define together; ``scope`` and ``roots`` are their elements."""

    scope: MefScope
    roots: Sequence[MefElement]
    gates: dict[str, Gate]
    events: dict[str, BasicEvent]
    houses: dict[str, bool]
    parameters: dict[str, MefParameter]
    mission_time_h: float

    def tree(self, top: str) -> FaultTree:
        """Return the tree below a gate; raises ConfigurationError with all its problems."""
        name = _tree_name(self.scope.known[False, top], self.roots)
        tree = FaultTree(
            name, top, self.gates, self.events, self.houses, self.parameters, self.mission_time_h
        )
        self.scope.problems += problems(tree, _places(self.scope))
        _refuse(self.scope)
        return tree


def _model(paths: Sequence[FilePath | str], mission_time_h: float) -> _Model:
    scope = MefScope([])
    roots = [root for given in paths if (root := _root(str(given), scope.problems)) is not None]
    _refuse(scope)
    for root in roots:
        _collect(root, scope)
    gates = {entry.name: _gate(entry, scope) for entry in scope.of_kind("gate")}
    houses = {entry.name: _house(entry, scope) for entry in scope.of_kind("house event")}
    parameters = {entry.name: _parameter(entry, scope) for entry in scope.of_kind("parameter")}
    values = _values(parameters, scope, mission_time_h)
    events = {
        entry.name: _event(entry, scope, values, mission_time_h)
        for entry in scope.of_kind("basic event")
    }
    path = cycle(gates)
    if path:
        what = f"the gate depends on itself: {' > '.join(path)}"
        hint = "take one of these inputs out"
        scope.problems.append(_places(scope).problem(path[0], what, hint))
    elif not gates and not scope.problems:
        scope.problems.append(Problem(roots[0].file, 1, "file", "defines no gate"))
    _refuse(scope)
    return _Model(scope, roots, gates, events, houses, parameters, mission_time_h)


def _places(scope: MefScope) -> DefinitionLines:
    return DefinitionLines(
        places={d.name: (d.element.file, d.element.line) for d in scope.by_path.values()}
    )


def _gate(definition: MefDefinition, scope: MefScope) -> Gate:
    inside = content(definition.element)
    read: Formula = BooleanConstant(False)
    if not inside:
        scope.fail(definition.element, definition.name, "the gate has no input")
    elif len(inside) > 1:
        hint = "put <and> or <or> around them"
        scope.fail(inside[1], definition.name, "a gate has one formula only", hint)
    else:
        read = formula(inside[0], definition.path, scope)
    return Gate(definition.name, read, definition.label)


def _house(definition: MefDefinition, scope: MefScope) -> bool:
    inside = content(definition.element)
    if not inside:
        return False
    if len(inside) > 1 or inside[0].tag != "constant":
        scope.fail(inside[-1], definition.name, "a house event is a <constant>")
        return False
    return boolean(inside[0], scope)


def _parameter(definition: MefDefinition, scope: MefScope) -> MefParameter:
    read = _one_expression(definition, scope)
    if read is None:
        scope.fail(definition.element, definition.name, "the parameter has no value")
        return MefParameter(definition.name, Number(0.0))
    return MefParameter(definition.name, read, definition.element.attributes.get("unit", ""))


def _one_expression(definition: MefDefinition, scope: MefScope) -> Expression | None:
    inside = content(definition.element)
    if len(inside) > 1:
        scope.fail(inside[1], definition.name, "there is more than one expression")
    return expression(inside[0], definition.path, scope) if inside else None


def _values(
    parameters: Mapping[str, MefParameter], scope: MefScope, mission_time_h: float
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
    scope: MefScope,
    name: str,
) -> float:
    try:
        return value(entry, values, mission_time_h)
    except (ArithmeticError, ValueError, TypeError) as error:
        scope.problems.append(_places(scope).problem(name, f"has no value: {error}"))
        return 0.0


def _event(
    definition: MefDefinition, scope: MefScope, values: Mapping[str, float], mission_time_h: float
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


def _tree_name(definition: MefDefinition, roots: Sequence[MefElement]) -> str:
    """Return the name of the fault tree that contains a gate."""
    if not definition.path:
        return ""
    name = definition.path[0]
    trees = (tree for root in roots for tree in root.of_tag("define-fault-tree"))
    own = (attribute(tree, ID_ATTRIBUTE) for tree in trees if tree.attributes.get("name") == name)
    return next(filter(None, own), name)


_ALLOWED = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(-[A-Za-z0-9_]+)*")
_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_Naming = Callable[[str], str]


def write_mef(tree: FaultTree) -> str:
    """Return the text of a file with a whole tree.

    Names that the format does not allow are changed; the original name is in an attribute, so that
    reading the file gives the same tree again.
    """
    naming = _names([*tree.gates, *tree.events, *tree.houses])
    parameters = _names(tree.parameters)
    name = tree.name or "fault_tree"
    of_tree = _names([name])
    return "\n".join(
        (
            '<?xml version="1.0" encoding="UTF-8"?>',
            "<opsa-mef>",
            f"  <define-fault-tree name={quoteattr(of_tree(name))}>",
            *_indented(_described(name, "", of_tree), 4),
            *_indented(_gates(tree, naming), 4),
            "  </define-fault-tree>",
            "  <model-data>",
            *_indented(_data(tree, naming, parameters), 4),
            "  </model-data>",
            "</opsa-mef>\n",
        )
    )


def _gates(tree: FaultTree, naming: _Naming) -> Iterator[str]:
    for gate in tree.gates.values():
        inside = [*_described(gate.name, gate.label, naming), *_formula(gate.formula, tree, naming)]
        yield from _element("define-gate", naming(gate.name), inside)


def _data(tree: FaultTree, naming: _Naming, parameters: _Naming) -> Iterator[str]:
    for event in tree.events.values():
        inside = [*_described(event.name, event.label, naming), *_chance(event, parameters)]
        yield from _element("define-basic-event", naming(event.name), inside)
    for name, switched_on in tree.houses.items():
        inside = [*_described(name, "", naming), _constant(switched_on)]
        yield from _element("define-house-event", naming(name), inside)
    for entry in tree.parameters.values():
        value = _expression(entry.expression, parameters)
        inside = [*_described(entry.name, "", parameters), *value]
        unit = f" unit={quoteattr(entry.unit)}" if entry.unit else ""
        yield from _element("define-parameter", parameters(entry.name), inside, unit)


def _element(tag: str, name: str, inside: Iterable[str], more: str = "") -> Iterator[str]:
    lines = list(inside)
    start = f"<{tag} name={quoteattr(name)}{more}"
    if not lines:
        yield f"{start}/>"
        return
    yield f"{start}>"
    yield from _indented(lines, 2)
    yield f"</{tag}>"


def _described(name: str, label: str, naming: _Naming) -> Iterator[str]:
    if label:
        yield f"<label>{escape(_NOT_IN_XML.sub(' ', label))}</label>"
    if naming(name) != name:
        yield "<attributes>"
        yield f"  <attribute name={quoteattr(ID_ATTRIBUTE)} value={quoteattr(name)}/>"
        yield "</attributes>"


def _formula(formula: Formula, tree: FaultTree, naming: _Naming) -> Iterator[str]:
    if isinstance(formula, BooleanConstant):
        yield _constant(formula.value)
    elif isinstance(formula, Name):
        name = formula.name
        kind = "gate" if name in tree.gates else "event"
        kind = "house-event" if name in tree.houses else kind
        kind = "basic-event" if name in tree.events else kind
        yield f"<{kind} name={quoteattr(naming(name))}/>"
    else:
        tag = formula.operator
        bounds = f' min="{formula.at_least}"' if tag in ("atleast", "cardinality") else ""
        bounds += f' max="{formula.at_most}"' if tag == "cardinality" else ""
        yield f"<{tag}{bounds}>"
        for entry in formula.inputs:
            yield from _indented(_formula(entry, tree, naming), 2)
        yield f"</{tag}>"


def _chance(event: BasicEvent, naming: _Naming) -> Iterator[str]:
    if event.expression is not None:
        yield from _expression(event.expression, naming)
    elif event.probability is not None:
        yield f'<float value="{event.probability!r}"/>'


def _expression(expression: Expression, naming: _Naming) -> Iterator[str]:
    if isinstance(expression, Number):
        yield f'<float value="{expression.value!r}"/>'
    elif isinstance(expression, ParameterName):
        yield f"<parameter name={quoteattr(naming(expression.name))}/>"
    elif isinstance(expression, MissionTime):
        yield "<system-mission-time/>"
    elif not expression.arguments:
        yield f"<{expression.function}/>"
    else:
        yield f"<{expression.function}>"
        for entry in expression.arguments:
            yield from _indented(_expression(entry, naming), 2)
        yield f"</{expression.function}>"


def _constant(value: bool) -> str:
    return f'<constant value="{str(value).lower()}"/>'


def _names(names: Iterable[str]) -> _Naming:
    """Return a function that makes names of the format; allowed names are not changed."""
    known = list(names)
    given = {name: name for name in known if _ALLOWED.fullmatch(name)}
    taken = set(given)
    for name in known:
        if name not in given:
            plain = re.sub(r"[^A-Za-z0-9_]+", "_", name) or "_"
            plain = plain if not plain[0].isdigit() else f"_{plain}"
            given[name] = _free(plain, taken)
            taken.add(given[name])
    return given.__getitem__


def _free(name: str, taken: set[str]) -> str:
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def _indented(lines: Iterable[str], blanks: int) -> Iterator[str]:
    return (" " * blanks + line for line in lines)
