"""The words in drawings; pages give those of their catalogue."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Words:
    """Everything that a drawing says by itself; ``{n}`` and ``{k}`` are filled with numbers."""

    ok: str = "fine"
    warn: str = "warning"
    error: str = "error"
    stale: str = "stale"
    unknown: str = "unknown"
    gap: str = "nothing known"
    cause: str = "cause"
    more_fine: str = "+{n} fine"
    needs: str = "needs"
    part_of: str = "part of"
    indirect: str = "needs, by way of what is fine"
    circle: str = "closes a circle"
    may_be_broken: str = "What may be broken"
    fails: str = "What fails with it"
    seen: str = "What is seen"
    present: str = "seen"
    absent: str = "should show, does not"
    unsure: str = "not known"
    unexplained: str = "seen, not explained"
    more: str = "and {n} more"
    gate_and: str = "all of"
    gate_or: str = "any of"
    gate_vote: str = "{k} of {n}"
    gate_xor: str = "only one of"
    gate_not: str = "not"
    gate_nand: str = "not all of"
    gate_nor: str = "none of"
    transfer: str = "drawn elsewhere"
    below: str = "{n} below"
    in_cut_set: str = "in this combination"
    severity: str = "How bad it is"
    occurrence: str = "How often it happens"
    modes: str = "{n} failure modes"
    recorded: str = "recorded"
    lost: str = "lost"
    deleted: str = "deleted"
    filtered: str = "left out on purpose"
    incident: str = "incident"

    def level(self, level: str) -> str:
        """Return the word of a level; of one that there is not, the level itself."""
        known = {
            "ok": self.ok,
            "warn": self.warn,
            "error": self.error,
            "stale": self.stale,
            "unknown": self.unknown,
            "gap": self.gap,
        }
        return known.get(level, level)


WORDS = Words()
