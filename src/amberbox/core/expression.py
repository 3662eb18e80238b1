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
from amberbox.core.expression_eval import Instants, Series, evaluate, rows_of, series_of
from amberbox.core.expression_instant import At, Look, Track, at_instant
from amberbox.core.expression_parse import parse_tree
from amberbox.core.expression_tree import (
    Address,
    Age,
    Fault,
    Kind,
    Tree,
    current_addresses,
    delays_ns,
    history_ns,
    kind_of,
    needs_history,
    shortest_ns,
    walk,
    with_addresses,
)
from amberbox.core.expression_values import KIND_OF_DTYPE, Values
from amberbox.core.samples import Samples
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
    tree: Tree = field(repr=False, hash=False)

    @classmethod
    def from_text(cls, text: str) -> Expression:
        """Read an expression; configuration classes use this for fields of this type."""
        return parse(text)

    def addresses(self) -> tuple[str, ...]:
        """Return the addresses it reads, in order, each once."""
        return self._names

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return tuple(address.name for address in self._reads)

    @cached_property
    def _reads(self) -> tuple[Address, ...]:
        found = (part for part in walk(self.tree) if isinstance(part, Address))
        return tuple({address.name: address for address in found}.values())

    @property
    def kind(self) -> Kind:
        """Tell what it gives: ``any`` if only the data can tell."""
        return kind_of(self.tree)

    @cached_property
    def needs_history(self) -> bool:
        """Tell whether it looks back in time (``for``, ``over``, ``age``)."""
        return needs_history(self.tree)

    @cached_property
    def history_ns(self) -> int:
        """How far it looks back: series must reach back this far, and one sample further."""
        return history_ns(self.tree)

    @property
    def shortest_ns(self) -> int | None:
        """The shortest time that it looks back by ``over`` or ``for``; None without."""
        return shortest_ns(self.tree)

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
            series = series_of(self._reads, {n: (now, [value]) for n, value in values.items()})
            return self._at_instant(self._tracks(series), 0, has_time=False)

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
        checked = {n: (_checked_times(t, f"'{n}'"), values) for n, (t, values) in series.items()}
        with _located(self.text):
            return self._value(self._tracks(series_of(self._reads, checked)), at_ns)

    def evaluate_samples(self, samples: Mapping[str, Samples], at_ns: int | IntArray) -> Any:
        """Return the same as ``evaluate_series`` from samples, which are in order of time.

        Every address must be among them.
        """
        with _located(self.text):
            return self._value([_track(a, samples[a.name]) for a in self._reads], at_ns)

    def numbers(
        self,
        samples: Mapping[str, Samples],
        at_ns: int | IntArray,
        windows: dict[str, Any] | None = None,
    ) -> Any:
        """Return the same as numbers, bools as 0 and 1: NaN where it is unknown.

        ``windows`` is filled with what windows give: expressions over the same samples at the
        same instants work out each once if they share it.
        """
        tracks = [_track(address, samples[address.name]) for address in self._reads]
        with _located(self.text):
            if np.ndim(at_ns) == 0:
                value = self._at_instant(tracks, int(at_ns), windows=windows)
                return np.float64(np.nan if value is None else value)
            values = self._at_instants(tracks, at_ns, windows)
        return np.where(values.null, np.nan, values.data.astype(np.float64))

    def _value(self, tracks: list[Track], at_ns: int | IntArray) -> Any:
        if np.ndim(at_ns) == 0:
            return self._at_instant(tracks, int(at_ns))
        return self._at_instants(tracks, at_ns).column()

    def _tracks(self, series: Mapping[str, Series]) -> list[Track]:
        return [_track_of(address, series[address.name]) for address in self._reads]

    def _at_instants(
        self, tracks: list[Track], at_ns: int | IntArray, windows: dict[str, Any] | None = None
    ) -> Values:
        series = {name: t.series() for name, t in zip(self._names, tracks, strict=True)}
        known = {} if windows is None else windows
        return evaluate(self.tree, Instants(series, np.asarray(at_ns, np.int64), windows=known))

    def _at_instant(
        self,
        tracks: list[Track],
        at_ns: int,
        has_time: bool = True,
        windows: dict[str, Any] | None = None,
    ) -> Value:
        look = Look(at_ns, dict(zip(self._names, tracks, strict=True)), has_time, windows)
        kinds = look.take(self._current)
        function = self._functions.get(kinds)
        if function is None:
            named = dict(zip(self._current, kinds, strict=True))
            function = self._functions[kinds] = at_instant(self.tree, named)
        with np.errstate(all="ignore"):
            return _python(function(look))

    @cached_property
    def _functions(self) -> dict[tuple[Kind, ...], At]:
        """What it is at one instant, by the kinds of what it reads there."""
        return {}

    @cached_property
    def _current(self) -> tuple[str, ...]:
        return current_addresses(self.tree)


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


def _track(address: Address, samples: Samples) -> Track:
    data, null = samples.values, samples.null
    kind = KIND_OF_DTYPE.get(data.dtype.kind)
    if not len(data) or (null is not None and null.all()):
        kind = "null"  # what is not known yet may become anything
    return Track(samples.times_ns, data, null, kind, address.at)


def _track_of(address: Address, series: Series) -> Track:
    values = series.values
    return Track(series.times_ns, values.data, values.null, values.kind, address.at)


def _checked_times(times_ns: IntArray, whose: str) -> IntArray:
    times_ns = np.asarray(times_ns, np.int64)
    if len(times_ns) > 1 and bool((times_ns[1:] < times_ns[:-1]).any()):
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
