"""What a proof takes from the manifest besides a journal's seal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.manifest_entries import (
    ManifestSignature,
    SealedJournal,
    Tombstone,
    to_record,
)
from amberbox.link.uploads import proof_of

SEALED = SealedJournal("journal/000002-x-0000.mcap", "main", 2, 0, 0, 9, 1, 2, 10, "", "00", 10, "")
GONE = Tombstone(
    ("journal/000001-x-0000.mcap",), "both", "main", 1, 0, 9, 5, 9, "", "for room", False, 10
)
SIGNED = ManifestSignature("00", 1, "00", "00")


def test_what_was_deleted_unconfirmed_goes_along_wherever_it_stands(tmp_path: Path) -> None:
    """A robot that was offline deletes after signatures, and after seals of journals it deletes
    next.
    """
    confirmed = replace(GONE, run=7, confirmed=True)
    entries: list[SealedJournal | Tombstone | ManifestSignature] = [
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
