"""The words in drawings; pages give those of their catalogue."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Words:
    """Everything that a drawing says by itself; ``{n}`` and ``{k}`` are filled with numbers."""

    ok: str
    warn: str
    error: str
    stale: str
    unknown: str
    gap: str
    cause: str
    more_fine: str
    needs: str
    part_of: str
    indirect: str
    circle: str
    may_be_broken: str
    fails: str
    seen: str
    present: str
    absent: str
    unsure: str
    unexplained: str
    more: str
    gate_and: str
    gate_or: str
    gate_vote: str
    gate_xor: str
    gate_not: str
    gate_nand: str
    gate_nor: str
    transfer: str
    below: str
    in_cut_set: str
    severity: str
    occurrence: str
    modes: str
    recorded: str
    lost: str
    deleted: str
    filtered: str
    incident: str

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
