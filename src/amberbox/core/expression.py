"""The one expression language: conditions and numbers over what the robot's variables say.

Triggers, monitors, FMEA conditions and gateways use it; ``docs/expressions.md`` describes it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.expression_eval import Instants, evaluate, rows_of, series_of
from amberbox.core.expression_parse import parse_tree
from amberbox.core.expression_tree import (
    Address,
    Age,
    Fault,
    Kind,
    Tree,
    delays_ns,
    history_ns,
    kind_of,
    needs_history,
    walk,
    with_addresses,
)
from amberbox.core.types import IntArray

Value: TypeAlias = bool | int | float | str | None


class ExpressionError(UsageError):
    """An expression that cannot be read or evaluated; ``column`` counts from 1."""

    def __init__(self, text: str, fault: Fault) -> None:
        line_start = text.rfind("\n", 0, fault.at) + 1
        line = text[line_start:].split("\n")[0]
        self.column = fault.at + 1
        picture = f"  {line}\n  {' ' * (fault.at - line_start)}^"
        super().__init__(f"expression, column {self.column}: {fault.what}\n{picture}", fault.hint)


@dataclass(frozen=True)
class Expression:
    """An expression that has been read; ``text`` is what was written."""

    text: str
    tree: Tree = field(repr=False)

    @classmethod
    def from_text(cls, text: str) -> Expression:
        """Read an expression; configuration classes use this for fields of this type."""
        return parse(text)

    def addresses(self) -> tuple[str, ...]:
        """Return the addresses it reads, in order, each once."""
        return tuple(address.name for address in self._reads)

    @cached_property
    def _reads(self) -> tuple[Address, ...]:
        found = (part for part in walk(self.tree) if isinstance(part, Address))
        return tuple({address.name: address for address in found}.values())

    @property
    def kind(self) -> Kind:
        """Tell what it gives: ``any`` if only the data can tell."""
        return kind_of(self.tree)

    @property
    def needs_history(self) -> bool:
        """Tell whether it looks back in time (``for``, ``over``, ``age``)."""
        return needs_history(self.tree)

    @property
    def history_ns(self) -> int:
        """How far it looks back: series must reach back this far, and one sample further."""
        return history_ns(self.tree)

    @property
    def reads_age(self) -> bool:
        """Tell whether it reads an age, which grows between samples."""
        return any(isinstance(part, Age) for part in walk(self.tree))

    def delays_ns(self) -> tuple[int, ...]:
        """Return how long after a sample its value may change: at once, and later by windows."""
        return tuple(sorted(delays_ns(self.tree)))

    def resolve(self, known: Collection[str]) -> Expression:
        """Replace short forms by the full addresses they stand for.

        A short form is the end of exactly one known address after ``.``, ``/``, ``#`` or ``:``.
        Raises ExpressionError for one that is unknown or ambiguous.
        """
        with _located(self.text):
            return replace(self, tree=with_addresses(self.tree, lambda a: _full(a, known)))

    def evaluate(self, values: Mapping[str, Any]) -> Value:
        """Return its value for current values by address; null is None.

        Raises ExpressionError if it needs history, lacks a value, or meets a wrong type.
        """
        now = np.zeros(1, np.int64)
        with _located(self.text):
            series = series_of(
                self._reads, {name: (now, [value]) for name, value in values.items()}
            )
            where = Instants(series, now, slice(0, 1), has_time=False)
            return _python(evaluate(self.tree, where).scalar(0))

    def evaluate_columns(self, times_ns: IntArray, columns: Mapping[str, Any]) -> NDArray[Any]:
        """Return its value for each row of columns that share their time stamps.

        ``times_ns`` must not decrease. The result is a masked array (bool or number), or an
        object array with None for text.
        """
        times_ns = _checked_times(times_ns, "the rows")
        with _located(self.text):
            series = series_of(self._reads, {name: (times_ns, c) for name, c in columns.items()})
            return evaluate(self.tree, rows_of(self.tree, series, times_ns)).column()

    def evaluate_series(
        self, series: Mapping[str, tuple[IntArray, Any]], at_ns: int | IntArray
    ) -> Any:
        """Return its value at an instant, or a column for many, from samples by address.

        Each address has its own ``(times_ns, values)``, times not decreasing; samples after an
        instant do not count for it. Replay and live therefore give the same answers.
        """
        instants = np.atleast_1d(np.asarray(at_ns, np.int64))
        checked = {n: (_checked_times(t, f"'{n}'"), values) for n, (t, values) in series.items()}
        with _located(self.text):
            where = Instants(series_of(self._reads, checked), instants)
            values = evaluate(self.tree, where)
        return _python(values.scalar(0)) if np.ndim(at_ns) == 0 else values.column()


def parse(text: str) -> Expression:
    """Read an expression; raise ExpressionError with the place of the first thing wrong."""
    with _located(text):
        return Expression(text, parse_tree(text))


@contextmanager
def _located(text: str) -> Iterator[None]:
    """Turn a fault into an error that shows the text and the place."""
    try:
        yield
    except Fault as fault:
        raise ExpressionError(text, fault) from None


def _python(value: Any) -> Value:
    result: Value = value
    return result


def _checked_times(times_ns: IntArray, whose: str) -> IntArray:
    times_ns = np.asarray(times_ns, np.int64)
    if len(times_ns) > 1 and bool((np.diff(times_ns) < 0).any()):
        raise UsageError(f"the times of {whose} are not in order", "sort the samples by time")
    return times_ns


def _full(address: Address, known: Collection[str]) -> Address:
    name, bracket, index = address.name.partition("[")
    if address.name in known or name in known:
        return address
    matches = sorted(
        full for full in known if full.endswith(name) and full[: -len(name)].endswith(tuple("./#:"))
    )
    if len(matches) == 1:
        return replace(address, name=matches[0] + bracket + index)
    if matches:
        raise Fault(f"'{name}' is ambiguous: {' or '.join(matches)}", address.at)
    what = f"there is no variable or output '{name}'{did_you_mean(name, known)}"
    raise Fault(what, address.at)
