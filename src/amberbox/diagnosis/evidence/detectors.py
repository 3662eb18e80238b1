"""Evidence from detectors: findings that other programs write into the record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.contracts import EvidenceFollower
from amberbox.core.given_findings import ITEMS, RecordedFinding, findings_in
from amberbox.core.types import Batch, Symptom
from amberbox.diagnosis.diagnose import suspicion
from amberbox.diagnosis.fmea.findings import COMBINED, RULE, finding_holds
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.knowledge import Knowledge

SOURCE = "detectors"
_MOST_STRENGTH = 1.0 - 1e-9
"""If a monitor has measured the same data, the monitor counts first."""
_MOST_UNKNOWN = 200
"""So many findings are shown that the analysis does not name; later ones are left out."""
_LEAST_ODDS = 10.0
"""Of a fault that is not in the analysis: absent symptoms of its component are still to count."""
_LONGEST_NS = 86_400 * NS
_TICK_NS = NS // 20  # findings count from the next instant at which monitors are evaluated


def follow(knowledge: Knowledge) -> EvidenceFollower:
    """Return the follower that reads findings as the record grows."""
    unlisted = [mode for mode in knowledge.model.modes if mode.is_unlisted]
    prior_of = {mode.id: mode.prior for mode in unlisted}
    priors: dict[str, float] = {}
    for mode in unlisted:
        priors[mode.component] = priors.get(mode.component, 0.0) + mode.prior
    for link in knowledge.model.links:
        if link.symptom.startswith(COMBINED):
            prior = prior_of.get(link.cause, 0.0) * link.detects
            priors[link.symptom] = priors.get(link.symptom, 0.0) + prior
    return DetectorFindings(knowledge.fmea, priors)


class DetectorFindings:
    """The findings of an epoch: rows in, symptoms out when a finding changes.

    Rows are read only if the analysis names a finding of a detector, or detectors run on the robot.
    A finding is as strong as its calibration says, unless the analysis states its leak. That
    detectors find an item unusual counts where no finding about the item is in the analysis, and
    only if a fault that is not in the analysis (``priors``, by finding) is more probable than a
    false alarm: by itself it opens no diagnosis that nothing is broken.
    """

    records = True
    history_s = 0.0

    def __init__(self, fmea: Fmea, priors: Mapping[str, float] | None = None) -> None:
        named = {name for name in finding_holds(fmea) if not name.startswith(RULE)}
        named |= {
            name for name, one in fmea.symptoms.items() if one.condition is None and "/" not in name
        }
        unmapped = {of.finding for of in fmea.findings if of.finding and not of.maps_to}
        self.items: frozenset[str] = ITEMS if named or unmapped else frozenset()
        self._named = named
        given = replace(fmea, unusual=(), findings=tuple(f for f in fmea.findings if f.is_given))
        self._given = frozenset(finding_holds(given))
        self._priors = priors or {}
        self._mapped: dict[str, set[str]] = {}
        self._readers = fmea.readers
        self._conflicts: dict[str, str] = {}
        self._known: dict[str, list[Any]] = {}
        self._new: list[tuple[Symptom, tuple[str, ...]]] = []
        self._until_ns = 0
        self._unread = 0

    @property
    def troubles(self) -> Mapping[str, str]:
        """Return how many findings could not be read, or are too many."""
        return {SOURCE: f"{self._unread:,} findings were left out"} if self._unread else {}

    def begin(self, at_ns: int) -> list[Symptom]:
        """Begin an epoch: every finding is unknown until it is written again."""
        known, self._known, self._new, self._until_ns = self._known, {}, [], at_ns
        self._mapped, self._conflicts = {}, {}
        return [
            Symptom(name, "unknown", name, None, at_ns, source=SOURCE)
            for name, content in known.items() if content[0] != "unknown"
        ]  # fmt: skip

    def feed(self, batch: Batch) -> None:
        """Take rows; those up to the last instant have been taken."""
        for at_ns, found in findings_in(batch) if batch.item in self.items else ():
            if at_ns <= self._until_ns:
                continue
            if found is None:
                self._unread += 1
            else:
                strength = found.strength if found.id in self._given else found.trust
                at_tick_ns = -(-at_ns // _TICK_NS) * _TICK_NS
                self._new.append((_symptom(found, strength, at_tick_ns), found.conflict))

    def _suspicion(self, symptom: Symptom, conflict: Sequence[str]) -> Iterator[Symptom]:
        """Yield the conflict that a finding is, which the analysis does not map otherwise.

        At least one of the components that have measured it is faulty, as far as the finding is
        right. It ends with the finding.
        """
        began = self._conflicts.pop(symptom.id, "")
        if symptom.state == "present" and conflict and symptom.id not in self._named:
            sets = (self._readers.get(a) or self._readers.get(_item_of(a)) or () for a in conflict)
            components = frozenset[str]().union(*sets)
            prior = sum(self._priors.get(name, 0.0) for name in components)
            if _ratio(symptom) * prior >= _LEAST_ODDS:
                name = suspicion(components)
                self._conflicts[symptom.id] = name
                yield replace(symptom, id=name, address=name)
        if began and began not in self._conflicts.values():
            yield Symptom(began, "absent", began, None, symptom.confirmed_ns, source=SOURCE)

    def receive(self, found: Sequence[object]) -> None:
        """Take nothing: monitors are evidence by themselves."""

    def advance(self, after_ns: int, until_ns: int) -> list[Symptom]:
        """Return the findings that change in ``(after_ns, until_ns]``, in order of time."""
        self._new.sort(key=lambda new: _confirmed_ns(new[0]))
        due = [new for new in self._new if _confirmed_ns(new[0]) <= until_ns]
        self._new = self._new[len(due) :]
        self._until_ns = max(self._until_ns, until_ns)
        found: list[Symptom] = []
        for symptom, conflict in due:
            found += [self._counted(symptom), *self._suspicion(symptom, conflict)]
        return [symptom for symptom in found if self._is_news(symptom)]

    def _counted(self, symptom: Symptom) -> Symptom:
        """Return a finding as it counts: it is absent where it says nothing."""
        item = symptom.id.split(".")[2] if symptom.id.count(".") > 1 else ""
        if symptom.id in self._named and not symptom.id.startswith(COMBINED):
            lasting = self._mapped.setdefault(item, set())
            (lasting.add if symptom.state == "present" else lasting.discard)(symptom.id)
        if symptom.state != "present" or symptom.id not in self._named:
            return symptom
        says_nothing = symptom.strength <= 0
        if symptom.id in self._priors:
            says_nothing |= _ratio(symptom) * self._priors[symptom.id] < _LEAST_ODDS or bool(
                self._mapped.get(item)
            )
        return replace(symptom, state="absent", onset_ns=None) if says_nothing else symptom

    def _is_news(self, symptom: Symptom) -> bool:
        """Return whether a finding differs from the last one of its id; too many are left out."""
        measured = [address for address, _, _ in symptom.evidence]
        content = [symptom.state, symptom.strength, symptom.size, measured]
        if self._known.get(symptom.id) == content:
            return False
        if symptom.id not in self._known and self._is_too_much(symptom.id):
            self._unread += 1
            return False
        self._known[symptom.id] = content
        return True

    def _is_too_much(self, name: str) -> bool:
        unnamed = sum(known not in self._named for known in self._known)
        return name not in self._named and unnamed >= _MOST_UNKNOWN

    def snapshot(self, until_ns: int) -> dict[str, Any]:
        """Return the state needed by ``resume``, as JSON; later rows are fed again."""
        mapped = {item: sorted(names) for item, names in self._mapped.items() if names}
        return {
            "known": self._known,
            "unread": self._unread,
            "mapped": mapped,
            "conflicts": self._conflicts,
        }

    def resume(self, snapshot: Mapping[str, Any], until_ns: int) -> None:
        """Go on from what ``snapshot`` returned."""
        self._known, self._unread = dict(snapshot["known"]), snapshot["unread"]
        self._mapped = {item: set(n) for item, n in snapshot.get("mapped", {}).items()}
        self._conflicts = dict(snapshot.get("conflicts", {}))
        self._new, self._until_ns = [], until_ns


def _symptom(found: RecordedFinding, strength: float, at_ns: int) -> Symptom:
    """Return the symptom that a finding is; one that began in the future begins now."""
    if found.state != "present":
        return Symptom(found.id, found.state, found.id, None, at_ns, source=SOURCE)
    began_ns = at_ns if found.onset_ns is None else found.onset_ns
    onset_ns = began_ns if at_ns - _LONGEST_NS <= began_ns <= at_ns else at_ns
    size = found.size if found.size is not None and isfinite(found.size) else None
    return Symptom(
        found.id, "present", found.id, onset_ns, at_ns, min(strength, _MOST_STRENGTH),
        SOURCE, tuple((address, onset_ns, at_ns) for address in found.measured),
        reason=found.reason, size=size,
    )  # fmt: skip


def _ratio(symptom: Symptom) -> float:
    """Return the likelihood ratio of a present finding with a failure mode that surely shows it."""
    return (1.0 + symptom.strength) / (1.0 - symptom.strength)


def _item_of(address: str) -> str:
    return address.partition(".")[0]


def _confirmed_ns(symptom: Symptom) -> int:
    return symptom.confirmed_ns or 0
