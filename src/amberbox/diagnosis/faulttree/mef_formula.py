"""Formulas and expressions of an Open-PSA file."""

from __future__ import annotations

import math
from typing import get_args

from amberbox.diagnosis.faulttree.expression import (
    FUNCTIONS,
    Call,
    Expression,
    MissionTime,
    Number,
    ParameterName,
    count_problem,
)
from amberbox.diagnosis.faulttree.formula import Constant, Formula, Name, Operation, Operator
from amberbox.diagnosis.faulttree.mef_scope import Path, Scope
from amberbox.diagnosis.faulttree.validity import operation_problem
from amberbox.diagnosis.faulttree.xmltext import Element

REFERENCES: dict[str, tuple[str, ...]] = {
    "gate": ("gate",),
    "basic-event": ("basic event",),
    "house-event": ("house event",),
    "event": ("gate", "basic event", "house event"),
}
_DESCRIBING = ("label", "attributes")
_BOOLEAN = {"true": True, "false": False}
_OPERATORS: dict[str, Operator] = {name: name for name in get_args(Operator)}
_NOTHING = Constant(False)  # stands for what cannot be read until the problems are reported
_ZERO = Number(0.0)


def content(element: Element) -> list[Element]:
    """Return what an element holds besides its description."""
    return [child for child in element.children if child.tag not in _DESCRIBING]


def formula(element: Element, path: Path, scope: Scope) -> Formula:
    """Read a formula; what is wrong with it goes to the problems of the scope."""
    if element.tag in REFERENCES:
        found = scope.find(element, path, REFERENCES[element.tag])
        return _NOTHING if found is None else Name(found.name)
    if element.tag == "constant":
        return Constant(boolean(element, scope))
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
    operation = Operation(operator, inputs, at_least, at_most)
    what = operation_problem(operation)
    if what:
        scope.fail(element, f"<{element.tag}>", what)
    return operation


def boolean(element: Element, scope: Scope) -> bool:
    """Read the value of a constant."""
    text = element.attributes.get("value", "")
    if text not in _BOOLEAN:
        scope.fail(element, f"<{element.tag}>", f"'{text}' is neither true nor false")
    return _BOOLEAN.get(text, False)


def expression(element: Element, path: Path, scope: Scope) -> Expression:
    """Read an expression; what is wrong with it goes to the problems of the scope."""
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
    return Call(tag, arguments)


def _count(element: Element, name: str, scope: Scope) -> int:
    text = element.attributes.get(name, "")
    if not (text.isascii() and text.isdigit()) or len(text) > 9:
        scope.fail(element, f"<{element.tag}>", f"{name}='{text}' is no whole number")
        return 0
    return int(text)


def _number(element: Element, scope: Scope) -> float:
    text = element.attributes.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        scope.fail(element, f"<{element.tag}>", f"'{text}' is no number")
        return 0.0
    return value
