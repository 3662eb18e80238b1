"""What is right: what was broken, how that shows and what helps, as the robot's folder has it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from amberbox.core.errors import AmberboxError
from amberbox.demo.faults import OFFERS
from amberbox.demo.robots import KNOWLEDGE
from amberbox.diagnosis.fmea.load import FILE, load_fmea
from amberbox.diagnosis.fmea.model import Fmea
from tools.tour.notes import Notes


@dataclass(frozen=True, slots=True)
class Truth:
    """One fault: what it is called, the checks that it fails, its remedy and its tests."""

    cause: str
    checks: tuple[tuple[str, str], ...]
    steps: tuple[str, ...]

    def wrong(self, notes: Notes) -> Iterator[str]:
        """Yield what somebody has written down that is not so."""
        if _plain(self.cause) not in map(_plain, notes.causes):
            yield f"it is: {self.cause}; written down: {'; '.join(notes.causes)}"
        if not any(_tells(reason, check) for check in self.checks for reason in notes.why):
            yield f"no reason has to do with it: {'; '.join(notes.why)}"
        if _plain(notes.next) not in map(_plain, self.steps):
            yield f"what to do next neither mends it nor tells whether it is that: {notes.next}"


def truth_of(fault: str) -> Truth:
    """Look up a fault that the demonstration offers."""
    fmea = _analysis()
    mode = fmea.modes[OFFERS[fault].failure_mode]
    tests = [fmea.tests[outcome.test].text for outcome in mode.tests]
    checks = [_check(link.symptom) for link in mode.symptoms]
    return Truth(mode.description, tuple(checks), (mode.remedy, *tests))


@cache
def _analysis() -> Fmea:
    fmea, _problems = load_fmea(KNOWLEDGE / FILE)
    if fmea is None:
        raise AmberboxError(f"{KNOWLEDGE / FILE} cannot be read", "amberbox fmea check")
    return fmea


def _check(symptom: str) -> tuple[str, str]:
    """Return the words for a component and for its check: ``bus/devices/all_there`` is said as
    'The fieldbus and its master: the self-check "devices: all there" fails'.
    """
    component, *names = symptom.split("/")
    known = _analysis().components.get(component)
    words = ": ".join(dict.fromkeys(names)).replace("_", " ")
    return _plain(known.description if known else component), f'"{words}"'


def _tells(reason: str, check: tuple[str, str]) -> bool:
    return all(words in _plain(reason) for words in check)


def _plain(text: str) -> str:
    return text.casefold().rstrip(".?! ")
