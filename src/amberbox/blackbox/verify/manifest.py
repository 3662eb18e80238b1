"""Check the manifest: each line's own hash, the chain from line to line, and the signatures."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.blackbox.segments import lines
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Sealed, Signature, Tombstone, from_record
from amberbox.blackbox.segments.manifest import Manifest
from amberbox.blackbox.signing.keys import holds
from amberbox.blackbox.signing.signing import signature_message
from amberbox.blackbox.verify.findings import Finding, State


@dataclass(frozen=True, slots=True)
class Line:
    """A line that holds, or held before a bit of it was flipped."""

    number: int
    offset: int
    record: dict[str, Any]


@dataclass(slots=True)
class CheckedManifest:
    """What the lines say and how far they can be believed.

    ``hashes`` are the numbers of the lines with each hash, ``sealed`` those that seal each journal;
    ``signatures`` are those that hold, with the line they stand in; ``claims`` is what each line
    says of other files than sealed ones; ``known`` is what it all says.
    """

    hashes: dict[str, int] = field(default_factory=dict)
    sealed: dict[str, tuple[int, Sealed]] = field(default_factory=dict)
    signatures: list[tuple[int, Signature]] = field(default_factory=list)
    claims: list[tuple[int, str, str]] = field(default_factory=list)
    first_hash: str = ""
    checkpoint: str = ""
    last_hash: str = lines.FIRST_HASH
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    size: int = 0
    known: Manifest = field(default_factory=Manifest)

    def signed(self, key: str) -> tuple[int, Signature] | None:
        """Return the last line that a key has signed, and its signature."""
        covered = [
            (self.hashes[s.head], s)
            for _, s in self.signatures
            if s.key == key and s.head in self.hashes
        ]
        return max(covered, key=lambda pair: pair[0], default=None)


def check_manifest(store: Path, store_id: str, *, can_check: bool) -> CheckedManifest:
    """Read a manifest line by line and check it; signatures where they can be checked."""
    checked = CheckedManifest()
    try:
        content = (store / mf.NAME).read_bytes()
    except FileNotFoundError:
        return checked
    checked.size = len(content)
    found = list(_lines(content, checked))
    _check_order(found, checked)
    for line in found:
        _take(line, store_id, checked, can_check=can_check)
    checked.known = mf.read_lines(store)
    for text in checked.known.damage:
        if text.endswith(lines.NONSENSE):
            checked.findings.append(_finding("altered", text, 0, len(content)))
    return checked


def _lines(content: bytes, checked: CheckedManifest) -> Iterator[Line]:
    """Give the lines whose hash holds; say of the others what is wrong with them."""
    found = list(lines.split(content))
    last_hash = lines.FIRST_HASH
    for place, line in enumerate(found):
        if line.damaged or line.mended:
            piece = content[line.offset : line.offset + line.size].split(b"\n")[0]
            after = next((later.records[0] for later in found[place + 1 :] if later.records), None)
            checked.findings += _bad_line(line, piece, after, last_hash)
        for record in line.records:
            yield Line(line.number, line.offset, record)
            last_hash = record["hash"]


def _bad_line(
    line: lines.Line, piece: bytes, after: Mapping[str, Any] | None, last_hash: str
) -> Iterator[Finding]:
    """Say what became of a line whose hash does not hold; nothing of one torn by a crash."""
    number, where = line.number, (line.offset, len(piece))
    if line.mended:
        yield _finding("damaged", f"line {number}: one bit is flipped", *where)
    elif after is not None and after["prev"] != last_hash:
        yield _finding("altered", f"line {number} was changed", *where)
    elif _is_json(piece):
        yield _finding("altered", f"line {number} was added or changed", *where)
    elif after is None:
        text = f"line {number} is torn: it was being written at a crash or power cut"
        yield _finding("unsigned", text, *where)


def _is_json(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def _finding(state: State, text: str, offset: int, size: int) -> Finding:
    return Finding(state, mf.NAME, text, None, offset, offset + size)


def _check_order(found: Sequence[Line], checked: CheckedManifest) -> None:
    """Check that each line names the one before it."""
    all_hashes = {line.record["hash"] for line in found}
    expected = lines.FIRST_HASH
    for place, line in enumerate(found):
        prev = line.record["prev"]
        if place == 0 and line.record["kind"] == lines.CHECKPOINT:
            checked.checkpoint = prev
        elif prev != expected:
            checked.findings.append(_break(line, moved=prev in all_hashes))
        checked.first_hash = checked.first_hash or line.record["hash"]
        checked.hashes[line.record["hash"]] = line.number
        expected = line.record["hash"]
    checked.last_hash = expected


def _break(line: Line, *, moved: bool) -> Finding:
    if moved:
        text = f"line {line.number} is not where it was written: lines were moved"
        return _finding("altered", text, line.offset, 0)
    text = f"lines before line {line.number} are gone"
    return _finding("missing", text, line.offset, 0)


def _take(line: Line, store_id: str, checked: CheckedManifest, *, can_check: bool) -> None:
    try:
        entry = from_record(line.record)
        claims = list(_claims(line.record, entry))
    except lines.MALFORMED:
        return  # the manifest's reader has named it
    checked.claims += [(line.number, *claim) for claim in claims]
    if isinstance(entry, Sealed):
        first, known = checked.sealed.setdefault(entry.journal, (line.number, entry))
        if known != entry:
            text = f"line {line.number} says of {entry.journal} otherwise than line {first}"
            checked.findings.append(_finding("altered", text, line.offset, 0))
    elif isinstance(entry, Signature) and can_check:
        message = signature_message(store_id, entry.head, entry.at_ns)
        if holds(entry.key, entry.signature, message):
            checked.signatures.append((line.number, entry))
        else:
            text = f"the signature in line {line.number} does not hold"
            checked.findings.append(_finding("altered", text, line.offset, 0))


def _claims(record: Mapping[str, Any], entry: object) -> Iterator[tuple[str, str]]:
    """Give the files that a line lists or says to be deleted, and what it says."""
    if isinstance(entry, Tombstone):
        yield from ((name, f"was deleted ({entry.reason})") for name in entry.journals)
    elif record["kind"] == "deleted":
        yield str(record["path"]), "was deleted"
    elif record["kind"] == "segment":
        yield str(record["segment"]["path"]), "is as it was written"
