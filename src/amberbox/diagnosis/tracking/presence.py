"""What was told of each symptom, and what of it counts: present, remembered, absent, nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.core.types import Symptom
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.tracking.blocking import Blocking

Counts: TypeAlias = Literal["present", "absent", ""]
"""What a symptom counts as; empty if it is no evidence."""


@dataclass(slots=True)
class Presence:
    """One symptom: what was told last, and when it came and went.

    ``seen`` is what was told when it came. Seen to be gone it is remembered for ``hold_ns``,
    that is until ``until_ns``, and only ``within_ns`` later it can count as absent. While nobody
    can look, ``left_ns`` of that are left, for ``remember_ns`` at most.
    """

    told: Symptom
    hold_ns: int = 0
    within_ns: int = 0
    remember_ns: int = 0
    seen: Symptom | None = None
    until_ns: int | None = None
    left_ns: int | None = None

    @property
    def is_there(self) -> bool:
        """Tell whether it is there now."""
        return self.seen is not None and self.until_ns is None

    def take(self, told: Symptom, at_ns: int, counts: bool = True) -> None:
        """Take what is told of it at an instant; what comes back in time never went.

        ``counts`` is whether it counts if it comes now. What was there before goes on to count.
        """
        was_present = self.counts_present(at_ns)
        self.told = told
        if told.state == "present" and (was_present or counts):
            self.seen = self.seen if was_present else told
            self.until_ns = self.left_ns = None
        elif was_present and self.is_absent:
            self._fade(at_ns)
        elif was_present and told.state != "present":
            self._hide(at_ns)

    def _fade(self, at_ns: int) -> None:
        """Begin to forget, or go on where nobody could look: it is seen absent."""
        if self.until_ns is None:
            self.until_ns = at_ns + self.hold_ns
        elif self.left_ns is not None:
            self.until_ns = min(self.until_ns, at_ns + self.left_ns)
        self.left_ns = None

    def _hide(self, at_ns: int) -> None:
        """Stop to forget, for a limited time: unknown or blocked, it is not seen to be gone."""
        if self.left_ns is None:
            self.left_ns = self.hold_ns if self.until_ns is None else self.until_ns - at_ns
            self.until_ns = at_ns + self.remember_ns + self.left_ns

    def counts_present(self, at_ns: int) -> bool:
        """Tell whether it is there, or went so short ago that it is remembered."""
        return self.is_there or (self.until_ns is not None and at_ns < self.until_ns)

    @property
    def is_absent(self) -> bool:
        """Tell whether it is known not to be there, whether that counts or not."""
        return self.told.state == "absent" and not self.told.blocked_by

    def forgotten_since_ns(self, at_ns: int) -> int | None:
        """Return since when it is being forgotten; None while it is there, or hidden."""
        if self.until_ns is None or (self.counts_present(at_ns) and not self._fades):
            return None
        return self.until_ns - self.hold_ns

    @property
    def _fades(self) -> bool:
        return self.left_ns is None and self.is_absent

    def forget(self, at_ns: int) -> None:
        """Remember it no longer than to an instant."""
        if self.until_ns is not None:
            self.until_ns = min(self.until_ns, at_ns)

    @property
    def gone_ns(self) -> int | None:
        """When it was seen to be gone; None while it is there, or nobody can tell."""
        return self.told.confirmed_ns if self.is_absent and not self.is_there else None

    @property
    def may_be_absent_ns(self) -> int:
        """From when on its absence can count: what takes long to come takes long to go."""
        return 0 if self.until_ns is None else self.until_ns + self.within_ns

    @property
    def onset_ns(self) -> int:
        """When it began to be there, this time."""
        seen = self.seen or self.told
        return _time(seen.confirmed_ns if seen.onset_ns is None else seen.onset_ns)

    def shown(self, counts: Counts) -> Symptom:
        """Return it as evidence: what does not count is unknown, or blocked."""
        if counts == "present":
            seen = self.seen or self.told
            return replace(seen, state="present", blocked_by=(), gone_ns=self.gone_ns)
        if counts == "absent" or self.told.blocked_by:
            return self.told
        return replace(self.told, state="unknown", gone_ns=self.gone_ns)


class Presences:
    """All symptoms that were told of in this epoch, by id."""

    def __init__(self, fmea: Fmea) -> None:
        self._symptoms = fmea.symptoms
        self._remember_ns = round(fmea.remember_s * NS)
        self._blocking = Blocking(fmea)
        self._all: dict[str, Presence] = {}
        self._blocked: dict[str, None] = {}

    def begin(self) -> None:
        """Begin an epoch: nothing is known."""
        self._all.clear()
        self._blocked.clear()

    def knows(self, name: str) -> bool:
        """Tell whether the analysis has a symptom."""
        return name in self._symptoms

    def take(self, told: Symptom, at_ns: int) -> None:
        """Take what is told of a symptom at an instant."""
        presence = self._all.get(told.id)
        if presence is None:
            presence = self._all[told.id] = self._made(told)
        self._judge(presence, told, at_ns)
        if presence.is_there:
            for name in list(self._blocked):
                self._judge(self._all[name], self._all[name].told, at_ns)

    def _judge(self, presence: Presence, told: Symptom, at_ns: int) -> None:
        """Take what is told; what is there but blocked is judged again when more is there."""
        there = [name for name, one in self if one.is_there] if told.blocked_by else ()
        presence.take(told, at_ns, self._blocking.lets_count(told, there))
        if told.state == "present" and not presence.is_there:
            self._blocked[told.id] = None
        else:
            self._blocked.pop(told.id, None)

    def _made(self, told: Symptom) -> Presence:
        """Make the presence of a symptom: how long it is remembered and may take to come."""
        symptom = self._symptoms.get(told.id)
        if symptom is None:
            return Presence(told)
        hold_ns, within_ns = round(symptom.hold_s * NS), round(symptom.within_s * NS)
        return Presence(told, hold_ns, within_ns, self._remember_ns)

    def __iter__(self) -> Iterator[tuple[str, Presence]]:
        return iter(self._all.items())

    def __getitem__(self, name: str) -> Presence:
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

    def counting(self, at_ns: int, waits_ns: Mapping[str, int]) -> dict[str, Counts]:
        """Return what each symptom counts as at an instant.

        Absence counts from the instant in ``waits_ns`` on. What the analysis does not have
        counts only while it is there.
        """
        return {name: self._counts(name, one, at_ns, waits_ns) for name, one in self}

    def _counts(self, name: str, one: Presence, at_ns: int, waits_ns: Mapping[str, int]) -> Counts:
        if one.counts_present(at_ns):
            return "present"
        since_ns = max(one.may_be_absent_ns, waits_ns.get(name, 0))
        return "absent" if one.is_absent and self.knows(name) and at_ns >= since_ns else ""

    def next_ns(self, at_ns: int, waits_ns: Mapping[str, int]) -> int | None:
        """Return when something else counts next without anything told; None for never."""
        times = (time for name, one in self for time in self._turns(name, one, waits_ns))
        return min((time for time in times if time > at_ns), default=None)

    def _turns(self, name: str, one: Presence, waits_ns: Mapping[str, int]) -> Iterator[int]:
        if one.until_ns is not None:
            yield one.until_ns
        if one.is_absent:
            yield max(one.may_be_absent_ns, waits_ns.get(name, 0))

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        plain: Any = msgspec.to_builtins
        return {
            name: [plain(one.told), plain(one.seen), one.until_ns, one.left_ns]
            for name, one in self
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self.begin()
        for name, (told, seen, until_ns, left_ns) in snapshot.items():
            presence = self._all[name] = self._made(msgspec.convert(told, Symptom))
            presence.seen = msgspec.convert(seen, Symptom | None)
            presence.until_ns, presence.left_ns = until_ns, left_ns
            if presence.told.state == "present" and not presence.is_there:
                self._blocked[name] = None


def _time(at_ns: int | None) -> int:
    return 0 if at_ns is None else at_ns
