"""Evidence from monitors: the symptoms that their engine finds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.contracts import EvidenceFollower
from amberbox.core.types import Batch, Symptom
from amberbox.diagnosis.knowledge import Knowledge


def follow(knowledge: Knowledge) -> EvidenceFollower:
    """Return the follower that selects the symptoms among the monitors' findings."""
    return _Monitors()


class _Monitors:
    """The follower of the monitors' symptoms; it reads no rows and keeps no state."""

    records = False
    items: frozenset[str] = frozenset()
    history_s = 0.0
    troubles: Mapping[str, str] = {}

    def __init__(self) -> None:
        self._found: list[Symptom] = []

    def begin(self, at_ns: int) -> list[Symptom]:
        return []

    def feed(self, batch: Batch) -> None:
        pass

    def receive(self, found: Sequence[object]) -> None:
        self._found += [symptom for symptom in found if isinstance(symptom, Symptom)]

    def advance(self, after_ns: int, until_ns: int) -> list[Symptom]:
        found, self._found = self._found, []
        return found

    def snapshot(self, until_ns: int) -> dict[str, Any] | None:
        return None

    def resume(self, snapshot: Mapping[str, Any], until_ns: int) -> None:
        pass
