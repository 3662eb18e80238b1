"""Options of a detector as a part of what it has learnt, so that a model file needs no other."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.yaml_nodes import parse_yaml

T = TypeVar("T")


def options_to_json(options: Any) -> dict[str, Any]:
    """Return a configuration as plain values; empty if all are the defaults."""
    if options == type(options)():
        return {}
    found: dict[str, Any] = _plain(dataclasses.asdict(options))
    return found


def options_from_json(cls: type[T], values: Any) -> T:
    """Return the configuration that ``options_to_json`` made plain.

    Raises ValueError, with all problems, if the values are not those of a configuration.
    """
    if values == {}:
        return cls()
    problems: list[Problem] = []
    node = parse_yaml(json.dumps(values, ensure_ascii=False), "options", problems)
    built = None if node is None else build(cls, node, problems)
    if built is None:
        raise ValueError("; ".join(f"{problem.where}: {problem.what}" for problem in problems))
    return built


@contextmanager
def only_value_errors() -> Iterator[None]:
    """Raise ValueError for what values of the wrong kind or size cause in a restoring block."""
    try:
        yield
    except (AttributeError, IndexError, ArithmeticError, AmberboxError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def _plain(value: Any) -> Any:
    """Return a value with lists for tuples, and infinities as YAML writes them."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    return value
