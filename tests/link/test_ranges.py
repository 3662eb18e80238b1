"""Integers of robots are within one range, in every field of every frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from amberbox.fleet.uploads import verifying
from amberbox.link.frames import (
    Beat,
    Durable,
    FrameError,
    Has,
    Heads,
    Hello,
    Live,
    RobotFrame,
    Row,
    Rows,
    encode,
    from_robot,
)
from amberbox.link.positions import LARGEST, Place, Reach, RunEnd

REACH = Reach(Place(1, 2), Place(1, 9), Place(1, 9), (RunEnd(1, "boot", 9),))
FRAMES: tuple[RobotFrame, ...] = (
    Hello("r1", "s", "boot", {"watch": REACH}, "", 5, 6, "1"),
    Rows(1, 1, [Row("watch", 1, 2, "status", 3, b"{}")], {"watch": Place(1, 3)}),
    Durable(1, {"watch": REACH}),
    Live(1, {"a": (5, 1.5)}),
    Beat(1, 2, 3, 4, 5, 6, 7),
    Heads(1, b"{}"),
    Has(1, [("file", 5)], "id"),
)


def _with_number(value: Any, number: int) -> Iterator[Any]:
    """Yield copies of plain data, each with another one of its integers replaced."""
    if type(value) is int:
        yield number
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from ({**value, key: other} for other in _with_number(inner, number))
    elif isinstance(value, list | tuple):
        for at, inner in enumerate(value):
            for other in _with_number(inner, number):
                yield [*value[:at], other, *value[at + 1 :]]


@pytest.mark.parametrize("number", [2**63 - 1, 2**64 - 1, LARGEST + 1, -(2**63)])
def test_no_frame_with_a_number_out_of_range_is_read(number: int) -> None:
    for frame in FRAMES:
        assert from_robot(encode(frame)) == frame
        plain = msgspec.to_builtins(frame, builtin_types=(bytes,))
        for hostile in _with_number(plain, number):
            if hostile.get("protocol", 1) != 1:
                continue  # it is compared, and goes nowhere
            with pytest.raises(FrameError):
                from_robot(encode(hostile))


def test_no_journal_with_a_number_out_of_range_is_taken() -> None:
    sound = verifying.Result("", False, True, "main", 1, 2, 3, 4, 5, 6)
    assert verifying._in_range(sound) is sound
    for name in ("run", "number", "first_seq", "end_seq", "start_ns", "end_ns"):
        wrong: dict[str, Any] = {name: 2**63 - 1}
        refused = verifying._in_range(dataclasses.replace(sound, **wrong))
        assert refused.reason and getattr(refused, name) == 0
