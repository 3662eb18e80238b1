"""How each symptom counts over time: present, remembered, absent, blocked, or not at all."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.core.needs import Needs
from amberbox.core.types import Symptom
from amberbox.diagnosis.fmea.findings import RULE, finding_holds
from amberbox.diagnosis.fmea.model import DependencyStructure, Fmea, SymptomLink

PROOF: Final = "one of "
"""Begins the name of a conflict that no finding of the analysis proves."""


def components_by_symptom(fmea: Fmea) -> dict[str, frozenset[str]]:
    """Return per symptom the components whose failure modes, or whose loss, may show it."""
    found: dict[str, set[str]] = {}
    for mode in fmea.modes.values():
        for link in mode.symptoms:
            found.setdefault(link.symptom, set()).add(mode.component)
    needs = fmea.needs()
    for function in fmea.functions.values():
        below = _needed(needs, function.id) if function.symptoms else frozenset()
        for link in function.symptoms:
            found.setdefault(link.symptom, set()).update(below)
    return {symptom: frozenset(names) for symptom, names in found.items()}


def _needed(needs: Mapping[str, Needs], name: str) -> frozenset[str]:
    """Return all that something needs, directly or not."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        of = needs.get(waiting.pop())
        more = [other for other in (of.names() if of else ()) if other not in found]
        found.update(more)
        waiting += more
    return frozenset(found)


class BlockingRules:
    """The blocking rules of an analysis, by symptom.

    ``shown_by`` are per symptom the components whose failures may show it, ``down`` per symptom
    of a component whether something that takes the component down may show it.
    """

    def __init__(self, fmea: Fmea) -> None:
        self._by_itself = {name for name, symptom in fmea.symptoms.items() if symptom.by_itself}
        self._shown_by = components_by_symptom(fmea)
        self._down = _down(fmea)

    def is_evidence_by_itself(self, name: str) -> bool:
        """Return whether a symptom, and its absence, count whatever its component waits for."""
        return name in self._by_itself

    def lets_count(self, latest: Symptom, present: Collection[str]) -> bool:
        """Return whether a symptom counts that appears while these others are present.

        It does if nothing blocks it, or a component that can cause it, or only components that
        still serve: all of their symptoms have causes that do not take them down. It also does if
        the FMEA marks it as evidence about its own component.
        """
        blocking = {label.partition("/")[0] for label in latest.blocked_by}
        if (
            not blocking
            or latest.id in self._by_itself
            or not blocking.isdisjoint(self._shown_by.get(latest.id, frozenset()))
        ):
            return True
        return all(self._serves(component, present) for component in blocking)

    def _serves(self, component: str, present: Collection[str]) -> bool:
        own = self._down.get(component, {})
        seen = [down for symptom, down in own.items() if symptom in present]
        return bool(seen) and not any(seen)


def _down(fmea: Fmea) -> Mapping[str, Mapping[str, bool]]:
    """Return per component its symptoms, and whether faults that take it down can cause them."""
    structure = DependencyStructure.of(fmea.needs())
    found: dict[str, dict[str, bool]] = {}
    for mode in fmea.modes.values():
        lost = {mode.component, *structure.dependents([mode.component])} if mode.takes_down else ()
        for link in mode.symptoms:
            owner = link.symptom.replace(".", "/").partition("/")[0]
            own = found.setdefault(owner, {})
            own[link.symptom] = own.get(link.symptom, False) or owner in lost
    return found


# The state as which a symptom counts; empty if it is no evidence
Counts: TypeAlias = Literal["present", "absent", ""]


@dataclass(slots=True)
class SymptomPresence:
    """One symptom: its latest finding, and when it appeared and disappeared.

    ``seen`` is the finding when it appeared, with the latest size that was found since. After it is
    observed to be gone it is remembered for ``hold_ns``, that is until ``until_ns``, and only
    ``within_ns`` later it can count as absent. While it cannot be evaluated, ``left_ns`` of that
    time remain, for ``remember_ns`` at most.
    """

    latest: Symptom
    hold_ns: int = 0
    within_ns: int = 0
    remember_ns: int = 0
    seen: Symptom | None = None
    until_ns: int | None = None
    left_ns: int | None = None

    @property
    def is_there(self) -> bool:
        """Return whether the symptom is present now."""
        return self.seen is not None and self.until_ns is None

    def take(self, latest: Symptom, at_ns: int, counts: bool = True) -> None:
        """Process a finding at an instant; a symptom that returns while remembered counts as
        uninterrupted.

        ``counts`` is whether it counts if it appears now. A symptom that was present before
        continues to count.
        """
        was_present = self.counts_present(at_ns)
        self.latest = latest
        if latest.state == "present" and (was_present or counts):
            self.seen = self.seen if self.seen and was_present else latest
            if latest.size is not None:
                self.seen = replace(self.seen, size=latest.size)
            self.until_ns = self.left_ns = None
        elif was_present and self.is_absent:
            if self.until_ns is None:
                self.until_ns = at_ns + self.hold_ns
            elif self.left_ns is not None:
                self.until_ns = min(self.until_ns, at_ns + self.left_ns)
            self.left_ns = None
        elif was_present and latest.state != "present":
            self._hide(at_ns)

    def _hide(self, at_ns: int) -> None:
        """Suspend the hold time for a limited time: an unknown or blocked symptom is not observed
        as gone.
        """
        if self.left_ns is None:
            self.left_ns = self.hold_ns if self.until_ns is None else self.until_ns - at_ns
            self.until_ns = at_ns + self.remember_ns + self.left_ns

    def counts_present(self, at_ns: int) -> bool:
        """Return whether it is present, or disappeared so recently that it is remembered."""
        return self.is_there or (self.until_ns is not None and at_ns < self.until_ns)

    @property
    def is_absent(self) -> bool:
        """Return whether it is known to be absent, whether or not the absence counts."""
        return self.latest.state == "absent" and not self.latest.blocked_by

    def forgotten_since_ns(self, at_ns: int) -> int | None:
        """Return when the hold time of a gone symptom began; None while it is present or
        unknown.
        """
        if self.until_ns is None or (self.counts_present(at_ns) and not self._fades):
            return None
        return self.until_ns - self.hold_ns

    @property
    def _fades(self) -> bool:
        return self.left_ns is None and self.is_absent

    def forget(self, at_ns: int) -> None:
        """Limit the time for which it is remembered to an instant."""
        if self.until_ns is not None:
            self.until_ns = min(self.until_ns, at_ns)

    @property
    def gone_ns(self) -> int | None:
        """Return when (ns) it was seen to be gone; None while it is present or unknown."""
        return self.latest.confirmed_ns if self.is_absent and not self.is_there else None

    @property
    def may_be_absent_ns(self) -> int:
        """Return from when on (ns) its absence can count: ``within_ns`` after it is forgotten."""
        return 0 if self.until_ns is None else self.until_ns + self.within_ns

    @property
    def onset_ns(self) -> int:
        """Return its present onset, ns."""
        seen = self.seen or self.latest
        at_ns = seen.confirmed_ns if seen.onset_ns is None else seen.onset_ns
        return 0 if at_ns is None else at_ns

    def shown(self, counts: Counts) -> Symptom:
        """Return it as evidence: what does not count is unknown, or blocked."""
        if counts == "present":
            seen = self.seen or self.latest
            return replace(seen, state="present", blocked_by=(), gone_ns=self.gone_ns)
        if counts == "absent" or self.latest.blocked_by:
            return self.latest
        return replace(self.latest, state="unknown", gone_ns=self.gone_ns)


class SymptomPresences:
    """All symptoms found in this epoch, by id."""

    def __init__(self, fmea: Fmea) -> None:
        self._symptoms = fmea.symptoms
        holds = finding_holds(fmea)
        self._findings = {name: holds[name] for name in holds if name not in fmea.symptoms}
        self._remember_ns = round(fmea.remember_s * NS)
        self._blocking = BlockingRules(fmea)
        self._all: dict[str, SymptomPresence] = {}
        self._blocked: dict[str, None] = {}

    def begin(self) -> None:
        """Begin an epoch, in which nothing is known yet."""
        self._all.clear()
        self._blocked.clear()

    def knows(self, name: str) -> bool:
        """Return whether the analysis has a symptom, or a finding that is evidence."""
        return name in self._symptoms or self.is_finding(name)

    def is_finding(self, name: str) -> bool:
        """Return whether it is a finding: it is evidence only while it is present."""
        return name in self._findings or name.startswith(PROOF)

    def take(self, latest: Symptom, at_ns: int) -> None:
        """Process a finding at an instant; a symptom that counts by itself is never blocked."""
        if latest.blocked_by and self._blocking.is_evidence_by_itself(latest.id):
            latest = replace(latest, blocked_by=())
        presence = self._all.get(latest.id)
        if presence is None:
            presence = self._all[latest.id] = self._made(latest)
        self._judge(presence, latest, at_ns)
        if presence.is_there:
            for name in list(self._blocked):
                self._judge(self._all[name], self._all[name].latest, at_ns)

    def _judge(self, presence: SymptomPresence, latest: Symptom, at_ns: int) -> None:
        """Process a finding; a blocked one is processed again when more symptoms are present."""
        there = [name for name, one in self if one.is_there] if latest.blocked_by else ()
        presence.take(latest, at_ns, self._blocking.lets_count(latest, there))
        if presence.seen is not None and presence.is_there and self.is_finding(latest.id):
            presence.seen = replace(latest, onset_ns=presence.seen.onset_ns)
        if latest.state == "present" and not presence.is_there:
            self._blocked[latest.id] = None
        else:
            self._blocked.pop(latest.id, None)

    def _made(self, latest: Symptom) -> SymptomPresence:
        """Create the presence of a symptom, with its hold time and its longest delay."""
        symptom = self._symptoms.get(latest.id)
        if symptom is None:
            hold_ns = round(self._findings.get(latest.id, 0.0) * NS)
            is_remembered = latest.id in self._findings and not latest.id.startswith(RULE)
            return SymptomPresence(latest, hold_ns, 0, self._remember_ns if is_remembered else 0)
        hold_ns, within_ns = round(symptom.hold_s * NS), round(symptom.within_s * NS)
        return SymptomPresence(latest, hold_ns, within_ns, self._remember_ns)

    def __iter__(self) -> Iterator[tuple[str, SymptomPresence]]:
        return iter(self._all.items())

    def __getitem__(self, name: str) -> SymptomPresence:
        return self._all[name]

    def __contains__(self, name: str) -> bool:
        return name in self._all

    def onsets(self, at_ns: int) -> dict[str, int]:
        """Return the symptoms that count as present, the analysis' own, with their onsets."""
        return {
            name: one.onset_ns
            for name, one in self._all.items()
            if self.knows(name) and one.counts_present(at_ns)
        }

    def levels(
        self, names: Iterable[str], level_of: Callable[[Symptom], int | None]
    ) -> dict[str, int]:
        """Return the levels of the sizes of some symptoms, where they are known."""
        found = {name: level_of(self._all[name].shown("present")) for name in names}
        return {name: level for name, level in found.items() if level is not None}

    def counting(self, at_ns: int, waits_ns: Mapping[str, int]) -> dict[str, Counts]:
        """Return what each symptom counts as at an instant.

        Absence counts from the instant in ``waits_ns`` on. Findings, and symptoms that are not in
        the FMEA, count only while they are present.
        """
        return {name: self._counts(name, one, at_ns, waits_ns) for name, one in self}

    def _counts(
        self, name: str, one: SymptomPresence, at_ns: int, waits_ns: Mapping[str, int]
    ) -> Counts:
        if one.counts_present(at_ns):
            return "present"
        since_ns = max(one.may_be_absent_ns, waits_ns.get(name, 0))
        return "absent" if one.is_absent and name in self._symptoms and at_ns >= since_ns else ""

    def next_ns(self, at_ns: int, waits_ns: Mapping[str, int]) -> int | None:
        """Return when (ns) a symptom counts otherwise without a new finding; None for never."""
        times = (time for name, one in self for time in self._turns(name, one, waits_ns))
        return min((time for time in times if time > at_ns), default=None)

    def _turns(self, name: str, one: SymptomPresence, waits_ns: Mapping[str, int]) -> Iterator[int]:
        if one.until_ns is not None:
            yield one.until_ns
        if one.is_absent:
            yield max(one.may_be_absent_ns, waits_ns.get(name, 0))

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        plain: Any = msgspec.to_builtins
        return {
            name: [plain(one.latest), plain(one.seen), one.until_ns, one.left_ns]
            for name, one in self
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self.begin()
        for name, (latest, seen, until_ns, left_ns) in snapshot.items():
            presence = self._all[name] = self._made(msgspec.convert(latest, Symptom))
            presence.seen = msgspec.convert(seen, Symptom | None)
            presence.until_ns, presence.left_ns = until_ns, left_ns
            if presence.latest.state == "present" and not presence.is_there:
                self._blocked[name] = None


class AbsenceTimes:
    """The causes of each symptom, and the longest delay of each.

    Causes are failure modes, lost functions, and the faults of each component that are not in the
    FMEA. Functions that need a component that a mode takes down, directly or not, count as effects
    of the mode, regardless of redundancy.
    """

    def __init__(self, fmea: Fmea) -> None:
        self._shows = {cause: _slowest(links) for cause, links in _causes(fmea)}
        self._links = self._shows | dict(_unlisted(fmea))
        self._causes: dict[str, list[str]] = {}
        for cause, links in self._links.items():
            for symptom in links:
                self._causes.setdefault(symptom, []).append(cause)

    @property
    def shows(self) -> Mapping[str, Collection[str]]:
        """Return the symptoms of each failure mode and of each lost function."""
        return {cause: links.keys() for cause, links in self._shows.items()}

    def until_ns(self, onsets_ns: Mapping[str, int]) -> dict[str, int]:
        """Return until when to wait for absent symptoms, given the present ones.

        Each cause of a present symptom may have begun with the newest of its symptoms: an older one
        may have had another cause. From then on it has ``within_s`` of each link.
        """
        began_ns: dict[str, int] = {}
        for symptom, onset_ns in onsets_ns.items():
            for cause in self._causes.get(symptom, ()):
                began_ns[cause] = max(began_ns.get(cause, onset_ns), onset_ns)
        until_ns: dict[str, int] = {}
        for cause, at_ns in began_ns.items():
            for symptom, within_ns in self._links[cause].items():
                until_ns[symptom] = max(until_ns.get(symptom, 0), at_ns + within_ns)
        return until_ns


def _causes(fmea: Fmea) -> Iterator[tuple[str, list[SymptomLink]]]:
    structure = DependencyStructure.of(fmea.needs())
    for mode in fmea.modes.values():
        below = _shown_below(fmea, structure, mode.component) if mode.takes_down else []
        yield mode.id, [*mode.symptoms, *below]
    for function in fmea.functions.values():
        if function.symptoms:
            yield function.id, _shown_below(fmea, structure, function.id)


def _unlisted(fmea: Fmea) -> Iterator[tuple[str, dict[str, int]]]:
    """Yield the symptoms of each component's faults that are not in the FMEA, and how late."""
    if not fmea.other.share:
        return
    links: dict[str, list[SymptomLink]] = {}
    for mode in fmea.modes.values():
        links.setdefault(mode.component, []).extend(mode.symptoms)
    unshown, below = fmea.unshown(), fmea.unshown_below()
    for component, own in links.items():
        slowest = _slowest(own)
        for name in (*unshown.get(component, ()), *below.get(component, ())):
            slowest[name] = round(fmea.symptoms[name].within_s * NS)
        yield f"{component}# not in the FMEA", slowest


def _shown_below(fmea: Fmea, structure: DependencyStructure, name: str) -> list[SymptomLink]:
    """Return the symptoms of a loss, and those of other losses that may follow from it."""
    lost = sorted({name} | structure.dependents([name]))
    return [link for one in lost if one in fmea.functions for link in fmea.functions[one].symptoms]


def _slowest(links: list[SymptomLink]) -> dict[str, int]:
    slowest: dict[str, int] = {}
    for link in links:
        within_ns = round(link.within_s * NS)
        slowest[link.symptom] = max(slowest.get(link.symptom, 0), within_ns)
    return slowest
