"""Expressions at one instant, as live monitors ask: the same answers as for many, without arrays.

A tree becomes functions of what is known at the instant, once for each combination of the kinds
of its variables, so that a value of the wrong kind is found before anything is computed. What
lies in windows is computed by ``expression_eval``, over the samples of the window alone.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, reduce
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from amberbox.core import expression_values as on
from amberbox.core.expression_eval import Instants, Series, counted, known_numbers, value_of
from amberbox.core.expression_tree import (
    Address,
    Age,
    Arithmetic,
    Call,
    Comparison,
    Constant,
    Fault,
    Held,
    Kind,
    Logic,
    Negative,
    Not,
    Tree,
    Window,
    kind_of_value,
)
from amberbox.core.expression_windows import reduce_whole
from amberbox.core.types import IntArray

Kinds: TypeAlias = Mapping[str, Kind]


class Track(NamedTuple):
    """Samples of one variable as they are held; ``times_ns`` never decreases."""

    times_ns: IntArray
    data: on.Array
    null: on.Mask | None
    kind: Kind | None
    """None where each value says what it is."""
    at: int
    """The place of its address in the text."""

    def part(self, rows: slice) -> on.Values:
        """Return some of the values as those of many instants."""
        null = None if self.null is None else self.null[rows]
        return on.values_of_array(self.data[rows], null, self.kind, self.at)

    def series(self) -> Series:
        """Return all of them as those of many instants."""
        return Series(self.times_ns, self.part(slice(None)))

    def value(self, at_ns: int) -> tuple[Any, Kind]:
        """Return the last value by an instant as plain Python, None for null, and its kind."""
        last = int(self.times_ns.searchsorted(at_ns, "right")) - 1
        unknown = last < 0 or (self.null is not None and self.null[last])
        value = None if unknown else self.data.item(last)
        if self.kind is None and value is not None:
            return on.plain(value, self.at)
        return value, self.kind or "null"


class Look:
    """What an expression looks at: an instant of time, and tracks by address."""

    def __init__(
        self,
        at_ns: int,
        tracks: Mapping[str, Track],
        has_time: bool = True,
        windows: dict[str, Any] | None = None,
    ) -> None:
        self.at_ns = at_ns
        self.tracks = tracks
        self.has_time = has_time
        self.windows = {} if windows is None else windows
        """Values of windows at the instant, each worked out once; by what they say."""
        self.values: dict[str, Any] = {}

    @cached_property
    def whole(self) -> Instants:
        """The instant as ``expression_eval`` takes it, over all samples."""
        series = {name: track.series() for name, track in self.tracks.items()}
        return Instants(series, np.array([self.at_ns], np.int64), has_time=self.has_time)

    def take(self, names: Sequence[str]) -> tuple[Kind, ...]:
        """Look up what variables are now; return their kinds."""
        found = [self.tracks[name].value(self.at_ns) for name in names]
        self.values = {name: value for name, (value, _) in zip(names, found, strict=True)}
        return tuple([kind for _, kind in found])


At: TypeAlias = Callable[[Look], Any]
"""What a part is at an instant: plain Python, None for null."""


def at_instant(tree: Tree, kinds: Kinds) -> At:
    """Return the function that a tree is; raise Fault where a variable's kind does not fit."""
    return _BUILD[type(tree)](tree, kinds)[0]


def _built(tree: Tree, kinds: Kinds) -> tuple[At, Kind]:
    return _BUILD[type(tree)](tree, kinds)


def _number(tree: Tree, kinds: Kinds, wanted_by: str) -> At:
    """Return a part as a float."""
    at, kind = _built(tree, kinds)
    on.require_number(kind, wanted_by, tree.at)
    if isinstance(tree, Constant) and tree.value is not None:
        number = float(tree.value)
        return lambda look: number

    def as_float(look: Look) -> float | None:
        value = at(look)
        return None if value is None else float(value)

    return as_float


def _condition(tree: Tree, kinds: Kinds, wanted_by: str) -> At:
    at, kind = _built(tree, kinds)
    on.require_condition(kind, wanted_by, tree.at)
    return at


def _constant(tree: Constant, kinds: Kinds) -> tuple[At, Kind]:
    value = tree.value
    return lambda look: value, kind_of_value(value)


def _address(tree: Address, kinds: Kinds) -> tuple[At, Kind]:
    name = tree.name
    return lambda look: look.values[name], kinds[name]


def _negative(tree: Negative, kinds: Kinds) -> tuple[At, Kind]:
    return _of_known(operator.neg, _number(tree.inner, kinds, "'-'")), "number"


def _arithmetic(tree: Arithmetic, kinds: Kinds) -> tuple[At, Kind]:
    sign = tree.operator
    sides = [_number(part, kinds, f"'{sign}'") for part in (tree.left, tree.right)]
    return _of_known(_ARITHMETIC[sign], *sides), "number"


def _comparison(tree: Comparison, kinds: Kinds) -> tuple[At, Kind]:
    sides = [_built(operand, kinds) for operand in tree.operands]
    pairs = [
        _pair(sign, left, right, tree.at)
        for sign, left, right in zip(tree.operators, sides, sides[1:], strict=False)
    ]
    return (pairs[0] if len(pairs) == 1 else _joined(False, pairs)), "condition"


def _pair(sign: str, left: tuple[At, Kind], right: tuple[At, Kind], at: int) -> At:
    """Compare as ``expression_values.compare`` does: whole numbers exactly, others as floats."""
    on.require_comparable(sign, left[1], right[1], at)
    compare = on.COMPARE[sign]

    def compared(a: Any, b: Any) -> bool:
        mixed = type(a) is not type(b) and not isinstance(a, str)
        return bool(compare(float(a), float(b)) if mixed else compare(a, b))

    return _of_known(compared, left[0], right[0])


def _not(tree: Not, kinds: Kinds) -> tuple[At, Kind]:
    return _of_known(operator.not_, _condition(tree.inner, kinds, "'not'")), "condition"


def _logic(tree: Logic, kinds: Kinds) -> tuple[At, Kind]:
    word = tree.operator
    parts = [_condition(part, kinds, f"'{word}'") for part in tree.operands]
    return _joined(word == "or", parts), "condition"


def _joined(decisive: bool, parts: Sequence[At]) -> At:
    def joined(look: Look) -> bool | None:
        values = [part(look) for part in parts]
        if decisive in values:
            return decisive
        return None if None in values else not decisive

    return joined


def _call(tree: Call, kinds: Kinds) -> tuple[At, Kind]:
    if tree.name == "known":
        inner, _ = _built(tree.arguments[0], kinds)
        return lambda look: inner(look) is not None, "condition"
    arguments = [_number(part, kinds, tree.name) for part in tree.arguments]
    kind: Kind = "condition" if tree.name == "bit" else "number"
    return _of_known(_CALLS[tree.name], *arguments), kind


def _of_known(function: Callable[..., Any], *parts: At) -> At:
    """Apply a function where all parts are known; it may say None itself."""
    if len(parts) == 1:
        (only,) = parts

        def of_one(look: Look) -> Any:
            value = only(look)
            return None if value is None else function(value)

        return of_one

    def of_all(look: Look) -> Any:
        values = [part(look) for part in parts]
        return None if None in values else function(*values)

    return of_all


def _age(tree: Age, kinds: Kinds) -> tuple[At, Kind]:
    def age_s(look: Look) -> float | None:
        _require_time(tree, look)
        times_ns, data, null, kind, _ = look.tracks[tree.inner.name]
        last = int(times_ns.searchsorted(look.at_ns, "right")) - 1
        if null is None and kind is None:
            null = np.array([value is None for value in data[: last + 1]], bool)
        while last >= 0 and null is not None and null[last]:
            last -= 1
        return (look.at_ns - int(times_ns[last])) / 1e9 if last >= 0 else None

    return age_s, "number"


def _window(tree: Window, kinds: Kinds) -> tuple[At, Kind]:
    def window(look: Look) -> Any:
        _require_time(tree, look)
        if tree.saying not in look.windows:
            look.windows[tree.saying] = worked_out(look)
        return look.windows[tree.saying]

    def worked_out(look: Look) -> Any:
        clock = None if tree.is_nested else _one_clock([look.tracks[name] for name in tree.reads])
        if clock is None:
            return value_of(tree, look.whole).scalar(0)
        first = int(clock.searchsorted(look.at_ns - tree.over_ns, "right"))
        rows = slice(first, int(clock.searchsorted(look.at_ns, "right")))
        times_ns = clock[rows]
        looked_up = {name: look.tracks[name].part(rows) for name in tree.reads}
        inside = Instants({}, times_ns, looked_up=looked_up)
        return _reduced(tree, times_ns, value_of(tree.inner, inside))

    return window, "number"


def _reduced(tree: Window, times_ns: IntArray, values: on.Values) -> float | None:
    if tree.name == "count":
        return int(np.count_nonzero(counted(values)))
    return reduce_whole(tree.name, *known_numbers(tree, times_ns, values))


def _one_clock(tracks: Sequence[Track]) -> IntArray | None:
    """Return the times of tracks if they share them."""
    if not tracks:
        return None
    clock = tracks[0].times_ns
    content = clock.tobytes() if len(tracks) > 1 else b""
    others = (track.times_ns for track in tracks[1:])
    same = all(len(one) == len(clock) and one.tobytes() == content for one in others)
    return clock if same else None


def _held(tree: Held, kinds: Kinds) -> tuple[At, Kind]:
    now = _condition(tree.inner, kinds, "'for'")

    def held(look: Look) -> Any:
        _require_time(tree, look)
        return False if now(look) is False else value_of(tree, look.whole).scalar(0)

    return held, "condition"


def _require_time(tree: Tree, look: Look) -> None:
    if not look.has_time:
        raise Fault("needs the past, only current values are known here", tree.at)


def _divide(a: float, b: float) -> float:
    """Divide as IEEE 754 says."""
    if b:
        return a / b
    return math.nan if not a or a != a else math.copysign(math.inf, a) * math.copysign(1.0, b)


def _bit(word: float, number: float) -> bool | None:
    if not (abs(word) < 2.0**53 and 0 <= number < 53 and word.is_integer() and number.is_integer()):
        return None
    return bool(int(word) >> int(number) & 1)


def _float_of(function: np.ufunc) -> Callable[..., float]:
    """Leave to numpy what differs between libraries in the last digit, or by the sign of 0."""
    return lambda *numbers: float(reduce(function, numbers) if numbers[1:] else function(*numbers))


_ARITHMETIC: dict[str, Callable[[float, float], float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _divide,
    "%": lambda a, b: a % b if b else math.nan,
}
_CALLS: dict[str, Callable[..., Any]] = {
    "abs": abs,
    "sqrt": lambda a: math.sqrt(a) if a >= 0 else math.nan,
    "sin": _float_of(np.sin),
    "cos": _float_of(np.cos),
    "atan2": _float_of(np.arctan2),
    "min": _float_of(np.minimum),
    "max": _float_of(np.maximum),
    "median": lambda *numbers: float(on.median(*numbers)),
    "bit": _bit,
}
_BUILD: dict[type[Tree], Callable[[Any, Kinds], tuple[At, Kind]]] = {
    Constant: _constant,
    Address: _address,
    Negative: _negative,
    Arithmetic: _arithmetic,
    Comparison: _comparison,
    Not: _not,
    Logic: _logic,
    Call: _call,
    Age: _age,
    Window: _window,
    Held: _held,
}
