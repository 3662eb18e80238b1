"""Evidence from a user: ``--symptom ID[=STATE]`` and ``--answer TEST=VALUE``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import get_args

from amberbox.core.contracts import AnsweredTest, EvidenceItem, EvidenceNeeds, EvidenceWindow
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.names import full_id
from amberbox.core.types import Symptom, SymptomState
from amberbox.diagnosis.covering.next_test import CANNOT
from amberbox.diagnosis.diagnose import check_named
from amberbox.diagnosis.knowledge import Knowledge

SOURCE = "given"
"""Source of symptoms that the user states."""

_STATES: Mapping[str, SymptomState] = {state: state for state in get_args(SymptomState)}
_CANNOT = ("cannot", CANNOT)


_NEEDS = EvidenceNeeds(symptoms=False)


def needs(knowledge: Knowledge, folder: Path) -> EvidenceNeeds | None:
    """Return that it reads nothing: a user's evidence replaces the symptoms that were read."""
    return _NEEDS


def provide(knowledge: Knowledge, window: EvidenceWindow) -> Iterator[EvidenceItem]:
    """Yield the user's evidence; raises UsageError for names unknown to the FMEA."""
    symptoms = parse_symptoms(window.given.symptoms, knowledge, window.at_ns)
    answers = parse_answers(window.given.answers, knowledge)
    yield from symptoms
    yield from (AnsweredTest(test, outcome, SOURCE) for test, outcome in answers.items())


def parse_symptoms(texts: Iterable[str], knowledge: Knowledge, at_ns: int) -> list[Symptom]:
    """Parse the symptoms given; the last entry for each counts.

    Raises UsageError for a symptom unknown to the FMEA, and for another state.
    """
    given: dict[str, Symptom] = {}
    for text in texts:
        name, equals, word = text.rpartition("=")
        if not equals:
            name, word = text, "present"
        if word not in _STATES:
            near = did_you_mean(word, _STATES)
            hint = "write ID, ID=absent or ID=unknown"
            raise UsageError(f"'{text}': a symptom is not '{word}'{near}", hint)
        state = _STATES[word]
        found = full_id(name, knowledge.model.sign_places, "symptom")
        onset_ns = at_ns if state == "present" else None
        given[found] = Symptom(found, state, found, onset_ns, at_ns, source=SOURCE)
    return list(given.values())


def parse_answers(texts: Iterable[str], knowledge: Knowledge) -> dict[str, str]:
    """Parse answers to tests, by the test's id.

    Raises UsageError for an unknown test, and for an answer that it does not have.
    """
    given = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"'{text}' is no answer", "write --answer TEST=VALUE")
        test = _test(name, knowledge)
        given[test] = _value(test, value, knowledge)
    return given


def _test(name: str, knowledge: Knowledge) -> str:
    if name.startswith("read:"):
        symptom = full_id(name.removeprefix("read:"), knowledge.model.sign_places, "symptom")
        return f"read:{symptom}"
    return full_id(name, knowledge.checks, "test")


def _value(test: str, value: str, knowledge: Knowledge) -> str:
    if value.strip().lower() in _CANNOT:
        return CANNOT
    check = check_named(knowledge, test)
    check.level(value)
    return value
