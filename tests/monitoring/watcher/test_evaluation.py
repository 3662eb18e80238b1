"""Findings written before the watcher was killed are not written again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import Finding
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.record_evaluation import DiagnosedEngine, RecordEvaluation
from amberbox.monitoring.record_reader import RecordBlock
from amberbox.monitoring.watcher_journal import (
    Checkpoint,
    EvaluatedPosition,
    RecordEpoch,
    RecoveredProgress,
)
from tests.monitoring.watcher.test_alarm_causes import alarm

EPOCH = RecordEpoch(1, 0)
FIRST, SECOND, THIRD = alarm("a"), alarm("b"), alarm("c")
SAID = replace(FIRST, state="acknowledged", live_only=True)


class Told(Engine):
    """An engine that returns given findings, block by block."""

    def __init__(self, *found: list[Finding]) -> None:
        super().__init__(MonitoringPlan("robot", "hash", []))
        self.found = list(found)

    def advance(self, until_ns: int) -> list[Finding]:
        return self.found.pop(0)

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Do nothing."""


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
    """A replay does not find it, so it is left out of the count of written findings."""
    place = EvaluatedPosition(EPOCH, 100)
    memory = RecoveredProgress(place, Checkpoint(place, {}, 0.0, {"known": 1}), written)
    evaluation = RecordEvaluation(DiagnosedEngine(Told([FIRST, SAID, SECOND], [THIRD])), memory)
    blocks = [RecordBlock(EPOCH, 0, [], until_ns) for until_ns in (200, 300)]
    assert [new for block in blocks for new in evaluation.take(block)] == left
    assert evaluation.has_caught_up
