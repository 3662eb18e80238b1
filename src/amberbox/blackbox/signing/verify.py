"""Verify a store: manifest, journals, segments, incidents, small files, and heads noted earlier."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal.chunk import open_buffer
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.journal.tail import HEAD_NAME, is_padded, read_head
from amberbox.blackbox.signing.findings import (
    BAD,
    READ_ERRORS,
    FindingCollector,
    FindingState,
    HeadHash,
    VerifyFinding,
    VerifyReport,
)
from amberbox.blackbox.signing.journal_check import (
    CheckedJournal,
    CheckTarget,
    check_journal,
    check_target,
    links,
    undo_one_flipped_bit,
)
from amberbox.blackbox.signing.keys import PRIVATE, PUBLIC, can_sign, is_private_key
from amberbox.blackbox.signing.manifest_check import (
    CheckedManifest,
    DeletedFiles,
    KeyTrust,
    KnownHashes,
    NotedHead,
    check_continuity,
    check_manifest,
    check_noted_head,
    check_public,
    check_stored_heads,
    check_trust,
    read_noted_head,
    read_stored_heads,
    unsigned_ends,
    wanted_links,
)
from amberbox.blackbox.signing.signatures import HEADS, LOCKS, SignedHeads
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.incident import (
    FILE,
    RING,
    StoredIncident,
    from_line,
    incident_folder,
    load_all,
    same_window,
)
from amberbox.blackbox.store.item_names import (
    NAMES,
    names_text,
    new_names,
    recorded_names,
    stated_names,
    wrong_names,
)
from amberbox.blackbox.store.manifest import Manifest
from amberbox.blackbox.store.manifest_entries import SealedJournal, Segment
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import (
    FOLDERS,
    IDENTITY,
    INCIDENTS,
    Store,
    identity_text,
    is_locked,
    open_store,
    stated_id,
)

# How much may be hashed in search of a flipped bit: some ten seconds
_MOST_HASHED_BYTES = 3_000_000_000
_PAGE_HEAD_BYTES = 100


def check_segment(
    store: Path, segment: Segment, sealed: Mapping[str, SealedJournal], by_hash: Mapping[str, str]
) -> tuple[list[VerifyFinding], int]:
    """Hash a segment; return the findings on it, and its size in bytes.

    ``by_hash`` names the segment that each hash belongs to.
    """
    path = store / segment.path
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            size = file.tell()
    except FileNotFoundError:
        return [_finding("missing", segment, f"is gone: {segment.rows} rows")], 0
    if digest != segment.sha256:
        return [_changed(path, segment, size, by_hash.get(digest))], size
    return _other_source(segment, sealed), size


def _finding(state: FindingState, segment: Segment, text: str) -> VerifyFinding:
    from_ns, to_ns = segment.received_range_ns
    return VerifyFinding(
        state, segment.path, text, None, 0, segment.bytes, from_ns, to_ns, segment.item
    )


def _changed(path: Path, segment: Segment, size: int, other: str | None) -> VerifyFinding:
    """Return why a segment has another hash."""
    if other is not None:
        return _finding("missing", segment, f"is not there: under its name lies {other}")
    if size < segment.bytes:
        return _finding("missing", segment, f"the last {segment.bytes - size} bytes were cut off")
    if size > segment.bytes:
        return _finding("altered", segment, f"{size - segment.bytes} bytes were added")
    if not _readable(path):
        return _finding("damaged", segment, "a page does not match its checksum")
    if can_build() and _one_bit(path, segment.sha256):
        return _finding("damaged", segment, "one bit around its pages is flipped")
    return _finding("altered", segment, "its checksums hold, but it is not the file it was")


def _readable(path: Path) -> bool:
    """Read all pages with their checksums; true without pyarrow."""
    if not can_build():
        return True
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            for batch in file.iter_batches():
                batch.validate()
    except (pa.ArrowException, OSError, ValueError):
        return False
    return True


def _one_bit(path: Path, sha256: str) -> bool:
    """Return whether one flipped bit outside the checksums (footer, heads of pages) explains it."""
    content = path.read_bytes()
    left = _MOST_HASHED_BYTES
    for start, end in _unchecked(path, content):
        left -= 8 * (end - start) * (len(content) - start)
        if left < 0:
            break
        rest = content[end:]
        holds = _ends_in(hashlib.sha256(content[:start]), rest, sha256)
        if undo_one_flipped_bit(content[start:end], holds) is not None:
            return True
    return False


def _unchecked(path: Path, content: bytes) -> Iterator[tuple[int, int]]:
    """Yield the parts of a Parquet file that have no checksum, from its end on."""
    length = int.from_bytes(content[-8:-4], "little") + 8
    footer = max(len(content) - length, 0)
    yield footer, len(content)
    for start in sorted(_page_starts(path), reverse=True):
        yield start, min(start + _PAGE_HEAD_BYTES, len(content))


def _page_starts(path: Path) -> Iterator[int]:
    """Yield where the first pages of each column begin."""
    import pyarrow.parquet as pq

    metadata = pq.read_metadata(path)
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            yield column.data_page_offset
            if column.dictionary_page_offset is not None:
                yield column.dictionary_page_offset


def _ends_in(before: hashlib._Hash, rest: bytes, sha256: str) -> Callable[[bytes], bool]:
    def holds(part: bytes) -> bool:
        whole = before.copy()
        whole.update(part + rest)
        return whole.hexdigest() == sha256

    return holds


def _other_source(segment: Segment, sealed: Mapping[str, SealedJournal]) -> list[VerifyFinding]:
    """Compare the source journal of columns with the sealed one."""
    for part in segment.parts:
        entry = sealed.get(part.journal)
        if entry is not None and part.head and part.head != entry.chain:
            text = f"was not made from {part.journal} as it was sealed"
            return [_finding("altered", segment, text)]
    return []


def check_incidents(store: Store, known: Manifest) -> Iterator[tuple[str, list[VerifyFinding]]]:
    """Yield each incident's file with its findings, and those on its missing ring journals."""
    folders = {path.parent.name for path in (store.path / INCIDENTS).glob(f"[!.]*/{FILE}")}
    released = {incident.id for incident in load_all(store) if not incident.is_pinned}
    for incident_id in sorted(folders | known.incidents.keys()):
        line = known.incidents.get(incident_id)
        name = f"{INCIDENTS}/{incident_id}/{FILE}"
        yield name, list(_check(store, incident_id, name, line))
        held = line if line is not None and incident_id not in released else None
        for lost in _lost_ring(store, held) if held is not None else ():
            yield lost, [VerifyFinding("missing", lost, "is gone: the incident held it")]


def _check(
    store: Store, incident_id: str, name: str, line: Mapping[str, Any] | None
) -> Iterator[VerifyFinding]:
    registered = _registered(line)
    try:
        content = (incident_folder(store, incident_id) / FILE).read_bytes()
        found = msgspec.json.decode(content, type=StoredIncident)
        document = msgspec.json.decode(content)
    except FileNotFoundError:
        if registered is not None and registered.is_pinned:
            yield _incidents_finding(
                "missing", name, f"is gone: {registered.text or 'no reason given'}", registered
            )
        return
    except (msgspec.MsgspecError, UnicodeDecodeError):
        yield _incidents_finding(
            "damaged", name, "cannot be read; the manifest says what it holds", registered
        )
        return
    plain = msgspec.json.format(msgspec.json.encode(document), indent=2)
    if not document.keys() <= {f.name for f in fields(StoredIncident)} or plain != content:
        yield _incidents_finding("damaged", name, "is not as it was written", registered)
        return
    yield from _compare(name, found, registered, line or {})


def _compare(
    name: str, found: StoredIncident, registered: StoredIncident | None, line: Mapping[str, Any]
) -> Iterator[VerifyFinding]:
    if registered is None:
        yield _incidents_finding(
            "unsigned", name, "no line of the manifest speaks of it yet", found
        )
        return
    before = (registered.reasons, registered.made_ns, registered.versions)
    if (found.reasons[: len(registered.reasons)], found.made_ns, found.versions) != before:
        yield _incidents_finding(
            "altered", name, "reasons or versions are not those written down", registered
        )
    elif found.told != found.state:
        yield _incidents_finding(
            "unsigned", name, "was changed after it was written down last", found
        )
    elif not same_window(found, registered) or line.get("bytes", found.bytes) != found.bytes:
        yield _incidents_finding(
            "altered", name, "is not as it was written down in the manifest", registered
        )


def _registered(line: Mapping[str, Any] | None) -> StoredIncident | None:
    try:
        return None if line is None else from_line(line)
    except READ_ERRORS:
        return None


def _lost_ring(store: Store, line: Mapping[str, Any]) -> Iterator[str]:
    """Yield the ring's journals that an incident held when it was complete."""
    about = line["incident"]
    for name in line.get("ring", ()) if about["state"] == "complete" else ():
        if not (incident_folder(store, about["id"]) / RING / name).exists():
            yield f"{INCIDENTS}/{about['id']}/{RING}/{name}"


def _incidents_finding(
    state: FindingState, name: str, text: str, about: StoredIncident | None
) -> VerifyFinding:
    if about is None:
        return VerifyFinding(state, name, text)
    return VerifyFinding(state, name, text, from_ns=about.from_ns, to_ns=about.to_ns)


Found = Iterator[tuple[str, list[VerifyFinding]]]
NOT_SIGNED = "not covered by what this store signed"
# Why a file is not covered, by pattern; the first that fits counts
_REASONS = (
    (NAMES, NOT_SIGNED),
    ("run", "the number of the last run: a wrong one at most skips numbers"),
    (f"*/{HEAD_NAME}", "a hint for those who follow live: its next write replaces it"),
    ("heads.json", NOT_SIGNED),
    (PRIVATE, "the private key: nobody can tell without its public half"),
    (PUBLIC, "there is no signature to check it with"),
    ("room", "how much room there is: measured anew every few seconds"),
    ("reserve", "room for the last events: what is in it means nothing"),
    ("full", "why only events are recorded now: stated anew by the keeper"),
    ("lock.*", "who writes right now"),
    ("state/*", "what a source remembers: without it the source finds out anew"),
    ("requests/*", "asked for, not yet written down by the keeper"),
    ("importing/*", "an import that is under way or was broken off: no part of the record yet"),
    ("link*", "what the link to a server remembers"),
    ("docked", "what the link to a server remembers"),
    ("run.json", "what the processes of the robot are doing now"),
    ("segments/*", "no line of the manifest tells of it: no part of the record"),
    ("incidents/*", "no line of the manifest tells of it yet"),
    ("*.part", "left by a process that was killed while it wrote"),
    ("*.tmp", "left by a process that was killed while it wrote"),
    ("*", "no part of the record"),
)


def check_derived(store: Store, known: Manifest, public: str) -> Found:
    """Yield the files whose content follows from others, with their findings.

    ``public`` is the trusted key (hex; empty for none).
    """
    yield IDENTITY, list(_identity(store))
    if known.names or (store.path / NAMES).exists():
        yield NAMES, list(_names(store.path, known))
    for folder in FOLDERS.values():
        path = store.path / folder / HEAD_NAME
        if path.exists():
            yield f"{folder}/{HEAD_NAME}", list(_head(store, path))
    yield from _others(store, public)


def _others(store: Store, public: str) -> Found:
    run, key = store.path / "run", store.path / PRIVATE
    if run.exists():
        yield "run", list(_run(store, run))
    holds = is_private_key(public, store.path) if public and key.exists() else None
    if holds is not None:
        text = "cannot be read, or is not the key that signed"
        yield PRIVATE, [] if holds else [VerifyFinding("damaged", PRIVATE, text)]
    for path in sorted((store.path / "requests").glob("*.json")):
        name = f"requests/{path.name}"
        if not _is_json(path):
            yield name, [VerifyFinding("damaged", name, "cannot be read")]


def _identity(store: Store) -> Iterator[VerifyFinding]:
    path = store.path / IDENTITY
    if not path.exists():
        yield VerifyFinding("missing", IDENTITY, f"is gone; the journals name {store.id}")
    elif not stated_id(store.path):
        yield VerifyFinding("damaged", IDENTITY, f"cannot be read; the journals name {store.id}")
    elif json.loads(path.read_text()) != json.loads(identity_text(store.id)):
        yield VerifyFinding("damaged", IDENTITY, "does not say what it was written with")


def _names(store: Path, known: Manifest) -> Iterator[VerifyFinding]:
    stated = stated_names(store)
    if not (store / NAMES).exists():
        yield VerifyFinding(
            "missing", NAMES, f"is gone: it held the names of {len(known.names)} items"
        )
    elif stated is None:
        yield VerifyFinding(
            "damaged", NAMES, "cannot be read; the record tells the names of its items"
        )
    else:
        wrong = wrong_names(stated, recorded_names(store))
        foreign = stated.keys() - known.names.keys() - new_names(stated, known.names).keys()
        if wrong:
            text = f"does not name {', '.join(sorted(wrong.values()))} as the record does"
            yield VerifyFinding("altered", NAMES, text)
        elif foreign:
            text = f"gives a name that another topic has: {', '.join(sorted(foreign))}"
            yield VerifyFinding("altered", NAMES, text)
        elif (store / NAMES).read_text() != names_text(stated):
            yield VerifyFinding("damaged", NAMES, "is not as it was written")
        elif known.names and new_names(stated, known.names):
            yield VerifyFinding("unsigned", NAMES, "has names that the keeper has not signed yet")


def _head(store: Store, path: Path) -> Iterator[VerifyFinding]:
    name = f"{path.parent.name}/{path.name}"
    found = read_head(path.parent) or read_head(path.parent)  # written just then
    if found is None:
        yield VerifyFinding(
            "damaged", name, "its checksum does not hold; its next write replaces it"
        )
    elif found.store_id != store.id:
        yield VerifyFinding("altered", name, f"is that of another store ({found.store_id})")
    elif not is_padded(path.parent):
        yield VerifyFinding("damaged", name, "bytes after its content are not as they were written")


def _run(store: Store, path: Path) -> Iterator[VerifyFinding]:
    try:
        stated = int(path.read_text())
    except (OSError, ValueError):
        yield VerifyFinding("damaged", "run", "is no number; the journals tell the last run")
        return
    last = max(store.runs(), default=0)
    if stated < last:
        yield VerifyFinding("damaged", "run", f"says {stated}, but there is a run {last}")


def _is_json(path: Path) -> bool:
    try:
        return isinstance(json.loads(path.read_text()), dict)
    except FileNotFoundError:  # seen to meanwhile
        return True
    except (OSError, ValueError):
        return False


def uncovered(store: Store, covered: Collection[str], known: Manifest) -> dict[str, str]:
    """Return why each file of a store is not covered that was not checked against anything."""
    found = {}
    files = filter(Path.is_file, store.path.rglob("*"))
    names = {path.relative_to(store.path).as_posix() for path in files}
    for folder in FOLDERS.values():
        if any(name.startswith(f"{folder}/") for name in names):
            names.add(f"{folder}/{HEAD_NAME}")
    for name in sorted(names - set(covered)):
        if fnmatch(name, f"{INCIDENTS}/*/ring/*") and f"ring/{Path(name).name}" in covered:
            continue  # the same file by two names
        found[name] = next(reason for pattern, reason in _REASONS if fnmatch(name, pattern))
    for name in covered:
        if fnmatch(name, "ring/*.mcap") or fnmatch(name, f"{INCIDENTS}/*/ring/*"):
            found[name] = "of the ring: its own checksums hold, but nothing tells where it ended"
    if NAMES in covered and not known.names:
        found[NAMES] = NOT_SIGNED
    return found


THREADS = 2  # hashing runs beside Python; more threads would use the robot's other processors
_ATTEMPTS = 3


def verify(path: Path, *, key: str = "", noted: Sequence[str] = ()) -> VerifyReport:
    """Check everything in a store.

    ``key`` is the public key (hex) as noted at the first start, else the store's own is believed.
    ``noted`` are heads: hashes, or signed statements as text or files. A keeper that works on the
    store meanwhile is no trouble. Raises UsageError for a head that is none, AmberboxError for one
    that is not this robot's.
    """
    heads = [read_noted_head(text) for text in noted]
    for _ in range(_ATTEMPTS):
        before = mf.read(path).last_hash
        report = _Verification(path, key, heads).run()
        missing = any(finding.state == "missing" for finding in report.findings)
        if not missing or mf.read(path).last_hash == before:
            break
    return report


class _Verification:
    """One pass over a store."""

    def __init__(self, path: Path, key: str, noted: Sequence[NotedHead]) -> None:
        self.store = open_store(path)
        self.key = key
        self.noted = noted
        self.own = read_stored_heads(path)
        self.collected = FindingCollector()
        self.notes: list[str] = []
        self.bytes = 0

    def run(self) -> VerifyReport:
        """Check all parts; the results of one are used in the next."""
        path = self.store.path
        store_id = self._store_id()
        lines = check_manifest(path, store_id, can_check=can_sign())
        trust = self._trust(lines)
        manifest = lines.known
        self.collected.take(mf.NAME, lines.findings)
        self.bytes += lines.size
        by_writer = self._journals(lines, store_id)
        graves = DeletedFiles(manifest.tombstones)
        sealed = {name: entry for name, (_, entry) in lines.sealed.items()}
        for writer in sorted({*by_writer, *(s.writer for s in sealed.values())} - {"ring"}):
            files = by_writer.get(writer, ())
            self.collected.add(check_continuity(writer, files, sealed, graves))
        self._segments(manifest, sealed)
        for name, findings in check_incidents(self.store, manifest):
            self.collected.take(name, findings)
        for name, findings in check_derived(Store(path, store_id), manifest, trust.key):
            self.collected.take(name, findings)
        by_name = {c.target.name: c for found in by_writer.values() for c in found}
        known = KnownHashes(store_id, lines, by_name, sealed, graves)
        heads = self._heads(known, trust.key)
        self.collected.add(unsigned_ends(trust, lines, by_writer, heads))
        return VerifyReport(
            self.collected.findings, self.collected.files,
            [*_head_lines(lines, by_writer, trust)], self.notes, self.bytes,
            trust.is_signed, uncovered(self.store, self.collected.files, manifest),
        )  # fmt: skip

    def _store_id(self) -> str:
        """Return the store's identity; where all files name another one, that is it."""
        paths = [
            path for writer in self.store.writers() for path in self.store.journal_files(writer)
        ]
        stated = {start_record(path).get("store_id", self.store.id) for path in paths}
        if len(stated) == 1 and self.store.id not in stated and len(paths) > 1:
            other = stated.pop()
            text = f"names another store than all of its {len(paths)} journals ({other})"
            self.collected.take(IDENTITY, [VerifyFinding("altered", IDENTITY, text)])
            return other
        return self.store.id

    def _trust(self, lines: CheckedManifest) -> KeyTrust:
        trust = check_trust(self.key, self.store.path, lines)
        self.collected.add(trust.findings)
        if trust.key and lines.signatures:
            self.collected.take(PUBLIC, list(check_public(self.store.path, trust)))
        self.notes += trust.notes
        return trust

    def _journals(self, lines: CheckedManifest, store_id: str) -> dict[str, list[CheckedJournal]]:
        """Check all journal files, two at a time; return them writer by writer."""
        targets = list(self._targets(lines, store_id))
        noted = wanted_links(self.noted, self.own)
        with ThreadPoolExecutor(THREADS) as pool:
            results = pool.map(lambda target: _checked(target, noted), targets)
            found = [checked for checked in results if checked is not None]
        by_writer: dict[str, list[CheckedJournal]] = {}
        for checked in found:
            by_writer.setdefault(checked.target.identity.writer, []).append(checked)
            self.collected.take(checked.target.name, checked.findings)
            self.bytes += checked.size
        return by_writer

    def _targets(self, lines: CheckedManifest, store_id: str) -> Iterator[CheckTarget]:
        for writer in self.store.writers():
            paths = self.store.journal_files(writer)
            locked = is_locked(self.store, LOCKS.get(writer, writer))
            before = ""
            for place, path in enumerate(paths, 1):
                entry = lines.sealed.get(f"{path.parent.name}/{path.name}")
                sealed = entry[1] if entry is not None else None
                live = locked and place == len(paths)
                yield check_target(self.store, path, sealed=sealed, before=before, live=live,
                                store_id=store_id)  # fmt: skip
                if writer == "ring":
                    yield from self._copies(path, store_id)
                before = sealed.chain if sealed is not None else _last_link(path)

    def _copies(self, path: Path, store_id: str) -> Iterator[CheckTarget]:
        """Yield incidents' copies of a journal of the ring that are files of their own."""
        for held in sorted((self.store.path / INCIDENTS).glob(f"*/{path.parent.name}/{path.name}")):
            if held != path and not held.samefile(path):
                target = check_target(self.store, held, store_id=store_id)
                yield replace(target, name=str(held.relative_to(self.store.path)))

    def _segments(self, manifest: Manifest, sealed: Mapping[str, SealedJournal]) -> None:
        """Check all segments, two at a time."""
        segments = [s for found in manifest.segments.values() for s in found]
        by_hash = {segment.sha256: segment.path for segment in segments}

        def check(segment: Segment) -> tuple[list[VerifyFinding], int]:
            return check_segment(self.store.path, segment, sealed, by_hash)

        with ThreadPoolExecutor(THREADS) as pool:
            for segment, (findings, size) in zip(segments, pool.map(check, segments), strict=True):
                self.collected.take(segment.path, findings)
                self.bytes += size

    def _heads(self, known: KnownHashes, key: str) -> SignedHeads | None:
        findings, heads = check_stored_heads(self.own, known, key)
        if heads is not None and heads.signature:
            self.collected.take(HEADS, [])
        self.collected.add(findings)
        for noted in self.noted:
            missing, text = check_noted_head(noted, known, key)
            self.collected.add(missing)
            if text and any(finding.state in BAD for finding in self.collected.findings):
                text = text.partition(": ")[0] + ": but not all before it is as it was"
            self.notes += [text] if text else []
        return heads


def _last_link(path: Path) -> str:
    """Read the last link of a file; empty if there is none."""
    try:
        with open_buffer(path) as data:
            found = links(data)
    except OSError:
        return ""
    return found[-1].chain if found else ""


def _checked(target: CheckTarget, noted: tuple[str, ...]) -> CheckedJournal | None:
    """Check a file; None when it was deleted meanwhile."""
    try:
        return check_journal(target, noted)
    except FileNotFoundError:
        return None
    except READ_ERRORS as error:
        text = f"cannot be read: {error}"
        size = target.path.stat().st_size
        return CheckedJournal(target, size, findings=[VerifyFinding("damaged", target.name, text)])


def _head_lines(
    lines: CheckedManifest, by_writer: Mapping[str, Sequence[CheckedJournal]], trust: KeyTrust
) -> Iterator[HeadHash]:
    """Yield the hashes that are worth noting down."""
    if lines.hashes:
        yield HeadHash("manifest", lines.last_hash, mf.NAME, trust.signed_ns)
    for writer, files in by_writer.items():
        if writer != "ring" and files and files[-1].last is not None:
            last = files[-1]
            yield HeadHash(writer, last.chain, last.target.name, last.places.end_ns(last.tail_from))
    if trust.key:
        yield HeadHash("key", trust.key, PUBLIC)
