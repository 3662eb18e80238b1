"""Fault trees as Open-PSA Model Exchange Format, for other tools."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from xml.sax.saxutils import escape, quoteattr

from amberbox.diagnosis.faulttree.expression import Expression, MissionTime, Number, ParameterName
from amberbox.diagnosis.faulttree.formula import Constant, Formula, Name
from amberbox.diagnosis.faulttree.mef_scope import ID_ATTRIBUTE
from amberbox.diagnosis.faulttree.tree import BasicEvent, FaultTree

_ALLOWED = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(-[A-Za-z0-9_]+)*")
_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_Naming = Callable[[str], str]


def write_mef(tree: FaultTree) -> str:
    """Return the text of a file with all of a tree.

    Names that the format does not allow are changed; the own name stands in an attribute, so
    that reading the file gives the same tree again.
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
    if isinstance(formula, Constant):
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
    """Return a function that makes names of the format; allowed ones stay as they are."""
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
