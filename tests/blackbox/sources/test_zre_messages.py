"""Beacons and messages of ZRE: known bytes, and bytes of anybody."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.sources.zre import messages
from amberbox.blackbox.sources.zre.messages import (
    Beacon,
    ZreError,
    ZreMessage,
    read_beacon,
    read_message,
    write_beacon,
    write_message,
)
from amberbox.blackbox.sources.zre.node import missing_between

NODE = bytes(range(16))
HELLO = (
    b"\xaa\xa1\x01\x02\x00\x01"
    b"\x13tcp://10.0.0.1:9999"
    b"\x00\x00\x00\x01\x00\x00\x00\x05ROPOD"
    b"\x01\x05robot"
    b"\x00\x00\x00\x01\x01k\x00\x00\x00\x05value"
)


def test_the_bytes_of_the_standard() -> None:
    assert write_beacon(Beacon(NODE, 0xB0B1)) == b"ZRE\x01" + NODE + b"\xb0\xb1"
    hello = ZreMessage(
        messages.HELLO,
        1,
        status=1,
        endpoint="tcp://10.0.0.1:9999",
        name="robot",
        groups=["ROPOD"],
        headers={"k": "value"},
    )
    assert read_message(HELLO) == hello and write_message(hello) == HELLO
    shout = b"\xaa\xa1\x03\x02\x01\x02\x05ROPOD"
    assert read_message(shout) == ZreMessage(messages.SHOUT, 258, "ROPOD")
    join = b"\xaa\xa1\x04\x02\xff\xff\x05ROPOD\x07"
    assert read_message(join) == ZreMessage(messages.JOIN, 65535, "ROPOD", 7)


@pytest.mark.parametrize(
    "frame",
    [
        *(HELLO[:end] for end in (0, 5, 6, 20, 40, len(HELLO) - 1)),
        b"\xaa\xa0" + HELLO[2:],
        HELLO[:3] + b"\x01" + HELLO[4:],
        HELLO[:2] + b"\x63" + HELLO[3:],
        b"\xaa\xa1\x01\x02\x00\x01\x00" + b"\xff\xff\xff\xff",
        b"\xaa\xa1\x01\x02\x00\x01\x00" + b"\x00\x00\x00\x01\x7f\xff\xff\xff",
    ],
)
def test_what_is_no_message_is_refused(frame: bytes) -> None:
    with pytest.raises(ZreError):
        read_message(frame)


@given(st.binary(max_size=200), st.integers(0, 12))
def test_no_bytes_raise_anything_else(data: bytes, kind: int) -> None:
    for frame in (data, b"\xaa\xa1" + bytes([kind, 2]) + data):
        with suppress(ZreError):
            read_message(frame)
    with suppress(ZreError):
        assert write_beacon(read_beacon(data)) == data


@pytest.mark.parametrize(
    ("last", "now", "missing"),
    [(1, 2, 0), (1, 5, 3), (65535, 0, 0), (65534, 0, 0), (65533, 2, 4), (9, 9, 0), (500, 1, 0)],
)
def test_holes_in_sequence_numbers(last: int, now: int, missing: int) -> None:
    assert missing_between(last, now) == missing
