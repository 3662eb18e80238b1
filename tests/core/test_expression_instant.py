"""One instant, computed without arrays, against the same instant among many: the same bits."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.expression import Expression, ExpressionError, parse
from amberbox.core.expressions.evaluation import WindowCache
from amberbox.core.samples import Samples

EDGES = (0.0, -0.0, 1.0, -2.5, 7.0, float("inf"), float("-inf"), float("nan"), 1e308, 5e-324, 0.1)
WHOLE = (0, 1, -3, 7, 52, 53, 2**53, 2**53 + 1, -(2**53) - 1, 2**63 - 1, -(2**63))
TYPES: dict[str, tuple[Any, Any]] = {
    "f.x": (np.float64, st.sampled_from(EDGES) | st.floats(width=64)),
    "f.y": (np.float64, st.sampled_from(EDGES) | st.floats(-5, 5)),
    "s.z": (np.float32, st.sampled_from((0.1, -4.0, 3e38, 0.0))),
    "i.x": (np.int64, st.sampled_from(WHOLE)),
    "i.y": (np.int64, st.integers(-4, 4) | st.sampled_from(WHOLE)),
    "b.on": (np.bool_, st.booleans()),
    "t.mode": (object, st.sampled_from(("ride", "charge", ""))),
}
numeric = st.sampled_from([name for name in TYPES if name != "t.mode"])
atoms = numeric | st.sampled_from(("0", "2", "0.1", "-1", str(2**53 + 1), "1e308", "true"))


def _both(template: str, *parts: Any) -> Any:
    return st.tuples(*parts).map(lambda found: template.format(*found))


def _deeper(inner: Any) -> Any:
    operators = st.sampled_from(("+", "-", "*", "/", "%"))
    functions = st.sampled_from(("min", "max", "median", "atan2"))
    windows = st.sampled_from(("min", "max", "mean", "std", "rate", "count"))
    return st.one_of(
        _both("({} {} {})", inner, operators, inner),
        _both("{}({}, {})", functions, inner, inner),
        _both("{}({})", st.sampled_from(("abs", "sqrt", "sin", "cos", "-")), inner),
        _both("{}({} over {}ns)", windows, inner, st.integers(1, 9)),
        _both("age({})", st.sampled_from(sorted(TYPES))),
    )


numbers = st.recursive(atoms, _deeper, max_leaves=6)
compared = st.one_of(
    _both("({} {} {})", numbers, st.sampled_from(("<", "<=", ">", ">=", "==", "!=")), numbers),
    _both("({} < {} <= {})", numbers, numbers, numbers),
    _both("(t.mode {} {})", st.sampled_from(("==", "!=")), st.sampled_from(("'ride'", "''"))),
    _both("known({})", st.sampled_from(sorted(TYPES))),
    _both("bit({}, {})", numbers, st.sampled_from(("0", "2", "i.y", "53", "f.x"))),
    st.just("b.on"),
)
conditions = st.recursive(
    compared,
    lambda inner: st.one_of(
        _both("({} {} {})", inner, st.sampled_from(("and", "or")), inner),
        _both("(not {})", inner),
        _both("({} for {}ns)", inner, st.integers(1, 6)),
        _both("(count({} over {}ns) > 1)", inner, st.integers(1, 9)),
    ),
    max_leaves=4,
)


current = st.fixed_dictionaries({name: some | st.none() for name, (_, some) in TYPES.items()})


@st.composite
def recordings(draw: Any) -> dict[str, Samples]:
    """Draw samples by address; those of one item share their times, which may repeat."""
    found = {}
    times: dict[str, list[int]] = {}
    for name, (dtype, values) in TYPES.items():
        item = name.partition(".")[0]
        if item not in times:
            times[item] = sorted(draw(st.lists(st.integers(0, 12), max_size=7)))
        count = len(times[item])
        rows = draw(st.lists(values, min_size=count, max_size=count))
        nulls = draw(st.lists(st.booleans(), min_size=count, max_size=count) | st.none())
        with np.errstate(over="ignore"):
            column: Any = np.array(rows, dtype)
        if nulls is not None:
            column = np.ma.MaskedArray(column, nulls)
            if dtype is object:
                column = np.array([None if null else v for v, null in zip(rows, nulls)], object)  # noqa: B905 - lengths are drawn alike
        found[name] = Samples()
        found[name].extend(np.array(times[item], np.int64), column)
    return found


def bits(value: Any) -> Any:
    """Return a key of type and bits of a value; all NaN are equal."""
    if isinstance(value, float):
        return "nan" if value != value else struct.pack("d", value)
    return type(value).__name__, value


def among_many(expression: Expression, samples: dict[str, Samples], at_ns: int) -> Any:
    column = expression.evaluate_samples(samples, np.array([at_ns - 1, at_ns, at_ns + 1]))
    value = None if np.ma.getmaskarray(column)[1] else np.ma.getdata(column)[1]
    return value.item() if isinstance(value, np.generic) else value


@settings(max_examples=200)
@given(numbers | conditions, recordings(), st.integers(-2, 14))
def test_one_instant_is_the_same_among_many(
    text: str, samples: dict[str, Samples], at_ns: int
) -> None:
    expression = parse(text)
    series: dict[str, Any] = {n: (one.times_ns, one.column()) for n, one in samples.items()}
    for name in ("t.mode", "b.on"):  # as long as nothing is known, their samples are numbers
        series[name] = (series[name][0], series[name][1].tolist())
    wanted = among_many(expression, samples, at_ns)
    assert bits(expression.evaluate_samples(samples, at_ns)) == bits(wanted)
    assert bits(expression.evaluate_series(series, at_ns)) == bits(wanted)
    number = expression.numbers(samples, at_ns)
    assert bits(float(number)) == bits(float("nan" if wanted is None else wanted))
    assert bits(float(expression.numbers(samples, np.array([at_ns]))[0])) == bits(float(number))


@settings(max_examples=150)
@given(numbers | conditions, numbers | conditions, recordings(), st.integers(-2, 14))
def test_what_expressions_share_changes_nothing(
    first: str, text: str, samples: dict[str, Samples], at_ns: int
) -> None:
    for at in (at_ns, np.array([at_ns - 1, at_ns, at_ns + 2])):
        windows = WindowCache()
        parse(f"{first} == {first}").numbers(samples, at, windows)
        shared = np.atleast_1d(parse(text).numbers(samples, at, windows))
        alone = np.atleast_1d(parse(text).numbers(samples, at))
        assert list(map(bits, shared.tolist())) == list(map(bits, alone.tolist()))


def test_equal_windows_are_worked_out_once() -> None:
    samples = {"f.x": Samples()}
    samples["f.x"].extend(np.array([1, 2, 3]), np.array([1.0, 2.0, 6.0]))
    windows = WindowCache()
    there = parse("mean(f.x over 9ns) < 4 and  mean(f.x  over 9ns) > 2")
    assert there.numbers(samples, 3, windows) == 1
    assert list(windows.results.values()) == [3.0]
    assert parse("mean(f.x over 2ns)").numbers(samples, 3, windows) == 4
    assert len(windows.results) == 2


@settings(max_examples=100)
@given(
    numbers | conditions, st.fixed_dictionaries({n: v | st.none() for n, (_, v) in TYPES.items()})
)
def test_current_values_are_the_same_as_a_row(text: str, values: dict[str, Any]) -> None:
    expression = parse(text)
    if expression.needs_history:
        with pytest.raises(ExpressionError, match="needs the past"):
            expression.evaluate(values)
        return
    rows = {name: [value, value] for name, value in values.items()}
    column = expression.evaluate_columns(np.array([0, 1]), rows)
    wanted = None if np.ma.getmaskarray(column)[1] else np.ma.getdata(column)[1]
    wanted = wanted.item() if isinstance(wanted, np.generic) else wanted
    assert bits(expression.evaluate(values)) == bits(wanted)


@pytest.mark.parametrize(
    "text",
    ["t.mode > 3", "t.mode and b.on", "f.x or b.on", "-t.mode < 1", "abs(t.mode) > 1",
     "f.x for 3ns", "mean(t.mode over 9ns)", "t.mode == f.x"],
)  # fmt: skip
def test_what_does_not_fit_is_said_alike(text: str) -> None:
    samples = {}
    for name, (dtype, _) in TYPES.items():
        samples[name] = Samples()
        value = "ride" if dtype is object else 1
        samples[name].extend(np.array([1, 4]), np.array([value, value], dtype))
    expression = parse(text)
    with pytest.raises(ExpressionError) as many:
        expression.evaluate_samples(samples, np.array([4, 5]))
    with pytest.raises(ExpressionError) as one:
        expression.evaluate_samples(samples, 5)
    assert str(one.value) == str(many.value)


def test_the_kinds_of_values_may_change() -> None:
    samples = {"x": Samples()}
    samples["x"].extend(np.array([1, 2, 3]), np.array([None, "a", "b"], object))
    expression = parse("x == 'a'")
    assert [expression.evaluate_samples(samples, t) for t in range(4)] == [None, None, True, False]
