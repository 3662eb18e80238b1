"""What a proof takes from the manifest besides a journal's seal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from amberbox.blackbox.segments import manifest
from amberbox.blackbox.segments.entries import Sealed, Signature, Tombstone, to_record
from amberbox.link.proof import proof_of

SEALED = Sealed("journal/000002-x-0000.mcap", "main", 2, 0, 0, 9, 1, 2, 10, "", "00", 10, "")
GONE = Tombstone(
    ("journal/000001-x-0000.mcap",), "both", "main", 1, 0, 9, 5, 9, "", "for room", False, 10
)
SIGNED = Signature("00", 1, "00", "00")


def test_what_was_deleted_unconfirmed_goes_along_wherever_it_stands(tmp_path: Path) -> None:
    """A robot that was away deletes after signatures, and behind seals of what it deletes next."""
    confirmed = replace(GONE, run=7, confirmed=True)
    entries: list[Sealed | Tombstone | Signature] = [
        GONE,
        confirmed,
        SIGNED,
        SEALED,
        SIGNED,
        replace(GONE, run=2),
    ]
    manifest.append(tmp_path, [to_record(entry) for entry in entries])
    proof = proof_of(tmp_path, SEALED.journal)
    assert proof is not None
    assert [line.count('"kind":"gone"') for line in (proof.lines, proof.gone)] == [0, 2]
    assert '"run":7' not in proof.gone
