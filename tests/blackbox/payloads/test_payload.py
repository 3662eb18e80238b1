"""Payloads without a definition: JSON is recognised, everything else is kept as bytes."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.payloads.payload import is_json, payload_topic
from tests.support.can_bus import columns_of


@given(st.recursive(st.none() | st.booleans() | st.floats() | st.text(), st.lists, max_leaves=20))
def test_json_is_recognised(value: object) -> None:
    try:
        text = json.dumps(value, allow_nan=False)
    except ValueError:
        return
    assert is_json(text.encode()) and is_json(b"\xef\xbb\xbf" + text.encode())


@pytest.mark.parametrize("data", [b"", b"ON", b"\xff", b"[" * 100_000, b"{}}", b"nan", b"1 2"])
def test_what_is_no_json(data: bytes) -> None:
    assert not is_json(data)


def test_bytes_are_one_column() -> None:
    rows = unroller(payload_topic("t", "raw")).rows([b"", b"\xff\x00", b"ON"])
    assert columns_of(rows) == {"data": [None, b"\xff\x00", b"ON"]}
