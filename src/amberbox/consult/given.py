"""What somebody says: ``--symptom ID[=STATE]`` and ``--answer TEST=VALUE``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import get_args

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.naming import named
from amberbox.core.types import Symptom, SymptomState
from amberbox.diagnosis.covering.next_test import CANNOT
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import check_named

SOURCE = "given"
"""Who found a symptom that somebody gave."""

_STATES: Mapping[str, SymptomState] = {state: state for state in get_args(SymptomState)}
_CANNOT = ("cannot", CANNOT)


def given_symptoms(texts: Iterable[str], knowledge: Knowledge, at_ns: int) -> list[Symptom]:
    """Read symptoms as they are given; the last word on each counts.

    Raises UsageError for one that the failure modes do not know, and for another state.
    """
    given: dict[str, Symptom] = {}
    for text in texts:
        name, equals, word = text.rpartition("=")
        if not equals:
            name, word = text, "present"
        state = _state(word, text)
        found = named(name, knowledge.model.sign_places, "symptom")
        onset_ns = at_ns if state == "present" else None
        given[found] = Symptom(found, state, found, onset_ns, at_ns, source=SOURCE)
    return list(given.values())


def given_answers(texts: Iterable[str], knowledge: Knowledge) -> dict[str, str]:
    """Read answers to tests, by the test's id.

    Raises UsageError for a test that there is not, and for an answer that it does not give.
    """
    given = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"'{text}' is no answer", "write --answer TEST=VALUE")
        test = _test(name, knowledge)
        given[test] = _value(test, value, knowledge)
    return given


def _state(word: str, text: str) -> SymptomState:
    if word not in _STATES:
        near = did_you_mean(word, _STATES)
        hint = "write ID, ID=absent or ID=unknown"
        raise UsageError(f"'{text}': a symptom is not '{word}'{near}", hint)
    return _STATES[word]


def _test(name: str, knowledge: Knowledge) -> str:
    if name.startswith("read:"):
        symptom = named(name.removeprefix("read:"), knowledge.model.sign_places, "symptom")
        return f"read:{symptom}"
    return named(name, knowledge.checks, "test")


def _value(test: str, value: str, knowledge: Knowledge) -> str:
    if value.strip().lower() in _CANNOT:
        return CANNOT
    check = check_named(knowledge, test)
    check.level(value)
    return value
