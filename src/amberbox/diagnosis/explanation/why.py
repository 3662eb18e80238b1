"""Why symptoms follow from what leads: those with the same reasons are told together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.explanation.explanation import Group, Seen, Way
from amberbox.diagnosis.explanation.words import either

DIRECT = "this is how the fault shows"
EACH = "this is how each of them shows"
OTHER = "nothing that the FMEA knows explains this better"


def by_reasons(
    because: Sequence[Seen], broken: Group | None
) -> Mapping[tuple[str, ...], Sequence[Seen]]:
    """Return the symptoms by the reasons they have in common, in order of the first of each."""
    found: dict[tuple[str, ...], list[Seen]] = {}
    for seen in because:
        found.setdefault(reasons(seen, broken), []).append(seen)
    return found


def reasons(seen: Seen, broken: Group | None) -> tuple[str, ...]:
    """Return why a symptom follows: directly, or by what is lost on the way."""
    faults = {
        fault.id: fault.text for m in (broken.members if broken else ()) for fault in m.faults
    }
    direct = {way.fault for way in seen.ways if not way.via}
    return (*_direct(direct, faults), *_by_loss([way for way in seen.ways if way.via], faults))


def _direct(direct: set[str], faults: Mapping[str, str]) -> Iterator[str]:
    if faults.keys() == {UNKNOWN}:
        yield OTHER
    elif direct and direct == faults.keys():
        yield DIRECT if len(faults) == 1 else EACH
    elif direct:
        texts = [text for name, text in faults.items() if name in direct]
        yield f"this is how it shows: {either(texts, len(texts))}"


def _by_loss(ways: Sequence[Way], faults: Mapping[str, str]) -> Iterator[str]:
    """Tell a way once that several faults have in common."""
    starts: dict[str, list[str]] = {}
    for way in ways:
        starts.setdefault(way.text, []).append(way.fault)
    for text, of in starts.items():
        if set(of) == faults.keys():
            yield text if len(of) == 1 else f"each of them -> {text}"
        else:
            yield from (f"{faults.get(fault, fault)} -> {text}" for fault in of)
