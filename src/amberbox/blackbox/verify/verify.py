"""Verify a store: the manifest, every journal, every segment, and the heads noted earlier."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.manifest import Manifest, Segment
from amberbox.blackbox.signing.keys import PUBLIC, can_sign
from amberbox.blackbox.signing.signing import HEADS, LOCKS, SignedHeads
from amberbox.blackbox.store import IDENTITY, INCIDENTS, Store, is_locked, open_store
from amberbox.blackbox.verify.continuity import Graves, check_continuity
from amberbox.blackbox.verify.derived import check_derived, uncovered
from amberbox.blackbox.verify.findings import BAD, Collected, Finding, HeadLine, Report
from amberbox.blackbox.verify.heads import (
    Known,
    Noted,
    check_noted,
    check_own_heads,
    links_of,
    read_noted,
    read_own,
)
from amberbox.blackbox.verify.incidents import check_incidents
from amberbox.blackbox.verify.journal import Checked, Target, check_journal
from amberbox.blackbox.verify.links import links
from amberbox.blackbox.verify.manifest import CheckedManifest, check_manifest
from amberbox.blackbox.verify.place import TROUBLE
from amberbox.blackbox.verify.segments import check_segment
from amberbox.blackbox.verify.signed import Trust, check_public, check_trust, unsigned_ends
from amberbox.blackbox.verify.targets import target_of

THREADS = 2
"""Hashing runs beside Python; more threads would take the robot's other processors."""
_ATTEMPTS = 3


def verify(path: Path, *, key: str = "", noted: Sequence[str] = ()) -> Report:
    """Check everything in a store.

    ``key`` is the public key (hex) as noted at the first start, else the store's own is believed.
    ``noted`` are heads: hashes, or signed statements as text or files. A keeper that works on the
    store meanwhile is no trouble. Raises UsageError for a head that is none, AmberboxError for one
    that is not this robot's.
    """
    heads = [read_noted(text) for text in noted]
    for _ in range(_ATTEMPTS):
        before = mf.read(path).last_hash
        report = _Verification(path, key, heads).run()
        missing = any(finding.state == "missing" for finding in report.findings)
        if not missing or mf.read(path).last_hash == before:
            break
    return report


@dataclass(frozen=True, slots=True)
class _Journals:
    """The journal files of a store as they were checked, writer by writer."""

    by_writer: Mapping[str, Sequence[Checked]]

    @property
    def by_name(self) -> dict[str, Checked]:
        return {c.target.name: c for found in self.by_writer.values() for c in found}


class _Verification:
    """One pass over a store."""

    def __init__(self, path: Path, key: str, noted: Sequence[Noted]) -> None:
        self.store = open_store(path)
        self.key = key
        self.noted = noted
        self.own = read_own(path)
        self.collected = Collected()
        self.notes: list[str] = []
        self.bytes = 0

    def run(self) -> Report:
        """Check all parts; what is known from one goes into the next."""
        path = self.store.path
        store_id = self._store_id()
        lines = check_manifest(path, store_id, can_check=can_sign())
        trust = self._trust(lines)
        manifest = lines.known
        self.collected.take(mf.NAME, lines.findings)
        self.bytes += lines.size
        journals = self._journals(lines, store_id)
        graves = Graves(manifest.tombstones)
        self._continuity(lines, journals, graves)
        self._segments(manifest, lines)
        for name, findings in check_incidents(self.store, manifest):
            self.collected.take(name, findings)
        sealed = {name: entry for name, (_, entry) in lines.sealed.items()}
        for name, findings in check_derived(Store(path, store_id), manifest, trust.key):
            self.collected.take(name, findings)
        known = Known(store_id, lines, journals.by_name, sealed, graves)
        heads = self._heads(known, trust.key)
        ends = unsigned_ends(trust, lines, journals.by_writer, heads)
        for finding in ends:
            self.collected.take(finding.file, [finding])
        return Report(
            self.collected.findings, self.collected.files,
            [*_head_lines(lines, journals.by_writer, trust)], self.notes, self.bytes,
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
            self.collected.take(IDENTITY, [Finding("altered", IDENTITY, text)])
            return other
        return self.store.id

    def _trust(self, lines: CheckedManifest) -> Trust:
        trust = check_trust(self.key, self.store.path, lines)
        for finding in trust.findings:
            self.collected.take(finding.file, [finding])
        if trust.key and lines.signatures:
            self.collected.take(PUBLIC, list(check_public(self.store.path, trust)))
        self.notes += trust.notes
        return trust

    def _journals(self, lines: CheckedManifest, store_id: str) -> _Journals:
        """Check all journal files, two at a time."""
        targets = list(self._targets(lines, store_id))
        noted = links_of(self.noted, self.own)
        with ThreadPoolExecutor(THREADS) as pool:
            results = pool.map(lambda target: _checked(target, noted), targets)
            found = [checked for checked in results if checked is not None]
        by_writer: dict[str, list[Checked]] = {}
        for checked in found:
            by_writer.setdefault(checked.target.identity.writer, []).append(checked)
            self.collected.take(checked.target.name, checked.findings)
            self.bytes += checked.size
        return _Journals(by_writer)

    def _targets(self, lines: CheckedManifest, store_id: str) -> Iterator[Target]:
        for writer in self.store.writers():
            paths = self.store.journal_files(writer)
            locked = is_locked(self.store, LOCKS.get(writer, writer))
            before = ""
            for place, path in enumerate(paths, 1):
                entry = lines.sealed.get(f"{path.parent.name}/{path.name}")
                sealed = entry[1] if entry is not None else None
                live = locked and place == len(paths)
                yield target_of(self.store, path, sealed=sealed, before=before, live=live,
                                store_id=store_id)  # fmt: skip
                if writer == "ring":
                    yield from self._copies(path, store_id)
                before = sealed.chain if sealed is not None else _last_link(path)

    def _copies(self, path: Path, store_id: str) -> Iterator[Target]:
        """Give what incidents hold of a journal of the ring where it is a file of its own."""
        for held in sorted((self.store.path / INCIDENTS).glob(f"*/{path.parent.name}/{path.name}")):
            if held != path and not held.samefile(path):
                target = target_of(self.store, held, store_id=store_id)
                yield replace(target, name=str(held.relative_to(self.store.path)))

    def _continuity(self, lines: CheckedManifest, journals: _Journals, graves: Graves) -> None:
        sealed = {name: entry for name, (_, entry) in lines.sealed.items()}
        writers = {*journals.by_writer, *(entry.writer for entry in sealed.values())}
        for writer in sorted(writers - {"ring"}):
            files = journals.by_writer.get(writer, ())
            for finding in check_continuity(writer, files, sealed, graves):
                self.collected.take(finding.file, [finding])

    def _segments(self, manifest: Manifest, lines: CheckedManifest) -> None:
        """Check all segments, two at a time."""
        segments = [s for found in manifest.segments.values() for s in found]
        sealed = {name: entry for name, (_, entry) in lines.sealed.items()}
        by_hash = {segment.sha256: segment.path for segment in segments}

        def check(segment: Segment) -> tuple[list[Finding], int]:
            return check_segment(self.store.path, segment, sealed, by_hash)

        with ThreadPoolExecutor(THREADS) as pool:
            for segment, (findings, size) in zip(segments, pool.map(check, segments), strict=True):
                self.collected.take(segment.path, findings)
                self.bytes += size

    def _heads(self, known: Known, key: str) -> SignedHeads | None:
        findings, heads = check_own_heads(self.own, known, key)
        if heads is not None and heads.signature:
            self.collected.take(HEADS, [])
        for finding in findings:
            self.collected.take(finding.file, [finding])
        for noted in self.noted:
            missing, text = check_noted(noted, known, key)
            for finding in missing:
                self.collected.take(finding.file, [finding])
            self.notes += [self._qualified(text)] if text else []
        return heads

    def _qualified(self, text: str) -> str:
        """Do not say that all is as it was where something is not."""
        if any(finding.state in BAD for finding in self.collected.findings):
            return text.partition(": ")[0] + ": but not all before it is as it was"
        return text


def _last_link(path: Path) -> str:
    """Read the last link of a file; nothing where there is none."""
    try:
        with open_buffer(path) as data:
            found = links(data)
    except OSError:
        return ""
    return found[-1].chain if found else ""


def _checked(target: Target, noted: tuple[str, ...]) -> Checked | None:
    """Check a file; None when it was deleted meanwhile."""
    try:
        return check_journal(target, noted)
    except FileNotFoundError:
        return None
    except TROUBLE as error:
        text = f"cannot be read: {error}"
        size = target.path.stat().st_size
        return Checked(target, size, findings=[Finding("damaged", target.name, text)])


def _head_lines(
    lines: CheckedManifest, by_writer: Mapping[str, Sequence[Checked]], trust: Trust
) -> Iterator[HeadLine]:
    """Give the hashes that are worth noting down."""
    if lines.hashes:
        yield HeadLine("manifest", lines.last_hash, mf.NAME, trust.signed_ns)
    for writer, files in by_writer.items():
        if writer != "ring" and files and files[-1].last is not None:
            last = files[-1]
            yield HeadLine(writer, last.chain, last.target.name, last.places.end_ns(last.tail_from))
    if trust.key:
        yield HeadLine("key", trust.key, PUBLIC)
