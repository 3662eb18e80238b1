"""The one expression language: conditions and numbers over the robot's variables.

Triggers, monitors, FMEA conditions and gateways use it (``docs/reference/expressions.md``).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.expressions.evaluation import (
    At,
    Instants,
    InstantView,
    Series,
    Track,
    WindowCache,
    at_instant,
    evaluate,
    rows_of,
    series_of,
)
from amberbox.core.expressions.parser import parse_tree
from amberbox.core.expressions.tree import (
    AddressNode,
    AgeNode,
    ArithmeticNode,
    CallNode,
    ComparisonNode,
    ConstantNode,
    ExpressionFault,
    ExpressionNode,
    HeldNode,
    Kind,
    LogicNode,
    NegativeNode,
    NotNode,
    WindowNode,
    current_addresses,
    delays_ns,
    history_ns,
    kind_of,
    needs_history,
    shortest_ns,
    walk,
    with_addresses,
)
from amberbox.core.expressions.values import KIND_OF_DTYPE, Values
from amberbox.core.samples import Samples
from amberbox.core.types import IntArray

Value: TypeAlias = bool | int | float | str | None


class ExpressionError(UsageError):
    """An expression that cannot be read or evaluated; ``column`` counts from 1."""

    def __init__(self, text: str, fault: ExpressionFault) -> None:
        line_start = text.rfind("\n", 0, fault.at) + 1
        line = text[line_start:].split("\n")[0]
        self.column = fault.at + 1
        picture = f"  {line}\n  {' ' * (fault.at - line_start)}^"
        super().__init__(f"expression, column {self.column}: {fault.what}\n{picture}", fault.hint)


@dataclass(frozen=True)
class Expression:
    """A parsed expression; ``text`` is its source."""

    text: str
    tree: ExpressionNode = field(repr=False, hash=False)

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
    def _reads(self) -> tuple[AddressNode, ...]:
        found = (part for part in walk(self.tree) if isinstance(part, AddressNode))
        return tuple({address.name: address for address in found}.values())

    @property
    def kind(self) -> Kind:
        """Return the kind of its value: ``any`` if it depends on the data."""
        return kind_of(self.tree)

    @cached_property
    def needs_history(self) -> bool:
        """Return whether it looks back in time (``for``, ``over``, ``age``)."""
        return needs_history(self.tree)

    @cached_property
    def history_ns(self) -> int:
        """Return how far it looks back in nanoseconds: series need this and one more sample."""
        return history_ns(self.tree)

    @property
    def shortest_ns(self) -> int | None:
        """Return the shortest ``over`` or ``for`` in it, nanoseconds; None without."""
        return shortest_ns(self.tree)

    @property
    def reads_age(self) -> bool:
        """Return whether it reads an age, which grows between samples."""
        return any(isinstance(part, AgeNode) for part in walk(self.tree))

    def delays_ns(self) -> tuple[int, ...]:
        """Return how long (ns) after a sample its value may change: 0, and later by windows."""
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
            for part in walk(self.tree) if self.needs_history else ():
                if isinstance(part, WindowNode | HeldNode | AgeNode):
                    what = "needs the past, only current values are known here"
                    raise ExpressionFault(what, part.at)
            return self._at_instant(self._tracks(series), 0)

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
        windows: WindowCache | None = None,
    ) -> Any:
        """Return the same as numbers, bools as 0 and 1: NaN where it is unknown.

        ``windows`` caches the results of windows: expressions over the same samples at the same
        instants that share it compute each window once.
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
        self, tracks: list[Track], at_ns: int | IntArray, windows: WindowCache | None = None
    ) -> Values:
        series = {name: t.series() for name, t in zip(self._names, tracks, strict=True)}
        known = WindowCache() if windows is None else windows
        return evaluate(self.tree, Instants(series, np.asarray(at_ns, np.int64), windows=known))

    def _at_instant(
        self,
        tracks: list[Track],
        at_ns: int,
        windows: WindowCache | None = None,
    ) -> Value:
        view = InstantView(at_ns, dict(zip(self._names, tracks, strict=True)), windows)
        kinds = view.take(self._current)
        function = self._functions.get(kinds)
        if function is None:
            named = dict(zip(self._current, kinds, strict=True))
            function = self._functions[kinds] = at_instant(self.tree, named)
        with np.errstate(all="ignore"):
            result: Value = function(view)
            return result

    @cached_property
    def _functions(self) -> dict[tuple[Kind, ...], At]:
        """Return a cache: its function at one instant, by the kinds of the values that it reads."""
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
    except ExpressionFault as fault:
        raise ExpressionError(text, fault) from None


def _track(address: AddressNode, samples: Samples) -> Track:
    data, null = samples.values, samples.null
    kind = KIND_OF_DTYPE.get(data.dtype.kind)
    if not len(data) or (null is not None and null.all()):
        kind = "null"  # a value not known yet may be of any kind
    return Track(samples.times_ns, data, null, kind, address.at)


def _track_of(address: AddressNode, series: Series) -> Track:
    values = series.values
    return Track(series.times_ns, values.data, values.null, values.kind, address.at)


def _checked_times(times_ns: IntArray, whose: str) -> IntArray:
    times_ns = np.asarray(times_ns, np.int64)
    if len(times_ns) > 1 and bool((times_ns[1:] < times_ns[:-1]).any()):
        raise UsageError(f"the times of {whose} are not in order", "sort the samples by time")
    return times_ns


def _full(address: AddressNode, known: Collection[str]) -> AddressNode:
    name, bracket, index = address.name.partition("[")
    if address.name in known or name in known:
        return address
    matches = sorted(
        full for full in known if full.endswith(name) and full[: -len(name)].endswith(tuple("./#:"))
    )
    if len(matches) == 1:
        return replace(address, name=matches[0] + bracket + index)
    if matches:
        raise ExpressionFault(f"'{name}' is ambiguous: {' or '.join(matches)}", address.at)
    what = f"there is no variable or output '{name}'{did_you_mean(name, known)}"
    raise ExpressionFault(what, address.at)


MOST_TERMS: Final = 2  # in the reason of a condition
_LONGEST: Final = 90  # characters of a comparison that people still read
_NOT: Final = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "=="}
_TURNED: Final = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_WORDS: Final = {
    "<": "below", "<=": "at most", ">": "above", ">=": "at least",
    "==": "expected", "!=": "expected other than",
}  # fmt: skip


def reason(
    expression: Expression, samples: Mapping[str, Samples], now_ns: int, *, expected: bool
) -> str:
    """Return the terms that make a condition other than expected; empty if too long to read.

    ``expected`` is the value that it should have. ``sim_battery.current < 0.3`` that is expected
    and does not hold gives ``current is 0.52, below 0.3``.
    """
    terms = dict.fromkeys(_Values(samples, now_ns).terms(expression.tree, expected))
    text = "; ".join(list(terms)[:MOST_TERMS])
    return text if len(text) <= MOST_TERMS * _LONGEST else ""


def number_text(value: float) -> str:
    """Return a number as text that can be compared with a limit."""
    return f"{value:.4g}"


def variable_text(address: str) -> str:
    """Return a variable's own name without its item: ``cell voltage[3]``."""
    return address.rpartition("/")[2].partition(".")[2].replace("_", " ").strip() or address


class _Values:
    """The values of terms at an instant, as text."""

    def __init__(self, samples: Mapping[str, Samples], now_ns: int) -> None:
        self._samples = samples
        self._now_ns = now_ns

    def terms(self, tree: ExpressionNode, expected: bool) -> Iterator[str]:
        """Yield the terms that make a part other than expected."""
        if isinstance(tree, NotNode):
            yield from self.terms(tree.inner, not expected)
        elif isinstance(tree, HeldNode):
            yield from self.terms(tree.inner, expected)
        elif isinstance(tree, LogicNode):
            for part in self._to_blame(tree, expected):
                yield from self.terms(part, expected)
        elif isinstance(tree, ComparisonNode):
            yield from self._compared(tree, expected)
        elif isinstance(tree, AddressNode):
            yield f"{variable_text(tree.name)} is {'false' if expected else 'true'}"

    def _to_blame(self, tree: LogicNode, expected: bool) -> Iterable[ExpressionNode]:
        """Return the parts that are other than expected, without guards that only count samples."""
        wrong = [part for part in tree.operands if self._number(part) == float(not expected)]
        return [part for part in wrong if not _is_guard(part)] or wrong

    def _compared(self, tree: ComparisonNode, expected: bool) -> Iterator[str]:
        for operator, (left, right) in zip(tree.operators, pairwise(tree.operands), strict=True):
            pair = ComparisonNode(tree.at, (operator,), (left, right))
            if self._number(pair) != float(not expected):
                continue
            allowed = operator if expected else _NOT[operator]
            if isinstance(left, ConstantNode):
                left, right, allowed = right, left, _TURNED[allowed]
            yield f"{_words(left)} is {self._shown(left)}, {_WORDS[allowed]} {self._limit(right)}"

    def _limit(self, tree: ExpressionNode) -> str:
        if isinstance(tree, ConstantNode):
            return _constant(tree.value)
        return f"{self._shown(tree)} ({_words(tree)})"

    def _shown(self, tree: ExpressionNode) -> str:
        if isinstance(tree, AddressNode):
            return _constant(self._samples[tree.name].at(self._now_ns))
        return number_text(self._number(tree))

    def _number(self, tree: ExpressionNode) -> float:
        """Return a part as a number; NaN where it is unknown, or no number."""
        try:
            return float(Expression("", tree).numbers(self._samples, self._now_ns))
        except (ExpressionError, ValueError, TypeError):
            return float("nan")


def _is_guard(tree: ExpressionNode) -> bool:
    """Return whether a part only checks that there are enough samples."""
    operands = tree.operands if isinstance(tree, ComparisonNode) else ()
    return any(isinstance(part, WindowNode) and part.name == "count" for part in operands)


def _constant(value: Any) -> str:
    if hasattr(value, "item"):
        value = value.item()
    if value is None or isinstance(value, bool):
        return {True: "true", False: "false", None: "unknown"}[value]
    return number_text(value) if isinstance(value, int | float) else f"'{value}'"


def _words(tree: ExpressionNode) -> str:
    """Return a part in plain words; parts without a short form are ``the condition``."""
    if isinstance(tree, ConstantNode):
        return _constant(tree.value)
    if isinstance(tree, AddressNode):
        return variable_text(tree.name)
    if isinstance(tree, AgeNode):
        return f"the age of {_words(tree.inner)}"
    if isinstance(tree, WindowNode):
        return f"the {tree.name} of {_words(tree.inner)} over {tree.over_ns / 1e9:g} s"
    if isinstance(tree, NegativeNode):
        return f"-{_words(tree.inner)}"
    if isinstance(tree, ArithmeticNode):
        return f"{_words(tree.left)} {tree.operator} {_words(tree.right)}"
    if isinstance(tree, CallNode):
        shown = [_words(part) for part in tree.arguments[:1]]
        return f"{tree.name}({', '.join([*shown, *(['...'] if len(tree.arguments) > 1 else [])])})"
    return "the condition"
