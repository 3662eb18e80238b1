"""The expression language: grammar, three-valued logic, errors that point at the place."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from amberbox.core.expression import Expression, ExpressionError, parse
from amberbox.core.types import Ragged

S = 1_000_000_000


@pytest.mark.parametrize(
    ("text", "values", "result"),
    [
        ("1 + 2 * 3 - 4 / 2", {}, 5.0),
        ("-7 % 3", {}, 2.0),
        ("-(2 - 5)", {}, 3.0),
        ("500ms", {}, 0.5),
        ("2min", {}, 120.0),
        ("ros_battery.percentage < 20", {"ros_battery.percentage": 19.5}, True),
        ("a.x/2", {"a.x": 3}, 1.5),
        ("a.x / b.y", {"a.x": 3, "b.y": 2}, 1.5),
        ("(a)/b", {"a": 3, "b": 2}, 1.5),
        ("a[1]/b", {"a": [0, 3], "b": 2}, 1.5),
        ("laser/laser_device/front == false", {"laser/laser_device/front": False}, True),
        ("`smart-wheel/pose/x.y`", {"smart-wheel/pose/x.y": "text"}, "text"),
        ("motor#overheated", {"motor#overheated": True}, True),
        ("ropod_1:ros_odom.x", {"ropod_1:ros_odom.x": 4}, 4),
        ("ropod_1:laser/device/front", {"ropod_1:laser/device/front": True}, True),
        ("scan.ranges[17] < 1", {"scan.ranges": [2.0] * 17 + [0.5]}, True),
        ("scan.ranges[17] < 1", {"scan.ranges[17]": 0.5}, True),
        ("scan.ranges[17] < 1", {"scan.ranges": [2.0]}, None),
        ("mode == 'AUTO'", {"mode": "AUTO"}, True),
        ('mode != "it\\"s"', {"mode": 'it"s'}, False),
        ("1 < x <= 5", {"x": 5}, True),
        ("1 < x <= 5", {"x": 1}, False),
        ("x == true", {"x": 1}, True),
        ("9007199254740993 == x", {"x": 9007199254740992}, False),
        ("abs(x) + sqrt(16)", {"x": -3}, 7.0),
        ("min(3, x, 5)", {"x": 4}, 3.0),
        ("max(x, 1)", {"x": None}, None),
        ("median(x, 1, 2)", {"x": 9}, 2.0),
        ("median(x, 1, 2, 3)", {"x": -9}, 1.5),
        ("median(x, 1, 2)", {"x": None}, None),
        ("atan2(1, 1) * 4", {}, float(np.arctan2(1, 1) * 4)),
        ("sin(0) + cos(0)", {}, 1.0),
        ("bit(status, 2)", {"status": 0b0100}, True),
        ("bit(status, 1)", {"status": 0b0100}, False),
        ("bit(status, 1)", {"status": 0.5}, None),
        ("(a > 1) + (b > 1) + (c > 1) >= 2", {"a": 2, "b": 0, "c": 2}, True),
        ("count > 3", {"count": 4}, True),
        ("known(x)", {"x": None}, False),
        ("not known(x)", {"x": 0}, False),
        ("null", {}, None),
        ("not (a or b) and true", {"a": False, "b": False}, True),
        ("not a == b", {"a": 1, "b": 2}, True),
        ("x\n  > 3", {"x": 4}, True),
    ],
)
def test_value(text: str, values: dict[str, Any], result: Any) -> None:
    value = parse(text).evaluate(values)
    assert value == result
    assert type(value) is type(result)


T, F, N = True, False, None


@pytest.mark.parametrize(
    ("a", "b", "both", "either"),
    [(T, T, T, T), (T, F, F, T), (T, N, N, T), (F, F, F, F), (F, N, F, N), (N, N, N, N)],
)
def test_null_is_unknown_not_false(
    a: bool | None, b: bool | None, both: bool | None, either: bool | None
) -> None:
    for values in ({"a": a, "b": b}, {"a": b, "b": a}):
        assert parse("a and b").evaluate(values) is both
        assert parse("a or b").evaluate(values) is either
    assert parse("not a").evaluate({"a": a}) is (None if a is None else not a)


@pytest.mark.parametrize("text", ["x > 1", "x + 1", "-x", "x == 'a'", "0 < x < 3", "abs(x)"])
def test_what_is_unknown_stays_unknown(text: str) -> None:
    assert parse(text).evaluate({"x": None}) is None


def test_a_false_pair_decides_a_chain_even_if_another_is_unknown() -> None:
    assert parse("5 < 1 < x").evaluate({"x": None}) is False


def test_division_follows_ieee_754() -> None:
    assert parse("1 / 0").evaluate({}) == float("inf")
    assert parse("-1 / 0").evaluate({}) == float("-inf")
    assert parse("0 / 0 == 0 / 0").evaluate({}) is False
    assert parse("known(0 / 0)").evaluate({}) is True


@pytest.mark.parametrize(
    ("text", "column", "what"),
    [
        ("men(x over 5s)", 1, "no function 'men'; did you mean 'mean'?"),
        ("x >", 4, "missing at the end"),
        ("", 1, "missing at the end"),
        ("(x > 1", 7, "expected ')'"),
        ("x > 1)", 6, "')' is not expected"),
        ("x y", 3, "'y' is not expected"),
        ("x = 3", 3, "write '=='"),
        ("x && y", 3, "write 'and'"),
        ("x ** 2", 3, "write x * x"),
        ("!x", 1, "write 'not'"),
        ("a/b > 1", 2, "a division or a path?"),
        ("a.x/b.y > 1", 4, "a division or a path?"),
        ("a/b/c/d", 2, "a division or a path?"),
        ("`a > 1", 1, "backtick"),
        ("`` > 1", 1, "address is missing"),
        ("'a == x", 1, "quote"),
        ("x[y]", 2, "whole number"),
        ("x > 1 for 5", 11, "no unit"),
        ("x > 1 for 5m", 11, "'m' is no unit of time"),
        ("x > 1 for 0s", 11, "above 0"),
        ("x > 1 for soon", 11, "expected a duration"),
        ("a and b for 5s", 3, "use brackets"),
        ("a or b and c for 5s", 8, "use brackets"),
        ("not a for 5s", 1, "use brackets"),
        ("mean(x)", 1, "write mean(x over 5s)"),
        ("abs(x over 5s)", 1, "takes no 'over'"),
        ("age(x + 1)", 7, "age takes an address"),
        ("abs()", 1, "takes 1 arguments, not 0"),
        ("x == null", 6, "known(x)"),
        ("x + 'a'", 5, "needs a number"),
        ("'a' < x", 5, "a text has no '<'"),
        ("'a' == 3", 5, "never equals"),
        ("x and 3", 7, "compare it"),
        ("not 'a'", 5, "needs a condition"),
        ("3 for 5s", 1, "needs a condition"),
        ("x > 1 or and", 10, "'and' is not expected"),
        ("x § 3", 3, "backticks"),
        ("(" * 60 + "x" + ")" * 60, 51, "nested too deeply"),
        ("not " * 60 + "x", 201, "nested too deeply"),
        ("- " * 60 + "x", 101, "nested too deeply"),
        ("x" * 10_001, 1, "longer than"),
        (" + ".join(["x"] * 201), 1, "more than 200 terms in a row"),
    ],
)
def test_error_points_at_the_place(text: str, column: int, what: str) -> None:
    with pytest.raises(ExpressionError) as caught:
        parse(text)
    assert what in str(caught.value)
    assert caught.value.column == column
    assert caught.value.exit_code == 2


def test_error_draws_a_caret_below_the_right_line() -> None:
    with pytest.raises(ExpressionError) as caught:
        parse("a > 1\nor b >> 2")
    assert caught.value.what.splitlines()[1:] == ["  or b >> 2", "        ^"]


@pytest.mark.parametrize(
    ("text", "values", "what"),
    [
        ("battery.percentge > 3", {"battery.percentage": 3}, "did you mean 'battery.percentage'?"),
        ("x > 3", {"x": "fast"}, "cannot compare a number with text"),
        ("x < y", {"x": "a", "y": "b"}, "'<' cannot compare text"),
        ("x + 1", {"x": "a"}, "needs a number, got text"),
        ("x and true", {"x": 1}, "needs a condition, got a number"),
        ("x == 1", {"x": b"a"}, "bytes"),
        ("x == 1", {"x": [1, 2]}, "list"),
        ("x[0] == 1", {"x": 5}, "is no list"),
        ("x > 1 for 5s", {"x": 1}, "needs the past"),
        ("age(x) > 5", {"x": 1}, "needs the past"),
        ("mean(x over 1s) > 5", {"x": 1}, "needs the past"),
    ],
)
def test_values_that_do_not_fit(text: str, values: dict[str, Any], what: str) -> None:
    with pytest.raises(ExpressionError, match=re.escape(what)):
        parse(text).evaluate(values)


def test_addresses_and_history() -> None:
    expression = parse(
        "mean(a.x - b.y over 5s) > a.x and (`c/d e/f` for 2s) or count(x over 1 min)>1"
    )
    assert expression.addresses() == ("a.x", "b.y", "c/d e/f", "x")
    assert expression.history_ns == 60 * S
    assert parse("mean(count(x over 1s) over 2s) > 1 for 3s").history_ns == 6 * S
    assert expression.needs_history
    assert not parse("a.x > 1").needs_history
    assert parse("age(a)").needs_history


def test_the_longest_sum_works_everywhere() -> None:
    long = parse(" + ".join(["x"] * 200))
    assert long.addresses() == ("x",)
    assert long.evaluate({"x": 2}) == 400
    assert [*long.evaluate_columns(np.array([1, 2]), {"x": np.array([2.0, 4.0])})] == [400, 800]
    assert hash(long.resolve(["a.x"])) == hash(long.resolve(["a.x"]))


@pytest.mark.parametrize(
    ("text", "kind"),
    [("1 + x", "number"), ("x", "any"), ("x > 1", "condition"), ("'a'", "text"), ("null", "null")],
)
def test_kind(text: str, kind: str) -> None:
    assert parse(text).kind == kind


def test_short_forms_stand_for_one_address() -> None:
    known = ["ros_battery.percentage", "laser/front/ok", "laser/rear/ok", "scan.ranges"]
    resolved = parse("percentage < 20 and ranges[3] > abs(percentage)").resolve(known)
    assert resolved.addresses() == ("ros_battery.percentage", "scan.ranges[3]")
    assert resolved.text == "percentage < 20 and ranges[3] > abs(percentage)"
    with pytest.raises(ExpressionError, match="'ok' is ambiguous: laser/front/ok or laser/rear/ok"):
        parse("ok == true").resolve(known)
    with pytest.raises(ExpressionError, match=r"did you mean 'scan\.ranges'"):
        parse("scan.range").resolve(known)
    with pytest.raises(ExpressionError, match="no variable or output 'centage'"):
        parse("centage").resolve(known)


def test_expressions_are_values() -> None:
    assert parse("a > 1") == Expression.from_text("a > 1")
    assert hash(parse("a > 1")) == hash(parse("a > 1"))


def test_columns_of_all_sorts() -> None:
    times = np.arange(4, dtype=np.int64) * S
    columns = {
        "count": np.array([1, 2, 3, 2**53 + 1], np.uint64),
        "volts": np.ma.MaskedArray([1.0, np.nan, 3.0, 4.0], [False, False, True, False]),
        "mode": np.array(["a", None, "b", "a"], object),
        "ranges": Ragged(np.array([0, 2, 2, 3, 5]), np.array([1.0, 2.0, 3.0, 4.0, 5.0])),
        "nothing": np.array([None] * 4, object),
    }

    def values(text: str) -> list[Any]:
        column = parse(text).evaluate_columns(times, columns)
        mask = np.ma.getmaskarray(np.ma.asarray(column)) if column.dtype != object else None
        return [None if mask is not None and mask[i] else v for i, v in enumerate(column.data)]

    assert values("volts > 2") == [False, False, None, True]
    assert values("count == 9007199254740993") == [False, False, False, True]
    assert values("mode == 'a'") == [True, None, False, True]
    assert list(parse("mode").evaluate_columns(times, columns)) == ["a", None, "b", "a"]
    assert values("ranges[1]") == [2.0, None, None, 5.0]
    assert values("nothing > 1 or count < 3") == [True, True, None, None]
    assert values("volts > 2 or mode == 'b'") == [False, None, True, True]
    assert values("3") == [3, 3, 3, 3]


def test_columns_without_rows() -> None:
    none = np.zeros(0, np.int64)
    for text in ("x > 1", "mean(x over 5s)", "x > 1 for 5s", "count(x over 1s) > 0", "age(x)"):
        assert len(parse(text).evaluate_columns(none, {"x": np.zeros(0)})) == 0


def test_rows_with_equal_stamps_all_count() -> None:
    times = np.array([1, 1, 2], np.int64) * S
    columns = {"x": np.array([5.0, 1.0, 3.0])}
    assert list(parse("x").evaluate_columns(times, columns)) == [5.0, 1.0, 3.0]
    assert list(parse("count(x over 5s)").evaluate_columns(times, columns)) == [2, 2, 3]
    assert list(parse("max(x over 5s)").evaluate_columns(times, columns)) == [5.0, 5.0, 5.0]


def test_times_must_be_in_order_and_as_many_as_values() -> None:
    with pytest.raises(Exception, match="not in order"):
        parse("x").evaluate_columns(np.array([2, 1]), {"x": np.zeros(2)})
    with pytest.raises(ExpressionError, match="3 values for 2 instants"):
        parse("x").evaluate_columns(np.array([1, 2]), {"x": np.zeros(3)})


def series(*samples: tuple[float, Any]) -> tuple[Any, list[Any]]:
    return np.array([round(t * S) for t, _ in samples], np.int64), [v for _, v in samples]


def at(text: str, seconds: float, **columns: Any) -> Any:
    return parse(text).evaluate_series(columns, round(seconds * S))


def test_last_sample_holds_until_the_next() -> None:
    x = series((1, 10), (2, None), (3, 30))
    assert [at("x", t, x=x) for t in (0.5, 1, 1.9, 2, 3, 99)] == [None, 10, 10, None, 30, 30]


def test_series_with_clocks_of_their_own() -> None:
    a, b = series((0, 1), (1, 2), (2, 3)), series((0.5, 10), (1.5, 20))
    assert at("a + b", 1.6, a=a, b=b) == 22
    # a + b changes at 0.5 (11), 1 (12), 1.5 (22), 2 (23); before 0.5 it is unknown
    assert at("max(a + b over 1s)", 2, a=a, b=b) == 23
    assert at("count(a + b over 10s)", 2, a=a, b=b) == 4
    assert at("mean(a + b over 10s)", 2, a=a, b=b) == (11 + 12 + 22 + 23) / 4


def test_window_is_open_at_its_start_and_closed_at_its_end() -> None:
    x = series((0, 100), (1, 1), (2, 2))
    assert at("max(x over 2s)", 2, x=x) == 2
    assert at("max(x over 2001ms)", 2, x=x) == 100
    assert at("max(x over 2s)", 4, x=x) is None
    assert at("count(x over 2s)", 4, x=x) == 0


def test_window_functions() -> None:
    x = series((0, 1), (1, None), (2, 4), (4, 7))
    assert at("mean(x over 9s)", 4, x=x) == 4
    assert at("std(x over 9s)", 4, x=x) == pytest.approx(6**0.5)
    assert at("rate(x over 9s)", 4, x=x) == 1.5
    assert at("rate(x over 1s)", 4, x=x) is None
    assert at("count(x over 9s)", 4, x=x) == 3
    assert at("count(x > 3 over 9s)", 4, x=x) == 2
    assert at("mean(x > 3 over 9s)", 4, x=x) == pytest.approx(2 / 3)
    assert at("mean(x over 9s) > 1 for 1s", 4, x=x) is True


def test_std_keeps_small_deviations_of_large_values() -> None:
    x = series(*((i, 1e12 + i % 2) for i in range(10)))
    assert at("std(x over 100s)", 9, x=x) == 0.5


def test_for_means_throughout() -> None:
    x = series((0, 5), (10, 1), (11, 5))
    assert at("x > 3 for 5s", 5, x=x) is True
    assert at("x > 3 for 5s", 4.999, x=x) is None, "nothing is known before 0"
    assert at("x > 3 for 5s", 10, x=x) is False
    assert at("x > 3 for 5s", 15.999, x=x) is False
    assert at("x > 3 for 5s", 16, x=x) is True


def test_for_sees_what_changes_between_samples() -> None:
    x = series((0, 10), (1, 0))
    # the 10 of t=0 leaves the window of 2 s at t=2: then the mean falls from 5 to 0
    assert at("mean(x over 2s) > 4 for 0.5s", 1.6, x=x) is True
    assert at("mean(x over 2s) > 4 for 0.5s", 2, x=x) is False
    assert at("mean(x over 2s) == 0 for 0.5s", 2.4, x=x) is False
    assert at("mean(x over 2s) == 0 for 0.5s", 2.5, x=x) is True
    assert at("((x == 0) for 1s) for 1s", 2.9, x=x) is False
    assert at("((x == 0) for 1s) for 1s", 3, x=x) is True


def test_age_grows_between_samples() -> None:
    x = series((0, 1), (1, None), (5, 2))
    assert at("age(x)", -1, x=x) is None
    assert at("age(x)", 3, x=x) == 3
    assert at("age(x)", 5.5, x=x) == 0.5
    assert at("age(x) > 2 for 1s", 3.5, x=x) is True
    assert at("age(x) < 4 for 2s", 5.5, x=x) is False, "it reached 5 s right before the sample"
    assert at("age(x) <= 5s for 2s", 5.5, x=x) is True


def test_never_seen_variable_is_unknown() -> None:
    x = series()
    assert at("x > 1", 5, x=x) is None
    assert at("age(x)", 5, x=x) is None
    assert at("x > 1 for 1s", 5, x=x) is None
    assert at("count(x over 1s)", 5, x=x) == 0
    assert at("not known(x)", 5, x=x) is True


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("status(battery) == 'ok'", "status(battery)"),
        ("status( battery/cells ) == 'ok'", "status(battery/cells)"),
        ("status(`smart-wheel/pose.2`) == 'ok'", "status(smart-wheel/pose.2)"),
    ],
)
def test_statuses_are_addresses_of_texts(text: str, address: str) -> None:
    assert parse(text).addresses() == (address,)
    assert parse(text).evaluate({address: "ok"}) is True
    assert parse(text).resolve([address]).evaluate({address: "stale"}) is False


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("status() == 'ok'", "status takes a component, or component/mode"),
        ("status(a, b) == 'ok'", "status takes a component, or component/mode"),
        ("status(a) == 1", "a text never equals a number"),
        ("status(a) and b", "'and' needs a condition, this is a text"),
    ],
)
def test_what_is_no_status_is_refused(text: str, what: str) -> None:
    with pytest.raises(ExpressionError, match=re.escape(what)):
        parse(text)
