"""Messages lost before the box, detected by a sequence number or by stamps at a fixed rate."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.payloads.payload import Continuity
from amberbox.blackbox.sources.zmq import ZmqTopic
from tests.fuzzing import examples, fuzz

T = 1_700_000_000


def missing(watched: Continuity | None, values: Sequence[Any]) -> list[int | None]:
    assert watched is not None
    return [watched.missing(json.dumps(value).encode(), "json") for value in values]


def test_holes_in_a_sequence_are_counted_and_a_restart_is_none() -> None:
    topic = ZmqTopic("odom", sequence="head/n")
    values = [{"head": {"n": n}} for n in (7, 8, 11, 11, 12.0, 0, 1, 4)]
    assert missing(topic.continuity(), values) == [0, 0, 2, 0, 0, 0, 0, 2]


def test_holes_in_stamps_at_a_fixed_rate_are_counted() -> None:
    topic = ZmqTopic("odom", stamp="t", rate_hz=10.0)
    times = (0, 0.1, 0.19, 0.31, 0.6, 0.7, 0.2, 0.3, 1.3)
    values = [{"t": T + time} for time in times]
    assert missing(topic.continuity(), values) == [0, 0, 0, 0, 2, 0, 0, 0, 9]


@pytest.mark.parametrize("value", [{}, {"n": None}, {"n": "1"}, {"n": True}, {"n": 0.5}, [1], 5])
def test_what_is_no_number_tells_nothing(value: Any) -> None:
    assert missing(ZmqTopic("odom", sequence="n").continuity(), [{"n": 1}, value, {"n": 3}]) == [
        0,
        None,
        1,
    ]
    assert missing(ZmqTopic("odom", stamp="n", rate_hz=1).continuity(), [value]) == [None]


def test_msgpack_is_read_as_well() -> None:
    watched = ZmqTopic("odom", sequence="n").continuity()
    assert watched is not None
    assert watched.missing(msgspec.msgpack.encode({"n": 1}), "msgpack") == 0
    assert watched.missing(msgspec.msgpack.encode({"n": 5}), "msgpack") == 3


def test_nothing_is_looked_at_without_being_asked() -> None:
    assert ZmqTopic("odom", stamp="t").continuity() is None


@fuzz
@settings(max_examples=examples(60))
@given(st.binary(max_size=100), st.sampled_from(["json", "msgpack"]))
def test_random_payloads_tell_a_number_or_nothing(payload: bytes, encoding: str) -> None:
    for topic in (ZmqTopic("a", sequence="n"), ZmqTopic("a", stamp="n", rate_hz=1e300)):
        watched = topic.continuity()
        assert watched is not None
        found = watched.missing(payload, encoding)
        assert found is None or found >= 0
