"""Blind spots of an analysis: failure modes that nothing tells apart, outputs that none explains.

Two modes are told apart by their symptoms if these can say which of two equally probable ones it
is in more than ``RIGHT`` of all cases. With the Bhattacharyya coefficient ``b`` of what they show
nobody can be right in more than ``(1 + sqrt(1 - b^2)) / 2`` (Kailath 1967).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.core.errors import Problem
from amberbox.core.expressions.tree import output_of
from amberbox.diagnosis.fmea.findings import finding_instances, finding_signs
from amberbox.diagnosis.fmea.model import (
    FailureMode,
    Fmea,
    FmeaReferences,
    FmeaSymptom,
    SymptomLink,
    links_by_mode,
)

RIGHT = 0.6
_MOST_MODES = 300  # of one component that are compared with each other
_SHOWN = 3


@dataclass(frozen=True, slots=True)
class _Signature:
    """What a mode shows: the probabilities of each symptom's levels, and what is certain.

    ``other`` decides by itself where it differs: outcomes of tests, times, consequences, proofs.
    """

    levels: Mapping[str, tuple[float, ...]]
    other: Collection[object]

    def is_like(self, one: _Signature, unseen: Mapping[str, tuple[float, ...]]) -> bool:
        """Return whether symptoms tell two modes apart too seldom; ``unseen``: without a cause."""
        if self.other != one.other:
            return False
        overlap = 1.0
        for name in self.levels.keys() | one.levels.keys():
            ours, theirs = (of.levels.get(name, unseen[name]) for of in (self, one))
            overlap *= math.fsum(math.sqrt(p * q) for p, q in zip(ours, theirs, strict=True))
        return (1 + math.sqrt(max(0.0, 1 - overlap**2))) / 2 <= RIGHT


def indistinguishable(fmea: Fmea) -> dict[str, list[tuple[str, ...]]]:
    """Return groups of modes of one component that neither symptoms nor tests tell apart.

    Keys are components. Modes that show nothing are left out.
    """
    links = {mode: list(of) for mode, of in links_by_mode(fmea).items()}
    signs, found = finding_signs(replace(fmea, unusual=())) if fmea.findings else ((), ())
    for link in found:
        links[link.cause].append(SymptomLink(link.symptom, link.detects, 0, 0))
    proofs = _proofs(fmea)
    symptoms = dict(fmea.symptoms) | {
        sign.id: FmeaSymptom(sign.id, leak=sign.leak) for sign in signs
    }
    unseen = {name: _levels(symptom, ()) for name, symptom in symptoms.items()}
    groups: dict[str, list[tuple[str, ...]]] = {}
    for name, component in fmea.components.items():
        shown = [mode for mode in component.modes if links[mode]][:_MOST_MODES]
        alike: list[tuple[_Signature, list[str]]] = []
        for mode in shown if len(shown) > 1 else ():
            own = _signature(fmea.modes[mode], links[mode], symptoms, proofs.get(mode, ()))
            group = next((modes for one, modes in alike if own.is_like(one, unseen)), None)
            if group is None:
                alike.append((own, [mode]))
            else:
                group.append(mode)
        several = [tuple(modes) for _, modes in alike if len(modes) > 1]
        if several:
            groups[name] = several
    return groups


def _proofs(fmea: Fmea) -> dict[str, list[str]]:
    """Return the findings that prove each mode, or one of several."""
    found: dict[str, list[str]] = {}
    for of in fmea.findings:
        for name, faults in finding_instances(of, fmea.modes) if of.proves else ():
            for mode in faults:
                found.setdefault(mode, []).append(name)
    return found


def _signature(
    mode: FailureMode,
    links: Sequence[SymptomLink],
    symptoms: Mapping[str, FmeaSymptom],
    proofs: Collection[str],
) -> _Signature:
    by_symptom: dict[str, list[SymptomLink]] = {}
    for link in links:
        by_symptom.setdefault(link.symptom, []).append(link)
    levels = {name: _levels(symptoms[name], of) for name, of in by_symptom.items()}
    times = ((link.symptom, link.after_s) for link in links if link.after_s is not None)
    tests = ((result.test, result.outcome) for result in mode.tests)
    follows = (following.mode for following in mode.leads_to)
    return _Signature(levels, frozenset((*times, *tests, *follows, *proofs)))


def _levels(symptom: FmeaSymptom, links: Collection[SymptomLink]) -> tuple[float, ...]:
    """Return the probability of each level of a symptom by noisy-MAX; the first is absent."""
    scale, bins = symptom.scale, symptom.scale.bins if symptom.scale else 1
    up_to = [1 - symptom.leak * (1 - level / bins) for level in range(bins + 1)]
    for link in links:
        shares = scale.shares(link.size) if scale and link.size else (1 / bins,) * bins
        for level in range(bins):
            up_to[level] *= 1 - link.detects * math.fsum(shares[level:])
    below = [0.0, *up_to]
    return tuple(max(0.0, p - q) for p, q in zip(up_to, below, strict=False))


def unexplained(fmea: Fmea, known: FmeaReferences) -> dict[str, list[str]]:
    """Return the outputs that can be bad and that no failure mode explains, by component.

    An output that a condition reads is used. Components without any failure mode are left out.
    """
    used = {link.symptom for of in links_by_mode(fmea).values() for link in of}
    used |= {link.symptom for of in fmea.functions.values() for link in of.symptoms}
    for symptom in fmea.symptoms.values():
        used.update(symptom.condition.addresses() if symptom.condition else ())
    analysed = {name for name, component in fmea.components.items() if component.modes}
    found: dict[str, list[str]] = {}
    for address in sorted(set(known.watched) - used):
        place = output_of(address)
        if place is not None and place[0] in analysed:
            found.setdefault(place[0], []).append(address)
    return found


def unexplained_notes(fmea: Fmea, known: FmeaReferences, file: str) -> Iterator[Problem]:
    """Yield a note for each component with outputs that no failure mode explains.

    It is about the component's file; where that is not known, about ``file``.
    """
    for component, addresses in unexplained(fmea, known).items():
        names = few([address.partition("/")[2] for address in addresses])
        what = f"no failure mode shows {names}: it is an alarm, but says nothing of what is broken"
        hint = "add it to the symptoms of what causes it"
        place = known.files.get(component, file)
        yield Problem(place, 1, component, what, hint, is_error=False)


def few(names: Sequence[str], between: str = ", ") -> str:
    """Return names as text; of many only the first."""
    left = len(names) - _SHOWN
    shown = between.join(names[:_SHOWN])
    return shown if left <= 0 else f"{shown} and {left} more"
