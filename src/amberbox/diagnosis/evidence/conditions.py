"""Evidence from the FMEA's own conditions over the record."""

from __future__ import annotations

from collections.abc import Sequence

from amberbox.core.contracts import EvidenceFollower
from amberbox.core.types import Status
from amberbox.diagnosis.condition_symptoms import ConditionTracker
from amberbox.diagnosis.knowledge import Knowledge


def follow(knowledge: Knowledge) -> EvidenceFollower:
    """Return the follower that evaluates the conditions as the record grows."""
    return _Conditions(knowledge.fmea)


class _Conditions(ConditionTracker):
    records = True

    def receive(self, found: Sequence[object]) -> None:
        """Add the statuses: conditions may read levels and outputs."""
        for status in found:
            if isinstance(status, Status):
                self.take(status)
