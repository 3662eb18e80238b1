"""How sure a diagnosis is: a word, the number, and what was not looked at."""

from __future__ import annotations

from amberbox.core.sureness import percent, sure_word
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.explanation.explanation import Group, Sureness

COVERED = 0.98
"""What share of all probability must have been looked at to say nothing of the rest."""


def sureness(diagnosis: Diagnosis, broken: Group | None, remark: str = "") -> Sureness:
    """Say how sure the leading group is; the word is that of the least it can be.

    ``remark`` is said before what was not looked at.
    """
    if broken is None:
        return Sureness(sure_word(0.0), 0.0, 0.0, diagnosis.incomplete)
    covered = min(1.0, diagnosis.mass_covered)
    complete = covered >= COVERED and not diagnosis.incomplete
    probability = min(1.0, broken.probability)
    least = probability if complete else probability * covered
    notes = (remark, "" if complete else _note(diagnosis, covered))
    return Sureness(sure_word(least), probability, least, "; ".join(filter(None, notes)))


def _note(diagnosis: Diagnosis, covered: float) -> str:
    why = diagnosis.incomplete or "the list of possibilities is full"
    looked = f"those that were hold at least {percent(covered)} of all probability"
    return f"not all possibilities were looked at ({why}); {looked}"
