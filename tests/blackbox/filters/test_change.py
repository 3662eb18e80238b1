"""The change filter against a row-by-row account of its rule, however the stream is cut."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.filters.change import ChangeFilter
from amberbox.core.errors import UsageError
from amberbox.core.source import ChangeOptions
from amberbox.core.types import Column, ItemSchema, Ragged, Rows

SECOND_NS = 1_000_000_000
PART = ItemSchema(
    "demo/Part", (Column("level", "level", "float32"), Column("tags", "tags", "list<int32>"))
)
SCHEMA = ItemSchema(
    "demo/State",
    (
        Column("header_seq", "header/seq", "uint32"),
        Column("header_stamp", "header/stamp", "time"),
        Column("header_frame_id", "header/frame_id", "string"),
        Column("speed", "twist/speed", "float64"),
        Column("count", "count", "int64"),
        Column("ready", "ready", "bool"),
        Column("ranges", "ranges", "list<float32>"),
    ),
    {"parts": PART},
    "header/stamp",
)


@dataclass(frozen=True)
class Message:
    """One message of SCHEMA; None is a null."""

    speed: float | None = 0.0
    count: int | None = 0
    ready: bool = False
    frame_id: str | None = "base"
    ranges: tuple[float, ...] | None = ()
    parts: tuple[tuple[float, tuple[int, ...]], ...] = ()


def numbers(values: Sequence[Any], dtype: str) -> Any:
    nulls = [value is None for value in values]
    filled = np.array([0 if value is None else value for value in values], dtype)
    return np.ma.masked_array(filled, mask=nulls) if any(nulls) else filled


def lists(values: Sequence[Sequence[Any] | None], dtype: str) -> Any:
    if any(value is None for value in values):
        column = np.empty(len(values), object)
        column[:] = [None if value is None else np.array(value, dtype) for value in values]
        return column
    offsets = np.cumsum([0] + [len(value or ()) for value in values])
    flat = [element for value in values for element in value or ()]
    return Ragged(offsets, np.array(flat, dtype))


def rows_of(messages: Sequence[Message]) -> Rows:
    """Lay messages out as the unroller would; stamps and sequence numbers always differ."""
    parts = [part for message in messages for part in message.parts]
    parents = [row for row, message in enumerate(messages) for _ in message.parts]
    child = Rows(
        len(parts),
        {
            "level": np.array([level for level, _ in parts], np.float32),
            "tags": lists([tags for _, tags in parts], "int32"),
        },
        parent_row=np.array(parents, np.int64),
        index=np.zeros(len(parts), np.int64),
    )
    frames = np.empty(len(messages), object)
    frames[:] = [message.frame_id for message in messages]
    columns = {
        "header_seq": np.arange(len(messages), dtype=np.uint32),
        "header_stamp": np.arange(len(messages), dtype=np.int64) * SECOND_NS,
        "header_frame_id": frames,
        "speed": numbers([message.speed for message in messages], "float64"),
        "count": numbers([message.count for message in messages], "int64"),
        "ready": np.array([message.ready for message in messages], bool),
        "ranges": lists([message.ranges for message in messages], "float32"),
    }
    return Rows(len(messages), columns, {"parts": child})


def kept(
    messages: Sequence[Message],
    options: ChangeOptions,
    times_s: Sequence[float] | None = None,
    cuts: Sequence[int] = (),
) -> list[bool]:
    """Filter messages in batches that end at ``cuts``; by default they arrive every millisecond."""
    times_s = times_s if times_s is not None else [row / 1000 for row in range(len(messages))]
    change = ChangeFilter(options, SCHEMA)
    answer: list[bool] = []
    edges = [0, *sorted(min(cut, len(messages)) for cut in cuts), len(messages)]
    for begin, end in itertools.pairwise(edges):
        received_ns = np.array([round(t * SECOND_NS) for t in times_s[begin:end]], np.int64)
        answer += change.mask(rows_of(messages[begin:end]), received_ns).tolist()
    return answer


def beyond(value: float | None, last: float | None, absolute: float, relative: float) -> bool:
    """The rule for one number, as docs/robot/filters.md puts it."""
    if value is None or last is None:
        return value is not last
    if not (math.isfinite(value) and math.isfinite(last)):
        return value != last and not (math.isnan(value) and math.isnan(last))
    return abs(value - last) > max(absolute, relative * abs(last))


def changed(message: Message, last: Message, absolute: float, relative: float) -> bool:
    """The rule for a message, written for reading and not for speed."""
    pairs: list[tuple[float | None, float | None]] = [
        (message.speed, last.speed),
        (message.count, last.count),
    ]
    if message.ranges is None or last.ranges is None:
        if message.ranges is not last.ranges:
            return True
    elif len(message.ranges) != len(last.ranges):
        return True
    else:
        pairs += zip(message.ranges, last.ranges, strict=True)
    if [len(tags) for _, tags in message.parts] != [len(tags) for _, tags in last.parts]:
        return True
    for (level, tags), (last_level, last_tags) in zip(message.parts, last.parts, strict=True):
        pairs += [(level, last_level), *zip(tags, last_tags, strict=True)]
    others = (message.ready, message.frame_id) != (last.ready, last.frame_id)
    return others or any(beyond(*pair, absolute, relative) for pair in pairs)


def by_the_rule(
    messages: Sequence[Message], times_s: Sequence[float], options: ChangeOptions
) -> list[bool]:
    answer: list[bool] = []
    last, last_s = START, -math.inf
    for message, time_s in zip(messages, times_s, strict=True):
        due = time_s - last_s >= options.heartbeat_s
        different = changed(message, last, options.absolute, options.relative)
        keep = not answer or due or different
        if keep:
            last, last_s = message, time_s
        answer.append(keep)
    return answer


START = Message(ranges=(0.0, 0.5), parts=((0.0, (1,)), (0.5, ())))

# Few different values, exact in float32, so that equal, near and far ones all occur.
NUMBERS = st.sampled_from(
    [0.0, -0.0, 0.25, 0.5, 1.0, 1.25, 2.0, -3.0, math.nan, math.inf, -math.inf]
)
PARTS = st.tuples(NUMBERS, st.lists(st.integers(0, 2), max_size=2).map(tuple))
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "speed": NUMBERS | st.none(),
    "count": st.integers(0, 3) | st.none(),
    "ready": st.booleans(),
    "frame_id": st.sampled_from(["base", "laser", None]),
    "ranges": st.lists(NUMBERS, max_size=2).map(tuple) | st.none(),
    "parts": st.lists(PARTS, max_size=2).map(tuple),
}
EDITS = st.sampled_from(sorted(FIELDS)).flatmap(
    lambda name: st.tuples(st.just(name), FIELDS[name], st.sampled_from([0.25, 1.0, 3.0]))
)


@settings(max_examples=300)
@given(
    st.lists(EDITS, max_size=25),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.sampled_from([0.0, 0.25, 1.0]),
    st.lists(st.integers(0, 25), max_size=6),
)
def test_agrees_with_the_rule_however_the_stream_is_cut(
    edits: list[tuple[str, Any, float]], absolute: float, relative: float, cuts: list[int]
) -> None:
    """Each message differs from the one before in one field, so that bands decide often."""
    messages = list(
        accumulate(edits, lambda m, edit: replace(m, **{edit[0]: edit[1]}), initial=START)
    )
    times_s = list(accumulate((edit[2] for edit in edits), initial=0.0))
    options = ChangeOptions(absolute=absolute, relative=relative, heartbeat_s=5.0)
    assert kept(messages, options, times_s, cuts) == by_the_rule(messages, times_s, options)


def test_a_ramp_is_kept_in_steps_of_the_dead_band() -> None:
    ramp = [Message(speed=step / 1024) for step in range(200)]
    places = np.flatnonzero(kept(ramp, ChangeOptions(absolute=10 / 1024))).tolist()
    assert places == list(range(0, 200, 11))


def test_slow_drift_is_noticed_although_no_step_exceeds_the_band() -> None:
    drift = [Message(speed=step * 0.001) for step in range(1000)]
    assert 90 <= sum(kept(drift, ChangeOptions(absolute=0.01))) <= 100


def test_the_band_holds_against_the_last_kept_row_across_batches() -> None:
    ramp = [Message(speed=step / 1024, ranges=(step / 1024,)) for step in range(60)]
    options = ChangeOptions(absolute=10 / 1024)
    assert kept(ramp, options, cuts=range(0, 60, 7)) == kept(ramp, options)


def test_stamps_and_sequence_numbers_alone_are_no_change() -> None:
    assert kept([Message()] * 4, ChangeOptions()) == [True, False, False, False]


def test_a_stamp_counts_when_it_is_named() -> None:
    assert kept([Message()] * 4, ChangeOptions(variables=("header/stamp",))) == [True] * 4
    assert kept([Message()] * 4, ChangeOptions(bands={"header/stamp": 1.5})) == [True, False] * 2


def test_only_named_variables_count() -> None:
    stream = [Message(speed=float(row), count=row // 2) for row in range(6)]
    options = ChangeOptions(variables=("count",))
    assert kept(stream, options) == [True, False, True, False, True, False]


def test_a_short_name_or_a_subtree_may_be_named() -> None:
    stream = [Message(speed=float(row)) for row in range(3)]
    assert kept(stream, ChangeOptions(variables=("twist",))) == [True] * 3
    assert kept(stream, ChangeOptions(variables=("speed",))) == [True] * 3


def test_child_tables_may_be_named() -> None:
    stream = [Message(speed=float(row), parts=((row // 2, ()),)) for row in range(4)]
    options = ChangeOptions(variables=("parts/level",))
    assert kept(stream, options) == [True, False, True, False]


def test_rows_that_move_between_the_lists_of_a_child_table_are_a_change() -> None:
    """Two parts with one screw: it sits in the first part, then in the second."""
    screw = ItemSchema("demo/Screw", (Column("torque", "torque", "float64"),))
    schema = ItemSchema("demo/State", (), {"parts": ItemSchema("demo/Part", (), {"screws": screw})})
    screws = Rows(3, {"torque": np.ones(3)}, parent_row=np.array([0, 2, 5]))
    parts = Rows(6, {}, {"screws": screws}, parent_row=np.repeat(np.arange(3), 2))
    rows = Rows(3, {}, {"parts": parts})
    change = ChangeFilter(ChangeOptions(), schema)
    assert change.mask(rows, np.arange(3)).tolist() == [True, False, True]


def test_a_band_by_name_replaces_the_general_one() -> None:
    stream = [Message(speed=row / 2, count=row) for row in range(8)]
    options = ChangeOptions(absolute=100, bands={"speed": 0.9})
    assert kept(stream, options) == [True, False] * 4


def test_the_heartbeat_keeps_a_silent_item_alive_and_starts_anew_at_each_kept_row() -> None:
    times_s = [0.0, 1.0, 2.0, 2.5, 4.5, 4.6]
    stream = [Message(), Message(), Message(), Message(count=1), Message(count=1), Message(count=1)]
    expected = [True, False, True, True, True, False]
    assert kept(stream, ChangeOptions(heartbeat_s=2.0), times_s) == expected


def test_a_heartbeat_of_zero_is_none() -> None:
    options = ChangeOptions(heartbeat_s=0.0)
    assert kept([Message()] * 2, options, [0.0, 1e6]) == [True, False]


def test_a_clock_set_back_does_not_silence_the_heartbeat() -> None:
    assert kept([Message()] * 2, ChangeOptions(), [1000.0, 3.0]) == [True, True]


def test_names_that_fit_nothing_are_told_and_do_not_throw_everything_away() -> None:
    options = ChangeOptions(variables=("sped",), bands={"header_frame_id": 1.0, "ranges": 0.5})
    assert set(ChangeFilter(options, SCHEMA).unused) == {"sped", "header_frame_id"}
    stream = [Message(speed=float(row)) for row in range(3)]
    assert kept(stream, options) == [True] * 3


@pytest.mark.parametrize(
    "options",
    [
        ChangeOptions(absolute=-1.0),
        ChangeOptions(relative=math.nan),
        ChangeOptions(heartbeat_s=-5.0),
        ChangeOptions(bands={"speed": -0.1}),
    ],
)
def test_bands_that_are_none_are_refused(options: ChangeOptions) -> None:
    with pytest.raises(UsageError, match="change"):
        ChangeFilter(options, SCHEMA)
