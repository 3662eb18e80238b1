"""Conditions over a growing record: the same edges for any batches of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.conditions import (
    ConditionWatcher,
    WatchedCondition,
    address_problem,
    change_instants,
    condition_problem,
)
from amberbox.core.expression import parse
from amberbox.core.types import Batch, ItemSchema, Ragged

EMPTY = ItemSchema("test", ())


def batch(item: str, seconds: Sequence[float], children: Any = None, **columns: Any) -> Batch:
    times = np.array([round(s * NS) for s in seconds], np.int64)
    return Batch(
        item, EMPTY, "main", 1, np.arange(len(times)), times, times, times, columns, children or {}
    )


def watch(**texts: str) -> ConditionWatcher:
    return ConditionWatcher({name: WatchedCondition(parse(text)) for name, text in texts.items()})


def edges(watched: ConditionWatcher, until_s: float) -> list[tuple[str, float]]:
    return [(edge.name, edge.at_ns / NS) for edge in watched.edges(round(until_s * NS))]


def test_an_edge_is_where_a_condition_becomes_true() -> None:
    watched = watch(low="b.v < 20")
    watched.add(batch("b", [1, 2, 3, 4, 5], v=np.array([30.0, 10.0, 11.0, 25.0, 5.0])))
    assert edges(watched, 9) == [("low", 2.0), ("low", 5.0)]
    assert edges(watched, 10) == []


def test_each_of_several_rows_with_the_same_time_counts() -> None:
    watched = watch(high="b.v > 2")
    watched.add(batch("b", [1, 1, 1, 2], v=np.array([1.0, 3.0, 1.0, 1.0])))
    assert edges(watched, 1) == []
    watched.add(batch("b", [2, 2], v=np.array([3.0, 1.0])))
    assert [edge.at_ns for edge in watched.edges(9 * NS)] == [NS + 1, 2 * NS + 1]


def test_the_first_value_heard_is_an_edge_if_it_is_true() -> None:
    watched = watch(started="task.state == 'STARTED'")
    assert edges(watched, 1) == []
    watched.add(batch("task", [2], state=np.array(["STARTED"], object)))
    assert edges(watched, 3) == [("started", 2.0)]


def test_a_path_names_its_column_and_an_unknown_one_is_told_after_a_while() -> None:
    watched = watch(fast="odom.twist.linear.x > 1", typo="odom.twits_linear_x > 1")
    for start in (0, 40):
        watched.add(batch("odom", [start, start + 20], twist_linear_x=np.array([0.0, 2.0])))
        assert edges(watched, start + 20) == [("fast", start + 20.0)]
        assert len(watched.problems) == (start > 0)
    (told,) = watched.problems.values()
    assert "has not come in 60 s of odom; did you mean 'twist_linear_x'?" in told


def test_for_fires_between_samples() -> None:
    watched = watch(low="b.v < 20 for 2s")
    watched.add(batch("b", [1, 6], v=np.array([10.0, 10.0])))
    assert edges(watched, 2.5) == []
    assert edges(watched, 7) == [("low", 3.0)]


def test_an_age_is_noticed_in_silence() -> None:
    watched = watch(silent="age(b.v) > 1")
    watched.add(batch("b", [1], v=np.array([10.0])))
    assert edges(watched, 1.5) == []
    ((name, at_s),) = edges(watched, 5)
    assert name == "silent"
    assert 2.0 < at_s <= 2.1


def test_silences_late_in_a_long_record_are_noticed_however_it_is_read() -> None:
    seconds = [*range(1, 5000, 5), *range(5030, 9000, 5), 50_000]
    whole, parts = watch(silent="age(b.v) > 20"), watch(silent="age(b.v) > 20")
    whole.add(batch("b", seconds, v=np.ones(len(seconds))))
    found = []
    for until in (*range(100, 9100, 100), seconds[-1] + 60):
        new = [s for s in seconds if until - 100 < s <= until or s == seconds[-1] < until]
        if new:
            parts.add(batch("b", new, v=np.ones(len(new))))
        found += edges(parts, until)
    assert [round(at_s, 1) for _, at_s in found] == [5016.1, 9015.1, seconds[-1] + 20.1]
    assert edges(whole, seconds[-1] + 60) == found


def test_a_leap_of_the_clock_is_no_endless_silence() -> None:
    times = np.array([1, 60 * 365 * 86_400], np.int64) * NS
    series = {"b.v": (times, np.ones(2))}
    found = change_instants(parse("age(b.v) > 20"), series, 0, int(times[-1]) + NS)
    assert sum(map(len, found)) == 7 * 86_400 * 10 + 12


def test_asides_are_read_at_the_edge() -> None:
    end = WatchedCondition(
        parse("t.state == 'DONE'"), {"goal": parse("t.goal"), "level": parse("b.v")}
    )
    watched = ConditionWatcher({"end": end})
    watched.add(batch("b", [1, 2, 4], v=np.array([30, 40, 50])))
    states = np.array(["RUN", "DONE"], object)
    watched.add(batch("t", [1, 3], state=states, goal=np.array(["A", "B"], object)))
    (edge,) = watched.edges(5 * NS)
    assert edge.values == {"goal": "B", "level": 40}


def test_elements_of_lists_and_child_tables_are_read() -> None:
    watched = watch(near="scan.ranges[1] < 0.5", part="order__parts.state == 'bad'")
    assert watched.items == {"scan", "order__parts", "order"}
    ranges = Ragged(np.array([0, 2, 3]), np.array([1.0, 0.1, 0.1]))
    watched.add(batch("scan", [1, 2], ranges=ranges))
    child = batch("order__parts", [3], state=np.array(["bad"], object))
    watched.add(batch("order", [3], {"parts": child}))
    assert edges(watched, 4) == [("near", 1.0), ("part", 3.0)]


def test_what_cannot_be_judged_is_told_once_and_others_go_on() -> None:
    watched = watch(wrong="b.v > 3", number="c.v", good="c.v > 3")
    watched.add(batch("b", [1], v=np.array(["text"], object)))
    watched.add(batch("c", [2], v=np.array([4.0])))
    assert edges(watched, 3) == [("good", 2.0)]
    assert set(watched.problems) == {"wrong", "number"}


def test_a_list_without_an_index_is_told() -> None:
    watched = watch(wrong="scan.ranges > 3")
    watched.add(batch("scan", [1], ranges=Ragged(np.array([0, 1]), np.array([9.0]))))
    assert edges(watched, 3) == []
    assert "list" in watched.problems["scan.ranges"]


def test_nothing_up_to_the_start_is_told() -> None:
    watched = watch(low="b.v < 20")
    watched.add(batch("b", [1, 2, 3], v=np.array([10.0, 30.0, 10.0])))
    watched.edges(round(2.5 * NS))
    assert edges(watched, 4) == [("low", 3.0)]


@pytest.mark.parametrize("text", ["percentage < 3", "laser/device/front", "odom"])
def test_only_recorded_variables_can_be_watched(text: str) -> None:
    assert "item.variable" in address_problem(parse(text))


def test_numbers_are_no_conditions() -> None:
    assert "compare" in condition_problem(parse("a.b + 1"))
    assert condition_problem(parse("a.b")) == ""


def test_an_age_survives_that_old_samples_are_forgotten() -> None:
    watched = watch(silent="age(b.v) > 5")
    watched.add(batch("b", [1, 2, 3, 4], v=np.array([1.0, None, None, None], object)))
    assert edges(watched, 4) == []
    ((_, at_s),) = edges(watched, 8)
    assert 6.0 < at_s <= 6.1


def test_unknown_is_not_false() -> None:
    watched = watch(low="b.v < 20")
    watched.add(batch("b", [1, 2, 3, 4], v=np.array([10.0, None, 10.0, None], object)))
    assert edges(watched, 5) == [("low", 1.0)]


def test_a_new_run_knows_what_was_true_before() -> None:
    watched = watch(low="b.v < 20", high="b.v > 20")
    watched.add(batch("b", [5], v=np.array([10.0])))
    assert edges(watched, 6) == [("low", 5.0)]
    watched.begin_anew()
    watched.add(batch("b", [1, 2], v=np.array([10.0, 30.0])))
    assert edges(watched, 6) == [("high", 2.0)]
    after = watch(low="b.v < 20", high="b.v > 20")
    after.resume(watched.true, 6 * NS)
    after.add(batch("b", [5, 7, 8], v=np.array([10.0, 30.0, 10.0])))
    assert edges(after, 9) == [("low", 8.0)]


TEXTS = ("a.v > 2", "a.v > 1 for 2s", "mean(a.v over 3s) > 2", "a.v > b.v", "age(a.v) > 2")


@given(
    a=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 4)), max_size=12),
    b=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 4)), max_size=6),
    asked=st.lists(st.integers(0, 40), max_size=6),
)
def test_edges_do_not_depend_on_how_often_is_asked(
    a: list[tuple[int, int]], b: list[tuple[int, int]], asked: list[int]
) -> None:
    texts = {f"c{i}": text for i, text in enumerate(TEXTS)}
    whole, parts = watch(**texts), watch(**texts)
    rows = {"a": sorted(a), "b": sorted(b)}
    _add(whole, rows, -1, 60)
    since, found = -1, []
    for until in [*sorted(asked), 60]:
        _add(parts, rows, since, until)
        found += edges(parts, until)
        since = max(since, until)
    assert sorted(found) == sorted(edges(whole, 60))


def _add(
    watched: ConditionWatcher, rows: Mapping[str, list[tuple[int, int]]], since: int, until: int
) -> None:
    for item, pairs in rows.items():
        inside = [(t, v) for t, v in pairs if since < t <= until]
        if inside:
            watched.add(batch(item, [t for t, _ in inside], v=np.array([v for _, v in inside])))
