"""Integers of robots are within one range, in every field of every frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from amberbox.link.frames import (
    LARGEST,
    BeatFrame,
    DurableFrame,
    FrameError,
    HasFrame,
    HeadsFrame,
    Hello,
    JournalPosition,
    LinkRow,
    LiveFrame,
    RobotFrame,
    RowsFrame,
    RunEnd,
    WriterReach,
    encode,
    from_robot,
)
from amberbox.server.ingest import verification

REACH = WriterReach(
    JournalPosition(1, 2), JournalPosition(1, 9), JournalPosition(1, 9), (RunEnd(1, "boot", 9),)
)
FRAMES: tuple[RobotFrame, ...] = (
    Hello("r1", "s", "boot", {"watch": REACH}, "", 5, 6, "1"),
    RowsFrame(1, 1, [LinkRow("watch", 1, 2, "status", 3, b"{}")], {"watch": JournalPosition(1, 3)}),
    DurableFrame(1, {"watch": REACH}),
    LiveFrame(1, {"a": (5, 1.5)}),
    BeatFrame(1, 2, 3, 4, 5, 6, 7),
    HeadsFrame(1, b"{}"),
    HasFrame(1, [("file", 5)], "id"),
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
    sound = verification.VerificationResult("", False, True, "main", 1, 2, 3, 4, 5, 6)
    assert verification._in_range(sound) is sound
    for name in ("run", "number", "first_seq", "end_seq", "start_ns", "end_ns"):
        wrong: dict[str, Any] = {name: 2**63 - 1}
        refused = verification._in_range(dataclasses.replace(sound, **wrong))
        assert refused.reason and getattr(refused, name) == 0
