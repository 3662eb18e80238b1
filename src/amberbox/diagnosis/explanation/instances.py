"""Causes and tests that differ only by the instance of a type: told and asked as one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import takewhile

from amberbox.core.types import Diagnosis
from amberbox.diagnosis.covering.check import Check
from amberbox.diagnosis.explanation.words import either
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import CREDIBLE, presence


def kind_of(fmea: Fmea, fault: str) -> str:
    """Return what failure modes of all instances of a type have in common: ``type#mode``."""
    component, _, name = fault.partition("#")
    known = fmea.components.get(component)
    return f"{known.type if known else component}#{name}"


def kinds_of(fmea: Fmea, faults: Collection[str]) -> tuple[str, ...]:
    """Return the kinds of failure modes that are there together."""
    return tuple(sorted(kind_of(fmea, fault) for fault in faults))


def merged(texts: Sequence[str]) -> str:
    """Join texts that differ in some words: ``the tyres of the front left or rear left unit``."""
    texts = list(dict.fromkeys(texts))
    first, last, middles = _differing(texts)
    if not middles:
        return either(texts, len(texts))
    words = texts[0].split()
    return " ".join([*words[:first], _listed(middles), *words[len(words) - last :]])


def instance_words(texts: Sequence[str]) -> list[str]:
    """Return the words in which each text differs from the others; none where nothing is alike."""
    return _differing(texts)[2]


def _differing(texts: Sequence[str]) -> tuple[int, int, list[str]]:
    """Return how many words are alike at the beginning and at the end, and what is between."""
    words = [text.split() for text in texts]
    first = _alike(words)
    last = _alike([one[first:][::-1] for one in words])
    middles = [" ".join(one[first : len(one) - last]) for one in words]
    return first, last, middles if first + last and all(middles) else []


def as_one(kinds: Sequence[tuple[str, ...]], texts: Sequence[str]) -> list[str]:
    """Return texts in order, those of one kind merged to one."""
    found: dict[tuple[str, ...], list[str]] = {}
    for kind, text in zip(kinds, texts, strict=True):
        found.setdefault(kind, []).append(text)
    return [merged(of) for of in found.values()]


def siblings(knowledge: Knowledge, diagnosis: Diagnosis, check: Check) -> list[Check]:
    """Return a test with the same test of other instances that may be broken as well.

    They are in order of how probable what they see is.
    """
    component, _, name = check.id.rpartition(".")
    known = knowledge.fmea.components
    if component not in known:
        return [check]
    shares = presence(diagnosis.hypotheses)
    asked = {test.id for test in diagnosis.next_tests}
    kind = known[component].type
    of_type = (f"{other.id}.{name}" for other in known.values() if other.type == kind)
    others = [knowledge.checks[i] for i in of_type if i in asked and i in knowledge.checks]
    chances = {one.id: _chance(one, shares) for one in others}
    credible = [one for one in others if chances[one.id] >= CREDIBLE and one.id != check.id]
    return [check, *sorted(credible, key=lambda one: -chances[one.id])]


def _chance(check: Check, shares: dict[str, float]) -> float:
    return sum(shares.get(sight.cause, 0.0) for sight in check.sights)


def _alike(words: Sequence[Sequence[str]]) -> int:
    """Return how many words all texts have in common at their beginning."""
    same = (len(set(column)) == 1 for column in zip(*words, strict=False))
    return sum(1 for _ in takewhile(bool, same))


def _listed(words: Iterable[str]) -> str:
    *rest, last = words
    return f"{', '.join(rest)} or {last}" if rest else last
