"""When something was found."""

from __future__ import annotations

from amberbox.core.types import Status, Symptom
from amberbox.monitoring.engine.findings import AlarmChange, Finding


def instant_of(finding: Finding) -> int:
    """Return when something was found, log time."""
    if isinstance(finding, Status):
        return finding.measured_ns
    if isinstance(finding, AlarmChange):
        return finding.changed_ns
    if isinstance(finding, Symptom):
        return finding.confirmed_ns or 0
    return finding.at_ns
