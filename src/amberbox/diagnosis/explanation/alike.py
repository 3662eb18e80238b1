"""What something that is not in the FMEA looks like, in words."""

from __future__ import annotations

from collections.abc import Sequence

from amberbox.core.types import Diagnosis, Hypothesis
from amberbox.diagnosis.covering.common_cause import FEWEST
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.explanation.names import Names, in_order
from amberbox.diagnosis.explanation.words import both


def alike(names: Names, diagnosis: Diagnosis, leading: Sequence[Hypothesis]) -> str:
    """Say which known failure modes the unknown one that leads looks like; empty if none."""
    if [h.faults for h in leading] != [{UNKNOWN}] or not names.fmea.other.looks_like:
        return ""
    known = (h.faults - {UNKNOWN} for h in diagnosis.hypotheses)
    faults = next((faults for faults in known if len(faults) >= FEWEST), None)
    if faults is None:
        return ""
    texts = both([names.mode(fault) for fault in in_order(faults)])
    return f"it looks like {texts} at once, which have no cause in common that the FMEA knows"
