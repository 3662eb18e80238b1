"""What was written before the watcher was killed is not written again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest

from amberbox.core.types import Batch, Status
from amberbox.monitoring.engine.findings import Finding
from amberbox.monitoring.engine.states import States
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.watcher.epoch import Epoch
from amberbox.monitoring.watcher.evaluation import Evaluation
from amberbox.monitoring.watcher.memory import Checkpoint, Memory, Place
from amberbox.monitoring.watcher.reader import Block
from tests.monitoring.watcher.test_causes import alarm

EPOCH = Epoch(1, 0)
FIRST, SECOND, THIRD = alarm("a"), alarm("b"), alarm("c")
SAID = replace(FIRST, state="acknowledged", live_only=True)


class Told:
    """An engine that finds what it is told, block by block."""

    items: frozenset[str] = frozenset()
    history_s = 0.0

    def __init__(self, *found: Sequence[Finding]) -> None:
        self.found = list(found)
        self.states = States(Plan("robot", "hash", []))

    def begin(self, at_ns: int) -> None:
        """Begin nothing."""

    def feed(self, batch: Batch) -> None:
        """Take nothing."""

    def advance(self, until_ns: int) -> Sequence[Finding]:
        return self.found.pop(0)

    def statuses(self) -> Sequence[Status]:
        return []

    def snapshot(self) -> dict[str, Any]:
        return {}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Know all."""


@pytest.mark.parametrize(
    ("written", "left"),
    [
        (0, [[FIRST, SAID, SECOND], [THIRD]]),
        (1, [[SAID, SECOND], [THIRD]]),
        (2, [[], [THIRD]]),
        (3, [[], []]),
    ],
)
def test_what_people_said_is_not_counted(written: int, left: list[list[Finding]]) -> None:
    """A replay does not find it, so the count of what was written leaves it out."""
    place = Place(EPOCH, 100)
    memory = Memory(place, Checkpoint(place, {}, 0.0, {"known": 1}), written)
    evaluation = Evaluation(Told([FIRST, SAID, SECOND], [THIRD]), memory)
    blocks = [Block(EPOCH, 0, [], until_ns) for until_ns in (200, 300)]
    assert [new for block in blocks for new in evaluation.take(block)] == left
    assert evaluation.has_caught_up
