"""Forms of a person's steps: the values that a person has entered, judged by their fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.expression import Value
from amberbox.core.safe_text import escape_hidden
from amberbox.experiments.experiment import FieldOptions

_LARGEST = 1e300
LONGEST_TEXT = 2000  # characters of an answer, a deviation or a note


def check_form(fields: Mapping[str, FieldOptions], given: Mapping[str, Any]) -> dict[str, Value]:
    """Return the values of all fields of a form; null is a step skipped or a field left empty.

    Raises UsageError that names everything that is wrong.
    """
    values: dict[str, Value] = {}
    wrong = [
        f"there is no field '{escape_hidden(str(key))[:64]}'{did_you_mean(str(key), fields)}"
        for key in list(given)[: len(fields) + 5]
        if key not in fields
    ]
    for name, field in fields.items():
        try:
            values[name] = _accepted(field, name in given, given.get(name))
        except ValueError as error:
            wrong.append(f"{field.label or name}: {error}")
    if wrong:
        names = ", ".join(fields) or "none"
        raise UsageError("; ".join(wrong), f"fields of this step: {names}")
    return values


def _accepted(field: FieldOptions, is_given: bool, value: Any) -> Value:
    if value is None:
        is_skipped = is_given and field.kind == "pass_fail"
        if field.required and not is_skipped:
            raise ValueError("is missing")
        return None
    if field.kind == "pass_fail":
        return _one_of(value, (True, False), "is neither pass, fail nor skipped")
    if field.kind == "confirm":
        return _one_of(value, (True,), "is not confirmed")
    if field.kind == "number":
        return _number(field, value)
    if field.kind == "choice":
        return _one_of(value, field.choices, f"is none of {', '.join(field.choices)}")
    if not isinstance(value, str):
        raise ValueError("is no text")
    if len(value) > LONGEST_TEXT:
        raise ValueError(f"has more than {LONGEST_TEXT} characters")
    if field.required and not value.strip():
        raise ValueError("is missing")
    return escape_hidden(value)


def _one_of(value: Any, allowed: Any, otherwise: str) -> Value:
    """Return a value if it is among those allowed, and of their type: 1 is not true."""
    for one in allowed:
        if type(one) is type(value) and one == value:
            found: Value = one
            return found
    raise ValueError(otherwise)


def _number(field: FieldOptions, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("is no number")
    if not -_LARGEST <= value <= _LARGEST:
        raise ValueError("is too large, or no number")
    unit = f" {field.unit}" if field.unit else ""
    if field.min is not None and value < field.min:
        raise ValueError(f"{value:g} is below the least value, {field.min:g}{unit}")
    if field.max is not None and value > field.max:
        raise ValueError(f"{value:g} is above the largest value, {field.max:g}{unit}")
    return float(value)
