"""A diagnosis that is open: its id, its last revision, what is still to be seen absent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Literal, TypeAlias

import msgspec

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.tracking.presence import Counts

News: TypeAlias = Literal["", "less", "more"]
"""What is new in the evidence: nothing, only that something has gone, or something else."""
LIKELY = 0.02
"""Hypotheses that are less probable than this may change their order without a revision."""
MOVED = 0.01
"""A revision is due when a probability has moved by more than this."""
FORGOTTEN_NS = 3600 * NS
"""So long without any present symptom, and a diagnosis is over, seen absent or not."""
_LONGEST_NAME = 46
"""What remains of an id's 64 characters for the robot."""


@dataclass(slots=True)
class Opening:
    """A diagnosis from its first symptom until all have healed.

    ``evidence`` is what its last answer took into account, as far as it still counts; ``had`` are
    symptoms that have counted as present.
    ``waiting`` are symptoms that it had and that have not been seen absent since.
    ``quiet_since_ns`` is since when none is present; None while one is.
    """

    id: str
    last: Diagnosis | None = None
    evidence: dict[str, Counts] = field(default_factory=dict)
    waiting: set[str] = field(default_factory=set)
    quiet_since_ns: int | None = None
    had: set[str] = field(default_factory=set)

    @property
    def next_revision(self) -> int:
        """Return the number of the next revision."""
        return 1 if self.last is None else self.last.revision + 1

    def take_evidence(self, counting: Mapping[str, Counts], *, fading: bool = False) -> News:
        """Take what counts now; return what is new in it.

        ``more``: something shows, or an absence begins to count. ``less``: something that showed
        counts no longer; while other symptoms are ``fading``, also if it counts as absent.
        """
        evidence: dict[str, Counts] = {name: counts for name, counts in counting.items() if counts}
        changed = {name for name, counts in evidence.items() if self.evidence.get(name) != counts}
        lost = {name for name, counts in self.evidence.items() if counts == "present"}
        lost -= {name for name, counts in evidence.items() if counts == "present"}
        is_more = any(
            evidence[name] == "present" or name not in self.had or not fading for name in changed
        )
        self.had |= {name for name, counts in evidence.items() if counts == "present"}
        self.evidence = evidence
        return "more" if is_more else "less" if lost or changed else ""

    def revise(self, made: Diagnosis) -> bool:
        """Take an answer; tell whether it differs from the last revision."""
        if self.last is not None and not differs(self.last, made):
            return False
        self.last = made
        return True

    def is_over(self, at_ns: int) -> bool:
        """Tell whether it has healed, or nothing was seen of it for too long."""
        if self.quiet_since_ns is None:
            return False
        return not self.waiting or at_ns - self.quiet_since_ns >= FORGOTTEN_NS

    def healed(self, at_ns: int) -> list[Diagnosis]:
        """Return the last revision: the last answer, healed."""
        if self.last is None:
            return []
        return [replace(self.last, revision=self.next_revision, at_ns=at_ns, state="healed")]

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        return {
            "id": self.id,
            "last": msgspec.to_builtins(self.last, order="deterministic"),
            "evidence": dict(self.evidence),
            "waiting": sorted(self.waiting),
            "quiet_since_ns": self.quiet_since_ns,
            "had": sorted(self.had),
        }

    @classmethod
    def resumed(cls, snapshot: Mapping[str, Any]) -> Opening:
        """Return what ``snapshot`` was made of."""
        return msgspec.convert(snapshot, cls)


def identified(robot: str, at_ns: int, last_id: str) -> str:
    """Name a diagnosis by when it opens; a letter if the last one has that name already."""
    when = datetime.fromtimestamp(at_ns // NS, UTC).strftime("%Y%m%dt%H%M%S")
    name = f"{robot[:_LONGEST_NAME]}-{when}"
    if not last_id.startswith(name):
        return name
    letter = last_id.removeprefix(name)
    return name + (chr(ord(letter) + 1) if letter else "a")


def differs(before: Diagnosis, after: Diagnosis) -> bool:
    """Tell whether an answer differs so that a revision is due."""
    return _said(before) != _said(after) or _moved(before, after)


def _said(one: Diagnosis) -> tuple[object, ...]:
    leading = one.hypotheses[0] if one.hypotheses else None
    why = None if leading is None else (leading.id, leading.explains, leading.unexplained)
    proposed = one.next_tests[0].id if one.next_tests else ""
    about = one.findings, one.incomplete, one.make_safe
    return why, frozenset(one.symptoms), proposed, *about


def _moved(before: Diagnosis, after: Diagnosis) -> bool:
    """Tell whether likely hypotheses stand in another order, or with another probability."""
    was = {one.id: one.probability for one in before.hypotheses}
    now = {one.id: one.probability for one in after.hypotheses}
    likely = {name for shares in (was, now) for name, share in shares.items() if share >= LIKELY}
    if [name for name in was if name in likely] != [name for name in now if name in likely]:
        return True
    return any(abs(was[name] - now[name]) > MOVED for name in likely)
