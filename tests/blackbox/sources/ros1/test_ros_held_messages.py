"""Messages that wait for their type keep their order and their time, and are bounded."""

from __future__ import annotations

import threading

import pytest

from amberbox.blackbox.sources.ros1 import subscription as held_module
from amberbox.blackbox.sources.ros1.subscription import HeldDelivery
from amberbox.testing.clock import PATIENCE_S


def test_what_is_held_is_delivered_first_and_in_order() -> None:
    heard: list[tuple[bytes, int]] = []
    held = HeldDelivery()
    held(b"a", 1)
    held(b"b", 2)
    assert heard == []
    held.release(lambda data, received_ns: heard.append((data, received_ns)))
    held(b"c", 3)
    assert heard == [(b"a", 1), (b"b", 2), (b"c", 3)]


def test_too_much_waits_for_the_release(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_module, "MOST_BYTES", 10)
    heard: list[bytes] = []
    held = HeldDelivery()
    held(b"12345678", 1)
    reader = threading.Thread(target=held, args=(b"abcdefgh", 2))
    reader.start()
    reader.join(0.05)
    assert reader.is_alive()
    held.release(lambda data, received_ns: heard.append(data))
    reader.join(PATIENCE_S)
    assert heard == [b"12345678", b"abcdefgh"]


def test_a_release_that_fails_does_not_hold_for_ever() -> None:
    def fail(data: bytes, received_ns: int) -> None:
        raise RuntimeError("disk on fire")

    held = HeldDelivery()
    held(b"a", 1)
    with pytest.raises(RuntimeError, match="disk on fire"):
        held.release(fail)
    held.wait(0)
    with pytest.raises(RuntimeError, match="disk on fire"):
        held(b"b", 2)
