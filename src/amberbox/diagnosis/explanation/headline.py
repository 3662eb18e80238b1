"""The answer in one or two sentences that anyone understands."""

from __future__ import annotations

from collections.abc import Iterable

from amberbox.core.sureness import percent
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.covering.answer import NO_FAULT
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.explanation.explanation import Group, Sureness
from amberbox.diagnosis.explanation.words import capital, clock, sentence

NOTHING = "nothing that is known explains what was seen"


def headline(
    diagnosis: Diagnosis, broken: Group | None, sure: Sureness, symptoms: Iterable[Symptom]
) -> str:
    """Say what is broken and how sure that is; of what has healed, what it was."""
    if broken is None:
        return sentence(NOTHING)
    ids = [member.id for member in broken.members]
    what, how = broken.text, f" {capital(sure.word)} ({chance(sure)})."
    if ids == [NO_FAULT]:
        what, how = f"{broken.text} ({chance(sure)})", ""
    if diagnosis.state == "healed":
        healed = f"all symptoms have healed since {clock(_healed_ns(diagnosis, symptoms))}"
        return f"It was: {what}.{how} {sentence(healed)}"
    return f"{sentence(f'{what} is broken' if ids == [UNKNOWN] else what)}{how}"


def chance(sure: Sureness) -> str:
    """Write the probability, as a range where not everything was looked at."""
    if percent(sure.at_least) == percent(sure.probability):
        return percent(sure.probability)
    return f"{percent(sure.at_least)} to {percent(sure.probability)}"


def _healed_ns(diagnosis: Diagnosis, symptoms: Iterable[Symptom]) -> int:
    """Return when the last symptom went, else when the diagnosis was closed."""
    gone = {s.id: s.confirmed_ns for s in symptoms if s.state == "absent"}
    times = [gone.get(name) for name in diagnosis.symptoms]
    known = [time for time in times if time is not None]
    return max(known) if known and len(known) == len(times) else diagnosis.at_ns
