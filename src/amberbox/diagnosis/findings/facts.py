"""What rules may build on: the FMEA, what is seen at an instant, lookups in a record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from amberbox.core.types import Symptom
from amberbox.diagnosis.fmea.model import FailureMode, Fmea
from amberbox.diagnosis.rules.faults import RuleError
from amberbox.diagnosis.rules.program import Fact, Program
from amberbox.diagnosis.rules.terms import show_key
from amberbox.diagnosis.rules.virtual import Virtual

FMEA = "fmea.yaml"
SEEN = "symptoms"
"""Names of where facts come from, in proofs."""

Measured: TypeAlias = tuple[tuple[str, int, int], ...]
"""What was measured: address, from and to in nanoseconds."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known besides the rules' own facts.

    ``seen`` are facts of an instant, each with what it was measured from. ``lookups`` are
    predicates that look into a record.
    """

    known: tuple[Fact, ...] = ()
    seen: tuple[tuple[Fact, Measured], ...] = ()
    lookups: tuple[Virtual, ...] = ()

    def added_to(self, program: Program) -> Program:
        """Return the program with all of them.

        Raises RuleError for a predicate that a file defines and that is a lookup as well.
        """
        for lookup in self.lookups:
            own = program.predicates.get(lookup.key)
            if own is not None and own.clauses:
                what = f"{own.clauses[0].place}: {show_key(lookup.key)} is looked up in the record"
                raise RuleError(what, "give the predicate of the file another name")
        seen = [fact for fact, _ in self.seen]
        added = program.with_facts(self.known, FMEA).with_facts(seen, SEEN)
        return added.with_virtual(*self.lookups)


def fmea_facts(
    fmea: Fmea, exposure_h: float | None = None, parts: Mapping[str, str] | None = None
) -> Iterator[Fact]:
    """Yield what an FMEA says; ``parts`` tells which component is a part of which."""
    for component in fmea.components.values():
        yield "component", component.id
        yield "type", component.id, component.type
    yield from (("part_of", name, whole) for name, whole in (parts or {}).items())
    yield from (("function", name) for name in fmea.functions)
    for user, needs in fmea.needs().items():
        yield from (("needs", user, name) for name in dict.fromkeys(needs.names()))
    for mode in fmea.modes.values():
        yield from _mode_facts(mode, exposure_h)
    yield from (("symptom", name) for name in fmea.symptoms)
    yield from (("test", test.id, test.text) for test in fmea.tests.values())


def _mode_facts(mode: FailureMode, exposure_h: float | None) -> Iterator[Fact]:
    of = mode.component, mode.name
    yield "failure_mode", *of
    yield "severity", *of, mode.severity
    yield "probability", *of, mode.chance(exposure_h)
    if mode.ranks.number is not None:
        yield "risk", *of, mode.ranks.number
    for name, text in (("cause", mode.cause), ("remedy", mode.remedy)):
        if text:
            yield name, *of, text
    yield from (("class", *of, word) for word in mode.classes)
    harmed = dict.fromkeys((*mode.effects.next, *mode.effects.system))
    yield from (("effect", *of, name) for name in harmed)
    yield from (("shows", *of, link.symptom) for link in mode.symptoms)
    yield from (("outcome", *of, given.test, given.outcome) for given in mode.tests)


def seen_facts(symptoms: Iterable[Symptom], fmea: Fmea) -> Iterator[tuple[Fact, Measured]]:
    """Yield ``present``, ``absent`` and ``unknown`` of symptoms, all of the FMEA included.

    What is blocked by something that its component depends on is unknown.
    """
    told = {}
    for symptom in symptoms:
        state = "unknown" if symptom.blocked_by else symptom.state
        told[symptom.id] = (state, symptom.id), measured(symptom)
    unknown: dict[str, tuple[Fact, Measured]] = {
        name: (("unknown", name), ()) for name in fmea.symptoms if name not in told
    }
    yield from (told | unknown).values()


def measured(symptom: Symptom) -> Measured:
    """Return what a present symptom was measured from, at least that it was seen itself."""
    if symptom.state != "present" or symptom.evidence:
        return symptom.evidence
    from_ns = symptom.onset_ns if symptom.onset_ns is not None else symptom.confirmed_ns
    to_ns = symptom.confirmed_ns if symptom.confirmed_ns is not None else from_ns
    return ((symptom.address or symptom.id, from_ns or 0, to_ns or 0),)
