"""Vectorised, scalar and windowed evaluation against a plain reading of the rules, row by row."""

from __future__ import annotations

import math
import operator
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.expression import ExpressionError, parse

COMPARE = {">": operator.gt, "<=": operator.le, "==": operator.eq, "!=": operator.ne}
ARITHMETIC = {"+": operator.add, "-": operator.sub, "*": operator.mul}

# A part is (text, function of an instant): the function is the oracle, in three-valued logic.
Samples = dict[str, list[tuple[int, Any]]]
small = st.integers(-3, 3)


def held(samples: list[tuple[int, Any]], t: int) -> Any:
    before = [value for at, value in samples if at <= t]
    return before[-1] if before else None


def times_of(names: set[str], samples: Samples) -> list[int]:
    return sorted({at for name in names for at, _ in samples[name]})


class Part:
    """A piece of text, the addresses in it, and its meaning."""

    def __init__(self, text: str, names: set[str], meaning: Any) -> None:
        self.text, self.names, self.meaning = text, names, meaning

    def __repr__(self) -> str:
        return self.text


def lift(function: Any, *parts: Part) -> Any:
    def meaning(samples: Samples, t: int) -> Any:
        values = [part.meaning(samples, t) for part in parts]
        return None if None in values else function(*values)

    return meaning


def join(*parts: Part) -> set[str]:
    return set().union(*(part.names for part in parts))


def kleene(word: str, a: Part, b: Part) -> Any:
    def meaning(samples: Samples, t: int) -> bool | None:
        values = [part.meaning(samples, t) for part in (a, b)]
        if (word == "or") in values:
            return word == "or"
        return None if None in values else word == "and"

    return meaning


def window(name: str, inner: Part, over: int) -> Part:
    def meaning(samples: Samples, t: int) -> Any:
        at = [s for s in times_of(inner.names, samples) if t - over < s <= t]
        values = [(s, inner.meaning(samples, s)) for s in at]
        values = [(s, v) for s, v in values if v is not None]
        numbers = [float(v) for _, v in values]
        if name == "count":
            return sum(1 for _, v in values if v is not False)
        if name == "rate":
            if len(values) < 2:
                return None
            return (numbers[-1] - numbers[0]) / ((values[-1][0] - values[0][0]) / 1e9)
        return REDUCE[name](numbers) if numbers else None

    return Part(f"{name}({inner.text} over {over}ns)", inner.names, meaning)


def spread(numbers: list[float]) -> float:
    mean = sum(numbers) / len(numbers)
    return math.sqrt(sum((x - mean) ** 2 for x in numbers) / len(numbers))


REDUCE: dict[str, Callable[[list[float]], float]] = {
    "min": min,
    "max": max,
    "mean": lambda x: sum(x) / len(x),
    "std": spread,
}


def throughout(inner: Part, length: int) -> Part:
    def meaning(samples: Samples, t: int) -> bool | None:
        # instants are whole nanoseconds, so that all of them can be looked at
        values = [inner.meaning(samples, s) for s in range(t - length, t + 1)]
        return False if False in values else None if None in values else True

    return Part(f"(({inner.text}) for {length}ns)", inner.names, meaning)


def address(name: str) -> Part:
    return Part(name, {name}, lambda samples, t: held(samples[name], t))


def number_over(a: Part, sign: str, b: Part) -> Part:
    return Part(f"({a.text} {sign} {b.text})", join(a, b), lift(ARITHMETIC[sign], a, b))


def middle_of(parts: list[Part]) -> Part:
    text = f"median({', '.join(part.text for part in parts)})"
    return Part(text, join(*parts), lift(lambda *x: float(statistics.median(x)), *parts))


def compared(a: Part, sign: str, b: Part) -> Part:
    return Part(f"({a.text} {sign} {b.text})", join(a, b), lift(COMPARE[sign], a, b))


def logic(a: Part, word: str, b: Part) -> Part:
    return Part(f"({a.text} {word} {b.text})", join(a, b), kleene(word, a, b))


addresses = st.sampled_from(["i.x", "i.y", "j.z"]).map(address)
numbers = st.recursive(
    addresses,
    lambda inner: st.one_of(
        st.builds(number_over, inner, st.sampled_from(sorted(ARITHMETIC)), inner),
        inner.map(lambda a: Part(f"abs({a.text})", a.names, lift(abs, a))),
        st.builds(
            lambda a, n: number_over(a, "+", Part(f"({n})", set(), lambda s, t: n)), inner, small
        ),
        st.lists(inner, min_size=2, max_size=4).map(middle_of),
    ),
    max_leaves=4,
)
conditions = st.recursive(
    st.builds(compared, numbers, st.sampled_from(sorted(COMPARE)), numbers),
    lambda inner: st.one_of(
        st.builds(logic, inner, st.sampled_from(["and", "or"]), inner),
        inner.map(lambda a: Part(f"(not {a.text})", a.names, lift(operator.not_, a))),
    ),
    max_leaves=4,
)
windows = st.builds(
    window,
    st.sampled_from(["min", "max", "mean", "std", "rate", "count"]),
    st.one_of(numbers, conditions),
    st.integers(1, 12),
)
timed = st.one_of(
    windows,
    st.builds(throughout, conditions, st.integers(1, 6)),
    st.builds(
        lambda w, n: throughout(compared(w, ">", Part(f"({n})", set(), lambda s, t: n)), 3),
        windows,
        small,
    ),
    st.builds(
        lambda c, name: window(name, throughout(c, 3), 7),
        conditions,
        st.sampled_from(["count", "max"]),
    ),
)
values = st.one_of(st.none(), small)
signals = st.lists(st.tuples(st.integers(0, 20), values), max_size=8).map(
    lambda samples: sorted(dict(samples).items())
)
recordings = st.fixed_dictionaries({"i.x": signals, "i.y": signals, "j.z": signals})


def same(got: Any, wanted: Any) -> bool:
    if got is None or wanted is None or isinstance(wanted, bool):
        return got is wanted
    return math.isclose(got, wanted, rel_tol=1e-9, abs_tol=1e-9)


def columns_of(samples: Samples) -> dict[str, tuple[Any, Any]]:
    return {
        name: (np.array([at for at, _ in rows], np.int64), [value for _, value in rows])
        for name, rows in samples.items()
    }


def unmasked(column: Any) -> list[Any]:
    mask = np.ma.getmaskarray(column) if isinstance(column, np.ma.MaskedArray) else None
    data = np.ma.getdata(column)
    return [
        None if mask is not None and mask[i] else v.item() if hasattr(v, "item") else v
        for i, v in enumerate(data)
    ]


@settings(max_examples=150)
@given(
    part=st.one_of(numbers, conditions),
    rows=st.lists(st.tuples(values, values, values), max_size=6),
)
def test_columns_and_scalars_agree(part: Part, rows: list[tuple[Any, Any, Any]]) -> None:
    expression = parse(part.text)
    names = ("i.x", "i.y", "j.z")
    times = np.arange(len(rows), dtype=np.int64)
    columns = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    by_column = unmasked(expression.evaluate_columns(times, columns))
    for i, row in enumerate(rows):
        now = dict(zip(names, row, strict=True))
        wanted = part.meaning({name: [(0, value)] for name, value in now.items()}, 0)
        assert same(expression.evaluate(now), wanted)
        assert same(by_column[i], wanted)


@settings(max_examples=250)
@given(part=st.one_of(timed, conditions, numbers), samples=recordings)
def test_series_agree_with_the_plain_reading(part: Part, samples: Samples) -> None:
    expression = parse(part.text)
    instants = np.arange(-2, 26, dtype=np.int64)
    series = columns_of(samples)
    by_column = unmasked(expression.evaluate_series(series, instants))
    for t, got in zip(instants.tolist(), by_column, strict=True):
        wanted = part.meaning(samples, t)
        assert same(got, wanted), (t, got, wanted)
    assert same(expression.evaluate_series(series, 11), part.meaning(samples, 11))


@settings(max_examples=100)
@given(part=timed, samples=recordings, t=st.integers(0, 25))
def test_history_says_how_much_of_the_past_is_enough(part: Part, samples: Samples, t: int) -> None:
    expression = parse(part.text)
    since = t - expression.history_ns

    def shortened(rows: list[tuple[int, Any]]) -> list[tuple[int, Any]]:
        old = [row for row in rows if row[0] <= since][-1:]
        return old + [row for row in rows if row[0] > since and row[0] <= t]

    short = {name: shortened(rows) for name, rows in samples.items()}
    whole = expression.evaluate_series(columns_of(samples), t)
    assert same(expression.evaluate_series(columns_of(short), t), whole)


@settings(max_examples=300)
@given(
    st.text(alphabet="ab.x/#:`'\"()[]<>=!+-*%,0159 \nfor over and not mean( 5s nul", max_size=40)
)
def test_any_text_is_read_or_refused_politely(text: str) -> None:
    try:
        expression = parse(text)
    except ExpressionError as error:
        assert 1 <= error.column <= len(text) + 1
    else:
        assert expression.text == text
