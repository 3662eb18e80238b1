"""Lines of children: whole, named, and never a flood."""

from __future__ import annotations

import os

import pytest

from amberbox.core.child_process import BURST, PER_S, ChildOutput, read_all


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def output(said: list[str]) -> ChildOutput:
    return ChildOutput("watch", said.append)


def test_a_line_is_said_when_it_is_whole(output: ChildOutput, said: list[str]) -> None:
    output.feed(b"motor: nom", 0.0)
    assert said == []
    output.feed(b"inal\n\nwh", 0.1)
    assert said == ["watch: motor: nominal"]
    output.end(0.2)
    assert said == ["watch: motor: nominal", "watch: wh"]


def test_a_flood_is_counted(output: ChildOutput, said: list[str]) -> None:
    output.feed(b"x\n" * 1000, 1.0)
    assert said == ["watch: x"] * BURST
    output.feed(b"y\n", 3.0)
    assert said[BURST:] == [f"watch: ({1000 - BURST} more lines, left out)", "watch: y"]
    output.feed(b"z\n" * 1000, 13.0)
    assert sum(line == "watch: z" for line in said) <= 10 * PER_S + 2 * PER_S


def test_a_line_without_end_is_cut(output: ChildOutput, said: list[str]) -> None:
    for _ in range(100):
        output.feed(b"x" * 10_000, 0.0)
    output.feed(b"\nnext\n", 0.0)
    assert len(said[0]) < 3000 and said[1] == "watch: next"


def test_the_error_is_kept(output: ChildOutput) -> None:
    output.feed(b"error: no such folder\nhint: make one\n", 0.0)
    assert output.error == "no such folder"


def test_reading_does_not_wait() -> None:
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    assert read_all(reading) == b""
    os.write(writing, b"a")
    assert read_all(reading) == b"a"
    os.close(writing)
    assert read_all(reading) == b""
    os.close(reading)
