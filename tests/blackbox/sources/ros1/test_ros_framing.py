"""TCPROS framing: the same messages result, whatever the pieces in which bytes arrive."""

from __future__ import annotations

import socket
import struct
import threading
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.sources.ros1.master import TcprosError
from amberbox.blackbox.sources.ros1.tcpros import (
    BUFFER_BYTES,
    FIRST_BYTES,
    LARGE_BYTES,
    ConnectionReader,
    Framer,
)
from amberbox.testing.clock import PATIENCE_S
from tests.fuzzing import examples, fuzz

LIMIT = 1 << 30


def framed(*messages: bytes) -> bytes:
    return b"".join(struct.pack("<I", len(message)) + message for message in messages)


def feed(framer: Framer, data: bytes, sizes: list[int]) -> list[bytes]:
    """Give bytes to a framer in pieces of these sizes, then in the largest it takes."""
    messages, at = [], 0
    pieces = iter(sizes)
    while at < len(data):
        room = framer.room()
        count = min(next(pieces, len(room)), len(room), len(data) - at)
        room[:count] = data[at : at + count]
        messages += framer.received(count)
        at += count
    return messages


@given(
    st.lists(st.binary(max_size=40), max_size=30),
    st.lists(st.integers(min_value=1, max_value=30), max_size=60),
)
def test_small_messages_in_any_pieces(messages: list[bytes], sizes: list[int]) -> None:
    assert feed(Framer(LIMIT), framed(*messages), sizes) == messages


@given(
    st.lists(st.sampled_from([0, 1, 700, LARGE_BYTES, LARGE_BYTES + 1, 300_000]), max_size=6),
    st.lists(st.integers(min_value=1, max_value=BUFFER_BYTES), max_size=20),
)
def test_large_and_small_messages_in_any_pieces(lengths: list[int], sizes: list[int]) -> None:
    messages = [bytes([at + 1]) * length for at, length in enumerate(lengths)]
    assert feed(Framer(LIMIT), framed(*messages), sizes) == messages


def test_an_incomplete_message_is_held_back() -> None:
    framer = Framer(LIMIT)
    assert feed(framer, framed(b"one", b"two")[:-1], []) == [b"one"]
    assert feed(framer, b"o", []) == [b"two"]


def test_a_store_for_huge_messages_is_given_back() -> None:
    framer = Framer(LIMIT)
    huge = bytes(20 << 20)
    assert feed(framer, framed(huge, b"next"), []) == [huge, b"next"]
    assert len(framer._store) == 0


@pytest.mark.parametrize("size", [1001, 0xFFFFFFFF])
def test_an_absurd_length_is_malformed(size: int) -> None:
    with pytest.raises(TcprosError, match=f"message of {size} bytes"):
        feed(Framer(1000), framed(b"fine") + struct.pack("<I", size), [])


@fuzz
@settings(max_examples=examples(30))
@given(
    st.integers(LARGE_BYTES + 1, LIMIT),
    st.integers(0, 3 * FIRST_BYTES),
    st.integers(1, BUFFER_BYTES),
)
def test_memory_grows_with_what_arrives_whatever_is_announced(
    announced: int, arrived: int, piece: int
) -> None:
    data = struct.pack("<I", announced) + bytes(min(arrived, announced - 1))
    framer = Framer(LIMIT)
    tracemalloc.start()
    try:
        assert feed(framer, data, [piece] * 3) == []
        assert tracemalloc.get_traced_memory()[1] < 4 * len(data) + 2 * FIRST_BYTES
    finally:
        tracemalloc.stop()


@fuzz
@settings(max_examples=examples(50))
@given(st.binary(max_size=2000))
def test_random_bytes_are_messages_or_malformed(data: bytes) -> None:
    framer = Framer(100_000)
    try:
        messages = feed(framer, data, [7, 300])
    except TcprosError:
        return
    assert sum(4 + len(message) for message in messages) <= len(data)


def test_a_reader_stamps_after_each_receive_and_ends_with_the_connection() -> None:
    ours, theirs = socket.socketpair()
    ticks = iter(range(100))
    heard: list[tuple[bytes, int]] = []
    first_heard = threading.Event()

    def deliver(data: bytes, received_ns: int) -> None:
        heard.append((data, received_ns))
        first_heard.set()

    reader = ConnectionReader(ours, LIMIT, lambda: next(ticks))
    thread = threading.Thread(target=reader.run, args=(deliver,))
    thread.start()
    theirs.sendall(framed(b"a", b"b"))
    assert first_heard.wait(PATIENCE_S)
    theirs.sendall(framed(b"c"))
    theirs.close()
    thread.join(PATIENCE_S)
    assert heard == [(b"a", 1), (b"b", 1), (b"c", 2)]
    assert reader.has_read and reader.last_ns == 2
