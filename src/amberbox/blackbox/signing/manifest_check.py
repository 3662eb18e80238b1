"""Check the manifest: each line's hash, the chain, the signatures, and which keys are trusted.

Heads (noted earlier, or signed in the store) are compared with it, and files missing from the
sequence of a writer are named.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from amberbox.blackbox.journal.chunk import open_buffer
from amberbox.blackbox.signing.findings import BAD, FindingState, VerifyFinding
from amberbox.blackbox.signing.journal_check import (
    FIRST_CHAIN,
    CheckedJournal,
    links,
    undo_one_flipped_bit,
)
from amberbox.blackbox.signing.keys import PUBLIC, can_sign, holds, is_key, public_key, to_pem
from amberbox.blackbox.signing.signatures import (
    HEADS,
    SIGNED_WRITERS,
    JournalReach,
    SignedHeads,
    parse_heads,
    signature_message,
)
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_lines
from amberbox.blackbox.store.manifest import Manifest
from amberbox.blackbox.store.manifest_entries import (
    ManifestSignature,
    SealedJournal,
    Tombstone,
    from_record,
)
from amberbox.blackbox.store.store import FOLDERS, run_and_number
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timestamps import maybe_time


@dataclass(frozen=True, slots=True)
class _HashedLine:
    """A line that holds, or held before a bit of it was flipped."""

    number: int
    offset: int
    record: dict[str, Any]


@dataclass(slots=True)
class CheckedManifest:
    """The content of the lines and how far they are trusted.

    ``hashes`` are the numbers of the lines with each hash, ``sealed`` those that seal each journal;
    ``signatures`` are the valid ones, with their line; ``claims`` are the statements of each line
    on files other than sealed ones; ``known`` is the manifest as a whole.
    """

    hashes: dict[str, int] = field(default_factory=dict)
    sealed: dict[str, tuple[int, SealedJournal]] = field(default_factory=dict)
    signatures: list[tuple[int, ManifestSignature]] = field(default_factory=list)
    claims: list[tuple[int, str, str]] = field(default_factory=list)
    first_hash: str = ""
    checkpoint: str = ""
    last_hash: str = manifest_lines.FIRST_HASH
    findings: list[VerifyFinding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    size: int = 0
    known: Manifest = field(default_factory=Manifest)

    def signed(self, key: str) -> tuple[int, ManifestSignature] | None:
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
        if text.endswith(manifest_lines.NONSENSE):
            checked.findings.append(_finding("altered", text, 0, len(content)))
    return checked


def _lines(content: bytes, checked: CheckedManifest) -> Iterator[_HashedLine]:
    """Yield the lines whose hash holds; add findings for the others."""
    found = list(manifest_lines.split(content))
    last_hash = manifest_lines.FIRST_HASH
    for place, line in enumerate(found):
        if line.damaged or line.mended:
            piece = content[line.offset : line.offset + line.size].split(b"\n")[0]
            after = next((later.records[0] for later in found[place + 1 :] if later.records), None)
            checked.findings += _bad_line(line, piece, after, last_hash)
        for record in line.records:
            yield _HashedLine(line.number, line.offset, record)
            last_hash = record["hash"]


def _bad_line(
    line: manifest_lines.ManifestLine, piece: bytes, after: Mapping[str, Any] | None, last_hash: str
) -> Iterator[VerifyFinding]:
    """Yield a finding for a line whose hash does not hold."""
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


def _finding(state: FindingState, text: str, offset: int, size: int) -> VerifyFinding:
    return VerifyFinding(state, mf.NAME, text, None, offset, offset + size)


def _check_order(found: Sequence[_HashedLine], checked: CheckedManifest) -> None:
    """Check that each line names the one before it."""
    all_hashes = {line.record["hash"] for line in found}
    expected = manifest_lines.FIRST_HASH
    for place, line in enumerate(found):
        prev = line.record["prev"]
        if place == 0 and line.record["kind"] == manifest_lines.CHECKPOINT:
            checked.checkpoint = prev
        elif prev != expected:
            checked.findings.append(_break(line, moved=prev in all_hashes))
        checked.first_hash = checked.first_hash or line.record["hash"]
        checked.hashes[line.record["hash"]] = line.number
        expected = line.record["hash"]
    checked.last_hash = expected


def _break(line: _HashedLine, *, moved: bool) -> VerifyFinding:
    if moved:
        text = f"line {line.number} is not where it was written: lines were moved"
        return _finding("altered", text, line.offset, 0)
    text = f"lines before line {line.number} are gone"
    return _finding("missing", text, line.offset, 0)


def _take(line: _HashedLine, store_id: str, checked: CheckedManifest, *, can_check: bool) -> None:
    try:
        entry = from_record(line.record)
        claims = list(_claims(line.record, entry))
    except manifest_lines.MALFORMED:
        return  # the manifest's reader has named it
    checked.claims += [(line.number, *claim) for claim in claims]
    if isinstance(entry, SealedJournal):
        first, known = checked.sealed.setdefault(entry.journal, (line.number, entry))
        if known != entry:
            text = f"line {line.number} says of {entry.journal} otherwise than line {first}"
            checked.findings.append(_finding("altered", text, line.offset, 0))
    elif isinstance(entry, ManifestSignature) and can_check:
        message = signature_message(store_id, entry.head, entry.at_ns)
        if holds(entry.key, entry.signature, message):
            checked.signatures.append((line.number, entry))
        else:
            text = f"the signature in line {line.number} does not hold"
            checked.findings.append(_finding("altered", text, line.offset, 0))


def _claims(record: Mapping[str, Any], entry: object) -> Iterator[tuple[str, str]]:
    """Yield the files that a line lists or states as deleted, each with the statement."""
    if isinstance(entry, Tombstone):
        yield from ((name, f"was deleted ({entry.reason})") for name in entry.journals)
    elif record["kind"] == "deleted":
        yield str(record["path"]), "was deleted"
    elif record["kind"] == "segment":
        yield str(record["segment"]["path"]), "is as it was written"


@dataclass(frozen=True, slots=True)
class KeyTrust:
    """The key that is believed, and up to which line of the manifest it has signed."""

    key: str = ""
    signed_line: int = 0
    signed_ns: int | None = None
    findings: Sequence[VerifyFinding] = ()
    notes: Sequence[str] = ()

    @property
    def is_signed(self) -> bool:
        """Return whether there is any valid signature."""
        return self.signed_line > 0


def check_trust(given: str, store: Path, lines: CheckedManifest) -> KeyTrust:
    """Choose the trusted key and check its signatures."""
    if not can_sign():
        note = "signatures are not checked: the package cryptography is not installed"
        return KeyTrust(notes=(note,))
    last = lines.signatures[-1][1] if lines.signatures else None
    key, notes, findings = _choose(given, store, last)
    covered = lines.signed(key)
    if last is not None and last.key != key:
        text = f"the last signature is not by {key[:16]}..., but by {last.key}"
        findings.append(VerifyFinding("altered", mf.NAME, text))
    others = {s.key for _, s in lines.signatures} - {key}
    if others and not findings:
        notes.append(f"the key was replaced: {len(others)} other signed before")
    if covered is None:
        return KeyTrust(key, findings=findings, notes=notes)
    return KeyTrust(key, covered[0], covered[1].at_ns, findings, notes)


def _choose(
    given: str, store: Path, last: ManifestSignature | None
) -> tuple[str, list[str], list[VerifyFinding]]:
    """Return the key to trust; one that differs from ``key.pub`` by a bit shows damage there."""
    published = public_key(store)
    if given or (last is None and published is None):
        return given, [], []
    if last is not None and published != last.key and _held_before_flip(store / PUBLIC, last.key):
        return last.key, [], [VerifyFinding("damaged", PUBLIC, "one bit is flipped")]
    if published is not None:
        note = "the store's own key.pub is believed: give --key as noted at the first start"
        return published, [note], []
    text = "is gone or cannot be read; the key that the signatures state is believed"
    return "" if last is None else last.key, [], [VerifyFinding("damaged", PUBLIC, text)]


def check_public(store: Path, trust: KeyTrust) -> Iterator[VerifyFinding]:
    """Compare the bytes of the public key's file with those written."""
    if any(finding.file == PUBLIC for finding in trust.findings):
        return
    content, published = (store / PUBLIC).read_bytes(), public_key(store)
    if published is not None and content.decode("ascii", "replace") != to_pem(published):
        yield VerifyFinding("damaged", PUBLIC, "holds the key, but is not as it was written")


def _held_before_flip(path: Path, key: str) -> bool:
    """Return whether a file held a public key before one bit of it was flipped."""
    content = path.read_bytes() if path.exists() else b""
    return undo_one_flipped_bit(content, partial(is_key, key)) is not None


def unsigned_ends(
    trust: KeyTrust,
    lines: CheckedManifest,
    by_writer: Mapping[str, Sequence[CheckedJournal]],
    heads: SignedHeads | None,
) -> list[VerifyFinding]:
    """Return from when on no signature covers the manifest and each journal."""
    if not can_sign() or not (trust.key or lines.signatures):
        return [VerifyFinding("unsigned", mf.NAME, "nothing here is signed: the store has no key")]
    signed = heads if heads is not None and heads.signature else None
    found = []
    last = max(lines.hashes.values(), default=0)
    signed_up_to = max(trust.signed_line, lines.hashes.get(signed.manifest, 0) if signed else 0)
    if last - sum(number == last for number, _ in lines.signatures) > signed_up_to:
        found.append(_manifest_end(last - signed_up_to, trust.signed_ns))
    found += _unsigned_claims(lines, signed_up_to)
    for writer in SIGNED_WRITERS:
        found += _journal_end(by_writer.get(writer, ()), lines, signed_up_to, signed)
    return found


def _unsigned_claims(lines: CheckedManifest, signed_up_to: int) -> Iterator[VerifyFinding]:
    """Yield the files whose fate is stated only by lines that are not signed yet."""
    for number, file, text in lines.claims:
        if number > signed_up_to:
            yield VerifyFinding(
                "unsigned", file, f"{text}, says line {number}, which is not signed"
            )


def _manifest_end(count: int, at_ns: int | None) -> VerifyFinding:
    when = f" at {maybe_time(at_ns)}" if at_ns is not None else ""
    return VerifyFinding("unsigned", mf.NAME, f"ends unsigned{when}: {count} lines", from_ns=at_ns)


def _journal_end(
    files: Sequence[CheckedJournal],
    lines: CheckedManifest,
    signed_up_to: int,
    heads: SignedHeads | None,
) -> Iterator[VerifyFinding]:
    """Find the first byte of a writer's journal that no signature covers."""
    loose = [(c, _covered(c, heads)) for c in files if not _is_sealed(c, lines, signed_up_to)]
    open_ends = [(c, to) for c, to in loose if c.size > to and not _ends_at(c, to)]
    if not open_ends:
        return
    first, covered = open_ends[0]
    at_ns = first.places.end_ns(covered) if covered else first.places.start_ns()
    size = sum(checked.size - to for checked, to in open_ends)
    text = f"ends unsigned at {maybe_time(at_ns)}: " if at_ns is not None else "is unsigned: "
    text += f"{size} bytes in {len(open_ends)} files are vouched for by their own chain only"
    if first.torn:
        text += f"; the last {first.torn} bytes are no whole record (a crash or power cut)"
    end_ns = open_ends[-1][0].places.end_ns()
    yield VerifyFinding(
        "unsigned", first.target.name, text, None, covered, first.size, at_ns, end_ns
    )


def _is_sealed(checked: CheckedJournal, lines: CheckedManifest, signed_up_to: int) -> bool:
    """Return whether a signed line of the manifest covers a whole file."""
    if any(finding.state in BAD for finding in checked.findings):
        return True  # it has been named already
    entry = lines.sealed.get(checked.target.name)
    return entry is not None and entry[0] <= signed_up_to


def _covered(checked: CheckedJournal, heads: SignedHeads | None) -> int:
    """Return up to which byte the robot's signed heads cover a file."""
    if heads is None:
        return 0
    reaches = [r for r in heads.writers.values() if r.file == checked.target.name]
    return reaches[0].bytes if reaches else 0


def _ends_at(checked: CheckedJournal, byte: int) -> bool:
    """Return whether nothing but the end of the file follows a link."""
    return byte > 0 and byte == checked.tail_from and checked.finished


JournalNumber = tuple[int, int]  # run and number of a file


def journal_number(name: str) -> JournalNumber:
    """Read run and number from a journal's name."""
    return run_and_number(Path(PurePosixPath(name).name))


class DeletedFiles:
    """Deliberate deletions: the places in a writer's runs, and the links they ended at."""

    def __init__(self, tombstones: Iterable[Tombstone]) -> None:
        self._raw = [t for t in tombstones if t.what != "columns" and t.journals]

    def holds(self, writer: str, place: JournalNumber) -> bool:
        """Return whether the file at a place was deleted on purpose."""
        return any(
            stone.writer == writer
            and journal_number(stone.journals[0]) <= place <= journal_number(stone.journals[-1])
            for stone in self._raw
        )

    def chains(self, writer: str) -> Iterator[str]:
        """Yield the links that deleted files ended at."""
        return (stone.chain for stone in self._raw if stone.writer == writer)


def check_continuity(
    writer: str,
    files: Sequence[CheckedJournal],
    sealed: Mapping[str, SealedJournal],
    graves: DeletedFiles,
) -> Iterator[VerifyFinding]:
    """Yield missing files of a writer: sealed ones, missing numbers, and breaks of the chain.

    ``files`` are those on the disk in the order in which they were written.
    """
    on_disk = {journal_number(checked.target.name) for checked in files}
    of_writer = [entry for entry in sealed.values() if entry.writer == writer]
    known = set(on_disk)
    for entry in of_writer:
        place = journal_number(entry.journal)
        if place not in on_disk and not graves.holds(writer, place):
            known.add(place)
            text = f"is gone: {entry.bytes} bytes, {entry.end_seq - entry.first_seq} messages"
            yield VerifyFinding(
                "missing", entry.journal, text, None, 0, entry.bytes, entry.start_ns, entry.end_ns
            )
    holes = [p for p in _holes(known) if not graves.holds(writer, p)]
    for run, number in holes:
        name = f"{FOLDERS[writer]}/{run:06d}-*-{number:04d}.mcap"
        yield VerifyFinding("missing", name, f"file {number} of run {run} is gone")
    ends = {FIRST_CHAIN, *graves.chains(writer), *(entry.chain for entry in of_writer)}
    before: CheckedJournal | None = None
    for checked in files:
        if not _goes_on(checked, before, ends, holes) and not _is_explained(checked, before):
            yield _broken(checked, before)
        ends |= {checked.chain, checked.start_chain}
        before = checked


def _holes(known: set[JournalNumber]) -> Iterator[JournalNumber]:
    """Yield the numbers that a run has skipped; it counts its files from 0 on."""
    for run in {run for run, _ in known}:
        numbers = {number for of_run, number in known if of_run == run}
        yield from ((run, number) for number in range(max(numbers)) if number not in numbers)


def _goes_on(
    checked: CheckedJournal,
    before: CheckedJournal | None,
    ends: set[str],
    holes: Sequence[JournalNumber],
) -> bool:
    """Return whether a file continues the chain of another one."""
    start, place = checked.start_chain, journal_number(checked.target.name)
    if start in ends or not start:
        return True
    if any(hole[0] == place[0] and hole < place for hole in holes):
        return True  # the missing part in between is reported already
    return before is not None and start in _all_links(before)


def _all_links(checked: CheckedJournal) -> set[str]:
    """Return every link of a file: an import may have begun while it was being written."""
    try:
        with open_buffer(checked.target.path) as data:
            return {link.chain for link in links(data)}
    except OSError:
        return set()


def _is_explained(checked: CheckedJournal, before: CheckedJournal | None) -> bool:
    """Return whether an earlier finding explains why the chain breaks at this file."""
    both = [*checked.findings, *(before.findings if before is not None else ())]
    return any(finding.state in BAD for finding in both)


def _broken(checked: CheckedJournal, before: CheckedJournal | None) -> VerifyFinding:
    start_ns = checked.places.start_ns()
    if before is None:
        text = "is not the first file: what was written before it is gone"
        return VerifyFinding("missing", checked.target.name, text, to_ns=start_ns)
    text = f"does not go on from the end of {before.target.name}: files between them are gone,"
    text += " or the end of that one"
    end_ns = before.places.end_ns()
    return VerifyFinding("missing", checked.target.name, text, None, None, None, end_ns, start_ns)


SHORTEST = 16
_HINT = "give 16 to 64 hex digits of a head that verify printed, or a copy of heads.json"
_MOST_BYTES = 3_000


@dataclass(frozen=True, slots=True)
class NotedHead:
    """The head given by ``--head``: (the beginning of) a hash, or a whole statement."""

    given: str
    hash: str = ""
    heads: SignedHeads | None = None


def read_noted_head(text: str) -> NotedHead:
    """Parse a noted head; raises UsageError when it is none."""
    plain = text.strip().lower()
    if SHORTEST <= len(plain) <= 64 and set(plain) <= set("0123456789abcdef"):
        return NotedHead(text, hash=plain)
    try:
        content = text if plain.startswith("{") else Path(text).read_text()
        return NotedHead("--head" if plain.startswith("{") else text, heads=parse_heads(content))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise UsageError(f"no head in {text}: {why}", _HINT) from None


@dataclass(frozen=True)
class KnownHashes:
    """The hashes of a store among which a head can be looked up."""

    store_id: str
    manifest: CheckedManifest
    files: Mapping[str, CheckedJournal]
    sealed: Mapping[str, SealedJournal]
    graves: DeletedFiles

    def where(self, digits: str) -> str:
        """Return the position of a hash that begins with these digits; empty if there is none."""
        for hash_, number in self.manifest.hashes.items():
            if hash_.startswith(digits):
                return f"line {number} of the manifest"
        if self.manifest.checkpoint.startswith(digits):
            return "the manifest as it was before it was condensed"
        for name, checked in self.files.items():
            if any(link.chain.startswith(digits) for link in checked.noted):
                return name
        for entry in self.sealed.values():
            if entry.chain.startswith(digits):
                return f"{entry.journal}, as it was sealed"
        gone = any(
            chain.startswith(digits)
            for writer in SIGNED_WRITERS
            for chain in self.graves.chains(writer)
        )
        return "a journal that was deleted on purpose since" if gone else ""


def check_noted_head(
    noted: NotedHead, known: KnownHashes, key: str
) -> tuple[list[VerifyFinding], str]:
    """Look up a noted head; return findings, and a note on it.

    Raises AmberboxError when it is a copy of ``heads.json`` with an invalid signature.
    """
    if noted.heads is not None:
        refuse_forged(noted.heads, known.store_id, key)
        found = list(check_heads(noted.heads, known, noted.given))
        return found, "" if found else "the head holds: everything up to it is as it was"
    where = known.where(noted.hash)
    if where:
        return [], f"head {noted.hash[:SHORTEST]} stands in {where}: all before it is as it was"
    text = f"the head {noted.hash[:SHORTEST]} is nowhere in this store: its newest part was cut"
    text += " off or altered after the head was noted"
    return [VerifyFinding("missing", noted.given, text)], ""


def refuse_forged(heads: SignedHeads, store_id: str, key: str) -> None:
    """Raise AmberboxError when heads are not this robot's."""
    hint = "take the copy that was made from heads.json at the last contact"
    if heads.store_id != store_id:
        raise AmberboxError(f"the head is that of another store ({heads.store_id})", hint)
    if key and not heads.signature:
        raise AmberboxError("the head is not signed", hint)
    if heads.signature and can_sign() and not heads.holds():
        raise AmberboxError("the signature of the head does not hold", hint)
    if key and heads.key != key:
        raise AmberboxError(f"the head is signed with another key ({heads.key})", hint)


def check_heads(heads: SignedHeads, known: KnownHashes, file: str) -> Iterator[VerifyFinding]:
    """Compare a statement with the store: yield the missing part of each journal."""
    lines = known.manifest
    stands = heads.manifest in lines.hashes or heads.manifest == lines.checkpoint
    condensed = lines.checkpoint and heads.since != lines.first_hash  # after it was stated
    if not stands and heads.manifest != "0" * 64 and not condensed:
        text = f"the line that {file} names is gone: the newest lines were cut off or changed"
        yield VerifyFinding("missing", mf.NAME, text, to_ns=heads.at_ns)
    for writer, reach in heads.writers.items():
        yield from _check_reach(writer, reach, known, heads.at_ns)


def _check_reach(
    writer: str, reach: JournalReach, known: KnownHashes, at_ns: int
) -> Iterator[VerifyFinding]:
    checked = known.files.get(reach.file)
    if checked is None:
        graves = known.graves.holds(writer, journal_number(reach.file))
        if not graves and reach.file not in known.sealed:  # else its seal has named it
            text = f"is gone: run {reach.run} of {writer} reached position {reach.next_seq}"
            yield VerifyFinding("missing", reach.file, text, None, 0, reach.bytes, to_ns=at_ns)
    elif not any(link.chain == reach.chain for link in checked.noted):
        yield from _not_reached(writer, reach, checked, at_ns)


def _not_reached(
    writer: str, reach: JournalReach, checked: CheckedJournal, at_ns: int
) -> Iterator[VerifyFinding]:
    """Yield the missing part of a file that does not reach as far as stated."""
    if any(f.state in ("altered", "damaged", "missing") for f in checked.findings):
        return  # its findings explain it
    name, last = checked.target.name, checked.last
    if checked.tail_from >= reach.bytes:
        text = "the file is sound in itself, but not the one that was stated: it was written anew"
        yield VerifyFinding("altered", name, text, None, 0, reach.bytes, to_ns=at_ns)
        return
    first = last.next_seq if last is not None else 0
    text = f"ends too early: positions {first} to {reach.next_seq} of run {reach.run} of"
    text += f" {writer} are gone"
    from_ns = checked.places.end_ns(checked.tail_from)
    yield VerifyFinding("missing", name, text, None, checked.tail_from, reach.bytes, from_ns, at_ns)


@dataclass(frozen=True, slots=True)
class StoredHeads:
    """The heads file of a store: its bytes, and its content if it can be read."""

    content: bytes | None = None
    heads: SignedHeads | None = None


def read_stored_heads(store: Path) -> StoredHeads:
    """Read the statement before anything else: all that is read later reaches further."""
    try:
        content = (store / HEADS).read_bytes()
    except OSError:
        return StoredHeads()
    try:
        return StoredHeads(content, parse_heads(content))
    except ValueError:
        return StoredHeads(content)


def check_stored_heads(
    own: StoredHeads, known: KnownHashes, key: str
) -> tuple[list[VerifyFinding], SignedHeads | None]:
    """Check the ``heads.json`` of the store; None if there is no usable one."""
    heads = own.heads
    if own.content is None:
        text = "there is none: nobody states how far the journals reach"
        return list(_unstated(known, text)), None
    if heads is None:
        return [_bad_heads(own.content, "cannot be read")], None
    if not heads.signature and not _is_plain(own.content):
        return [_bad_heads(own.content, "is not as it was written")], None
    if heads.signature and key and (heads.key != key or not heads.holds()):
        return [_bad_heads(own.content, "is not signed with the robot's key")], None
    if heads.store_id != known.store_id:
        return [
            VerifyFinding("altered", HEADS, f"is that of another store ({heads.store_id})")
        ], None
    unsigned = _unstated(known, "is not signed") if not heads.signature else ()
    return [*unsigned, *check_heads(heads, known, HEADS)], heads


def _is_plain(content: bytes) -> bool:
    """Return whether a ``heads.json`` has only the keys that Amberbox writes."""
    known = {field.name for field in fields(SignedHeads)}
    return set(json.loads(content)) <= known


def _unstated(known: KnownHashes, text: str) -> Iterator[VerifyFinding]:
    """Yield a finding if heads are missing in a store that has signatures."""
    if known.manifest.signatures:
        yield VerifyFinding("unsigned", HEADS, text)


def _bad_heads(content: bytes, text: str) -> VerifyFinding:
    may_mend = len(content) <= _MOST_BYTES and not _is_signed(content)
    if may_mend and undo_one_flipped_bit(content, _is_signed) is not None:
        return VerifyFinding("damaged", HEADS, "one bit is flipped")
    return VerifyFinding("altered", HEADS, text)


def _is_signed(content: bytes) -> bool:
    try:
        heads = parse_heads(content)
    except ValueError:
        return False
    return can_sign() and bool(heads.signature) and heads.holds()


def wanted_links(noted: Sequence[NotedHead], own: StoredHeads) -> tuple[str, ...]:
    """Return the links that the journals are to be searched for."""
    statements = [heads for heads in (own.heads, *(n.heads for n in noted)) if heads is not None]
    wanted = {entry.hash for entry in noted if entry.hash}
    wanted |= {reach.chain for heads in statements for reach in heads.writers.values()}
    return tuple(sorted(wanted))
