"""Values of many instants at once, null known apart: arithmetic, functions, sliding windows."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.expressions.tree import ExpressionFault, Kind, kind_of_value
from amberbox.core.types import IntArray, Ragged

Array: TypeAlias = NDArray[Any]
Mask: TypeAlias = NDArray[np.bool_]

# by kind of dtype; others hold objects
KIND_OF_DTYPE: dict[str, Kind] = {"b": "condition", "i": "number", "u": "number", "f": "number"}
_NAMES: dict[Kind, str] = {"text": "text", "number": "a number", "condition": "a condition"}


@dataclass(slots=True, eq=False)  # not frozen: every part of an expression makes one
class Values:
    """One value per instant; ``data`` means nothing where ``null`` is true."""

    data: Array
    null: Mask
    kind: Kind

    def __len__(self) -> int:
        return len(self.data)

    def at(self, rows: Any) -> Values:
        """Take some of the rows."""
        return Values(self.data[rows], self.null[rows], self.kind)

    def column(self) -> Array:
        """Return a masked array, or an object array with None for texts and unknown values."""
        if self.kind in ("number", "condition"):
            return np.ma.MaskedArray(self.data, self.null)
        column = self.data.astype(object)
        column[self.null] = None
        return column

    def scalar(self, row: int) -> Any:
        """Return one value as plain Python, None for null."""
        if self.null[row]:
            return None
        value = self.data[row]
        return value.item() if isinstance(value, np.generic) else value


def values_of(column: Any, at: int) -> Values:
    """Convert a column of a batch or query; a list may be given instead of an array."""
    if isinstance(column, Ragged):
        raise ExpressionFault("is a list; name one element of it", at, "such as: ranges[17]")
    array = column if isinstance(column, np.ndarray) else _object_array(column)
    null = np.ma.getmaskarray(array) if isinstance(array, np.ma.MaskedArray) else None
    data = np.asarray(np.ma.getdata(array))
    return values_of_array(data, null, KIND_OF_DTYPE.get(data.dtype.kind), at)


def values_of_array(data: Array, null: Mask | None, kind: Kind | None, at: int) -> Values:
    """Take over an array of one kind, or of objects."""
    if kind is None:
        return _from_objects(data.astype(object), null, at)
    return Values(data, np.zeros(len(data), bool) if null is None else null, kind)


def plain(value: Any, at: int) -> tuple[Any, Kind]:
    """Return an object as plain Python, and its kind."""
    kind = _kind_of_object(value, at)
    if kind == "number":
        return (int(value) if _is_whole(value) else float(value)), kind
    return (bool(value) if kind == "condition" else value), kind


def element_of(column: Any, index: int, at: int) -> Values:
    """Take one element of each list of a list column; null where the list is shorter."""
    if not isinstance(column, Ragged):
        lists = [() if entry is None else entry for entry in column]
        if any(isinstance(entry, str) or not hasattr(entry, "__len__") for entry in lists):
            raise ExpressionFault("is no list", at)
        return values_of([e[index] if index < len(e) else None for e in lists], at)
    here = np.diff(column.offsets) > index
    data = np.zeros(len(column), column.values.dtype)
    data[here] = column.values[column.offsets[:-1][here] + index]
    values = values_of(data, at)
    return Values(values.data, values.null | ~here, values.kind)


def constant(value: object, count: int) -> Values:
    """Repeat one value."""
    if value is None:
        return Values(np.zeros(count), np.ones(count, bool), "null")
    if isinstance(value, float):
        data = np.empty(count)
        data.fill(value)  # np.full takes three times as long for few
    else:
        data = np.full(count, value, object if isinstance(value, str) else None)
    return Values(data, np.zeros(count, bool), kind_of_value(value))


def as_number(values: Values, wanted_by: str, at: int) -> Values:
    """Return float64 values; conditions count as 0 and 1."""
    require_number(values.kind, wanted_by, at)
    if values.kind == "number" and values.data.dtype == np.float64:
        return values
    return Values(values.data.astype(np.float64, copy=False), values.null, "number")


def require_number(kind: Kind, wanted_by: str, at: int) -> None:
    """Raise Fault for a text."""
    if kind == "text":
        raise ExpressionFault(f"{wanted_by} needs a number, got text", at)


def as_condition(values: Values, wanted_by: str, at: int) -> Values:
    """Return the same values if they are true or false."""
    require_condition(values.kind, wanted_by, at)
    if values.data.dtype == np.bool_:
        return Values(values.data, values.null, "condition")
    return Values(values.data.astype(bool, copy=False), values.null, "condition")


def require_condition(kind: Kind, wanted_by: str, at: int) -> None:
    """Raise Fault for a value that is not a condition (neither true nor false)."""
    if kind in ("number", "text"):
        hint = "compare it with something, such as: x > 0"
        raise ExpressionFault(f"{wanted_by} needs a condition, got {_NAMES[kind]}", at, hint)


def arithmetic(sign: str, left: Values, right: Values) -> Values:
    """Compute in float64 by IEEE 754: 1 / 0 is infinite, 0 / 0 is not a number."""
    data = ARITHMETIC[sign][0](left.data, right.data)
    return Values(data, left.null | right.null, "number")


def compare(sign: str, left: Values, right: Values, at: int) -> Values:
    """Compare pairs: null where either is; whole numbers exactly, others as float64."""
    null = left.null | right.null
    require_comparable(sign, left.kind, right.kind, at)
    if "null" in (left.kind, right.kind):
        return Values(np.zeros(len(null), bool), np.ones(len(null), bool), "condition")
    a, b = left.data, right.data
    if left.kind != "text" and "f" in (a.dtype.kind, b.dtype.kind):
        a, b = a.astype(np.float64, copy=False), b.astype(np.float64, copy=False)
    return Values(np.asarray(COMPARE[sign](a, b), bool), null, "condition")


def require_comparable(sign: str, left: Kind, right: Kind, at: int) -> None:
    """Raise Fault for a text compared with another kind, or by another sign than == and !=."""
    kinds = {left, right}
    if "text" in kinds and "null" not in kinds and (len(kinds) > 1 or sign not in ("==", "!=")):
        names = " with ".join(sorted(_NAMES[kind] for kind in (left, right)))
        raise ExpressionFault(f"'{sign}' cannot compare {names}", at)


def negated(values: Values) -> Values:
    """Return not x; unknown stays unknown."""
    return Values(~values.data, values.null, "condition")


def joined(word: str, parts: list[Values]) -> Values:
    """Join conditions with ``and`` or ``or``: one false part decides ``and``, known or not."""
    decisive = word == "or"
    decided = reduce(operator.or_, [(p.data == decisive) & ~p.null for p in parts])
    null = reduce(operator.or_, [p.null for p in parts]) & ~decided
    return Values(np.where(decided, decisive, not decisive), null, "condition")


def call(name: str, arguments: list[Values]) -> Values:
    """Apply a function of one instant to float64 arguments; null if any of them is."""
    null = reduce(operator.or_, [argument.null for argument in arguments])
    function, columns = FUNCTIONS[name][0], [argument.data for argument in arguments]
    if name == "bit":
        found: Values = function(*columns, null)
        return found
    return Values(function(*columns), null, "number")


def median(*columns: Any) -> Any:
    """Return the middle of several numbers, the mean of two middle ones; NaN if any is NaN."""
    ordered = np.sort(np.stack(columns), axis=0)
    low, high = ordered[(len(columns) - 1) // 2], ordered[len(columns) // 2]
    middle = np.where(low == high, low, (low + high) / 2) + 0.0  # no -0, no overflow of equals
    return np.where(np.isnan(ordered[-1]), np.nan, middle)


def _bit(word: Array, number: Array, null: Mask) -> Values:
    """Return whether a bit is set; null for a number that is not an integer of at most 53 bits."""
    fits = (word == np.floor(word)) & (np.abs(word) < 2.0**53)
    fits &= (number == np.floor(number)) & (number >= 0) & (number < 53)
    whole, place = (np.where(fits, x, 0).astype(np.int64) for x in (word, number))
    return Values((whole >> place) & 1 == 1, null | ~fits, "condition")


def _object_array(column: Any) -> Array:
    array = np.empty(len(column), object)
    array[:] = list(column)
    return array


def _from_objects(data: Array, mask: Mask | None, at: int) -> Values:
    null = np.array([value is None for value in data], bool)
    null = null if mask is None else null | mask
    one_of_each_type = {type(value): value for value in data[~null]}
    kinds = {_kind_of_object(value, at) for value in one_of_each_type.values()}
    if len(kinds) > 1:
        raise ExpressionFault("holds values of different kinds: " + ", ".join(sorted(kinds)), at)
    if not kinds:
        return Values(np.zeros(len(data)), np.ones(len(data), bool), "null")
    kind = kinds.pop()
    if kind == "text":
        return Values(data, null, kind)
    return Values(_packed(np.where(null, 0, data), kind), null, kind)


def _packed(data: Array, kind: Kind) -> Array:
    if kind == "condition":
        return data.astype(bool)
    return data.astype(np.int64 if all(map(_is_whole, data)) else np.float64)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and bool(-(2**63) <= value < 2**63)


def _kind_of_object(value: object, at: int) -> Kind:
    if isinstance(value, bool | np.bool_):
        return "condition"
    if isinstance(value, int | float | np.integer | np.floating):
        return "number"
    if isinstance(value, str):
        return "text"
    raise ExpressionFault(f"a value of type {type(value).__name__} cannot be used", at)


def _divide(a: float, b: float) -> float:
    """Divide by the rules of IEEE 754."""
    if b:
        return a / b
    return math.nan if not a or a != a else math.copysign(math.inf, a) * math.copysign(1.0, b)


def _bit_of(word: float, number: float) -> bool | None:
    if not (abs(word) < 2.0**53 and 0 <= number < 53 and word.is_integer() and number.is_integer()):
        return None
    return bool(int(word) >> int(number) & 1)


def _float_of(function: np.ufunc) -> Callable[..., float]:
    """Return numpy's version of a function whose last digit or sign of 0 differs by library."""
    return lambda *numbers: float(reduce(function, numbers) if numbers[1:] else function(*numbers))


ARITHMETIC: Mapping[
    str, tuple[Callable[[Array, Array], Array], Callable[[float, float], float]]
] = {
    "+": (np.add, operator.add),
    "-": (np.subtract, operator.sub),
    "*": (np.multiply, operator.mul),
    "/": (np.divide, _divide),
    "%": (np.mod, lambda a, b: a % b if b else math.nan),
}  # for columns, and for two numbers
COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
FUNCTIONS: Mapping[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "abs": (np.abs, abs),
    "sqrt": (np.sqrt, lambda a: math.sqrt(a) if a >= 0 else math.nan),
    "sin": (np.sin, _float_of(np.sin)),
    "cos": (np.cos, _float_of(np.cos)),
    "atan2": (np.arctan2, _float_of(np.arctan2)),
    "min": (lambda *columns: reduce(np.minimum, columns), _float_of(np.minimum)),
    "max": (lambda *columns: reduce(np.maximum, columns), _float_of(np.maximum)),
    "median": (median, lambda *numbers: float(median(*numbers))),
    "bit": (_bit, _bit_of),
}  # likewise; ``bit`` of columns also takes and gives what is null


Floats: TypeAlias = NDArray[np.float64]

_MOST_AT_ONCE = 1 << 21  # samples gathered for ``std``, about 50 MB


def count(times_ns: IntArray, flags: NDArray[np.bool_], after: IntArray, until: IntArray) -> Values:
    """Count the flags set in each window ``(after, until]``."""
    total = np.concatenate([[0], np.cumsum(flags)])
    first, last = _bounds(times_ns, after, until)
    return Values(total[last] - total[first], np.zeros(len(after), bool), "number")


def reduce_windows(
    name: str, times_ns: IntArray, samples: Floats, after: IntArray, until: IntArray
) -> Values:
    """Apply ``min max mean std rate`` to the samples of each window; null for a window without
    samples.
    """
    first, last = _bounds(times_ns, after, until)
    if name == "rate":
        return _rate(times_ns, samples, first, last)
    null = last <= first
    data = np.zeros(len(first))
    data[~null] = _REDUCE[name](samples, first[~null], last[~null])
    return Values(data, null, "number")


def reduce_whole(name: str, times_ns: IntArray, samples: Floats) -> float | None:
    """Apply one of these functions to all samples; None if there are too few."""
    ends = np.array([0]), np.array([len(samples)])
    if name == "rate":
        rate = _rate(times_ns, samples, *ends)
        return None if rate.null[0] else float(rate.data[0])
    return float(_REDUCE[name](samples, *ends)[0]) if len(samples) else None


def joined_times(parts: Sequence[IntArray]) -> IntArray:
    """Join times, each once, in order; times that are in order already cost little."""
    joined = np.sort(np.concatenate(parts), kind="stable")
    is_new = np.ones(len(joined), bool)
    np.not_equal(joined[1:], joined[:-1], out=is_new[1:])
    return joined[is_new]


def minimum(values: NDArray[Any], first: IntArray, last: IntArray) -> NDArray[Any]:
    """Return the least of ``values[first:last]`` for each pair, none of them empty."""
    return _segments(np.minimum, values, first, last)


def _bounds(times_ns: IntArray, after: IntArray, until: IntArray) -> tuple[IntArray, IntArray]:
    first = np.searchsorted(times_ns, after, "right")
    return first, np.searchsorted(times_ns, until, "right")


def _segments(
    function: np.ufunc, values: NDArray[Any], first: IntArray, last: IntArray
) -> NDArray[Any]:
    """Reduce overlapping segments; the value added at the end lets ``last`` be the length."""
    if not len(first):
        return values[:0]
    if len(first) == 1:
        only: NDArray[Any] = function.reduceat(values[first[0] : last[0]], [0])
        return only
    padded = np.append(values, values[-1:])
    pairs = np.stack([first, last], axis=1).ravel()
    reduced: NDArray[Any] = function.reduceat(padded, pairs)[::2]
    return reduced


def _mean(samples: Floats, first: IntArray, last: IntArray) -> Floats:
    means: Floats = _segments(np.add, samples, first, last) / (last - first)
    return means


def _std(samples: Floats, first: IntArray, last: IntArray) -> Floats:
    """Population standard deviation in two passes, which keeps it exact for large offsets."""
    lengths = last - first
    if len(first) > 1 and lengths.sum() > _MOST_AT_ONCE:
        half = len(first) // 2
        halves = ((first[:half], last[:half]), (first[half:], last[half:]))
        return np.concatenate([_std(samples, *part) for part in halves])
    ends = np.cumsum(lengths)
    rows = np.arange(lengths.sum()) + np.repeat(first - (ends - lengths), lengths)
    squares = (samples[rows] - np.repeat(_mean(samples, first, last), lengths)) ** 2
    deviations: Floats = np.sqrt(_segments(np.add, squares, ends - lengths, ends) / lengths)
    return deviations


def _rate(times_ns: IntArray, samples: Floats, first: IntArray, last: IntArray) -> Values:
    """Change per second between the first and the last sample of each window."""
    data = np.zeros(len(first))
    long = last - first >= 2
    a, b = first[long], last[long] - 1
    elapsed_s = (times_ns[b] - times_ns[a]) / 1e9
    data[long] = (samples[b] - samples[a]) / elapsed_s
    null = ~long
    null[long] = elapsed_s == 0
    return Values(data, null, "number")


_REDUCE: dict[str, Callable[[Floats, IntArray, IntArray], Floats]] = {
    "min": lambda samples, first, last: _segments(np.minimum, samples, first, last),
    "max": lambda samples, first, last: _segments(np.maximum, samples, first, last),
    "mean": _mean,
    "std": _std,
}
