"""Seal finished journals in the manifest; sign the manifest and the heads of all journals.

Heads state how far each journal reaches. ``Signer`` does all of it for the maintenance process.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal.chunk import open_buffer
from amberbox.blackbox.journal.mcap import is_finished
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.signing.findings import BAD
from amberbox.blackbox.signing.journal_check import (
    ChainLink,
    CheckedJournal,
    check_journal,
    check_target,
    links,
)
from amberbox.blackbox.signing.keys import RobotSigningKey, StoreKeys, holds, open_keys
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.derived_journal import DerivedJournal, event
from amberbox.blackbox.store.journal_reader import JournalFile, holes, journal_file, run_messages
from amberbox.blackbox.store.manifest_entries import (
    Hole,
    ManifestSignature,
    SealedJournal,
    to_record,
)
from amberbox.blackbox.store.manifest_lines import first_hash
from amberbox.blackbox.store.store import Store, is_locked, run_and_number
from amberbox.core.files import replace_file, sync_file

HEADS = "heads.json"
# all writers but the ring
SIGNED_WRITERS = ("main", "bulk", "keep", "kept", "watch", "act", "experiment", "detect")
LOCKS = {"keep": "keeper", "kept": "keeper"}  # locks of the writers that are not called like these
_LINE_BYTES = 1024  # more than a line with a signature has


@dataclass(frozen=True, slots=True)
class JournalReach:
    """The reach of a writer's journal: the last link of its chain, and its place.

    ``bytes`` is the end of the bytes that the link covers, ``next_seq`` the position after it.
    """

    run: int
    file: str
    chain: str
    next_seq: int
    bytes: int


@dataclass(frozen=True, slots=True)
class SignedHeads:
    """The robot's statement of how far everything reaches; without a key it is not signed.

    ``manifest`` is the hash of the last line, ``since`` that of the first: it is another one once
    the manifest has been condensed.
    """

    store_id: str
    at_ns: int
    manifest: str
    writers: Mapping[str, JournalReach] = field(default_factory=dict)
    key: str = ""
    signature: str = ""
    since: str = ""

    def message(self) -> bytes:
        """Return the bytes that are signed: all but the signature, in one way of writing."""
        values = msgspec.to_builtins(self)
        del values["signature"]
        text = json.dumps(values, sort_keys=True, separators=(",", ":"))
        return b"amberbox heads 1\n" + text.encode()

    def holds(self) -> bool:
        """Return whether the signature is that of its key."""
        return holds(self.key, self.signature, self.message())

    def to_json(self) -> str:
        """Write the statement as a document for people and servers."""
        return json.dumps(msgspec.to_builtins(self), indent=1) + "\n"


def parse_heads(content: str | bytes) -> SignedHeads:
    """Read a statement; raises ValueError when it is none."""
    try:
        return msgspec.json.decode(content, type=SignedHeads)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error


def signature_message(store_id: str, head: str, at_ns: int) -> bytes:
    """Return the message that is signed for a line of the manifest."""
    return f"amberbox manifest 1\n{store_id}\n{head}\n{at_ns}\n".encode()


def signature_of(store: Store, key: RobotSigningKey, head: str, at_ns: int) -> ManifestSignature:
    """Sign everything in the manifest up to the line with hash ``head``."""
    signed = key.sign(signature_message(store.id, head, at_ns))
    return ManifestSignature(head, at_ns, key.public, signed)


def signature_record(store: Store, key: RobotSigningKey | None, head: str) -> dict[str, Any] | None:
    """Return the line that signs a head; None without a key."""
    if key is None:
        return None
    return to_record(signature_of(store, key, head, time.time_ns()))


def sign_manifest(
    store: Store, key: RobotSigningKey | None, now_ns: int | None = None, *, again: bool = False
) -> bool:
    """Sign the lines appended since the last signature; return whether there were any.

    With ``again`` signed lines are signed once more, as by a new key.
    """
    with mf.CHANGING:
        last = _last_line(store.path / mf.NAME)
        if key is None or not last or (b',"kind":"signed",' in last and not again):
            return False
        at_ns = time.time_ns() if now_ns is None else now_ns
        signature = signature_of(store, key, mf.read(store.path).last_hash, at_ns)
        mf.append(store.path, [to_record(signature)])
        return True


def _last_line(path: Path) -> bytes:
    """Return the end of the manifest's last line; empty when there is none."""
    try:
        with path.open("rb") as file:
            file.seek(-min(file.seek(0, os.SEEK_END), _LINE_BYTES), os.SEEK_END)
            return file.read().rstrip(b"\n").rpartition(b"\n")[2]
    except FileNotFoundError:
        return b""


def write_heads(
    store: Store, key: RobotSigningKey | None, now_ns: int | None = None
) -> SignedHeads:
    """Write the reach of all journals, durably and signed, in place of the heads before.

    Raises OSError when writing fails.
    """
    heads = signed_heads(store, key, now_ns)
    replace_file(store.path / HEADS, heads.to_json())
    return heads


def signed_heads(
    store: Store, key: RobotSigningKey | None, now_ns: int | None = None
) -> SignedHeads:
    """Return the statement of the reach of all journals; only durable data count."""
    with mf.CHANGING:  # it is not condensed in between
        since, known = first_hash(store.path / mf.NAME), mf.read(store.path)
    found = {writer: reach_of(store, writer, known.sealed) for writer in SIGNED_WRITERS}
    heads = SignedHeads(
        store.id,
        time.time_ns() if now_ns is None else now_ns,
        known.last_hash,
        {writer: reach for writer, reach in found.items() if reach is not None},
        "" if key is None else key.public,
        since=since,
    )
    return heads if key is None else replace(heads, signature=key.sign(heads.message()))


def reach_of(store: Store, writer: str, sealed: Mapping[str, SealedJournal]) -> JournalReach | None:
    """Find the newest link of a writer's journal that a power cut cannot take back."""
    # Return the newest sealed file that has a link of its own.
    found = [s for s in sealed.values() if s.writer == writer and s.tail_from]
    last = max(found, key=lambda s: (s.run, s.number), default=None)
    for path in reversed(store.journal_files(writer)):
        name = f"{path.parent.name}/{path.name}"
        if name in sealed:
            break
        link = _durable_link(store, writer, path)
        if link is not None:
            return JournalReach(run_and_number(path)[0], name, link.chain, link.next_seq, link.to)
    if last is None:
        return None
    return JournalReach(last.run, last.journal, last.chain, last.end_seq, last.tail_from)


def _durable_link(store: Store, writer: str, path: Path) -> ChainLink | None:
    """Return the last link that was synced, or None where that is not known yet."""
    head = read_head(path.parent)
    if head is None or head.run != run_and_number(path)[0]:
        return None
    if not is_locked(store, LOCKS.get(writer, writer)):
        return None  # the end of a finished file is synced when it is sealed
    try:
        with open_buffer(path) as data:
            found = links(data)
    except FileNotFoundError:
        return None
    synced = [link for link in found if link.next_seq <= head.durable_seq]
    return next((link for link in synced if link.next_seq == synced[-1].next_seq), None)


Warn = Callable[[str, str], None]  # called with the kind of an event and its text


def seal_journals(
    store: Store,
    key: RobotSigningKey | None,
    warn: Warn = lambda kind, text: None,
    stop: Callable[[], bool] = lambda: False,
    *,
    own: bool = False,
) -> list[SealedJournal]:
    """Seal every finished journal file, and sign; return what was sealed.

    Each is hashed once and made durable first. ``warn`` is called for files whose chain is wrong.
    With ``own`` the keeper has finished its own journals, too. Only the keeper calls this. Raises
    OSError when the entries cannot be written.
    """
    known = mf.read(store.path).sealed
    done: list[SealedJournal] = []
    for path in finished_files(store, known, own=own):
        if stop():
            break
        sealed = _seal(store, path, warn)
        with mf.CHANGING:
            if sealed is not None and path.exists():  # else it was deleted meanwhile
                mf.append(store.path, [to_record(sealed)])
                done.append(sealed)
    if done:
        sign_manifest(store, key)
    return done


def finished_files(
    store: Store, sealed: Mapping[str, SealedJournal], *, own: bool = False
) -> Iterator[Path]:
    """Yield the files that are to be sealed, oldest first; not those of the ring.

    Of a running writer the newest one too, if it is finished and the next has not begun.
    """
    for writer in SIGNED_WRITERS:
        paths = store.journal_files(writer)
        is_own = writer in LOCKS
        is_running = not own if is_own else is_locked(store, writer)
        if paths and is_running and (is_own or not _is_finished(paths[-1])):
            paths = paths[:-1]
        yield from (path for path in paths if f"{path.parent.name}/{path.name}" not in sealed)


def _is_finished(path: Path) -> bool:
    with suppress(FileNotFoundError), open_buffer(path) as data:
        return is_finished(data)
    return False


def _seal(store: Store, path: Path, warn: Warn) -> SealedJournal | None:
    try:
        # durable: a sealed file must not be lost by a power cut afterwards
        sync_file(path)
        target = check_target(store, path)
        checked = check_journal(target)
        journal = journal_file(path, target.name)
    except FileNotFoundError:  # it was deleted meanwhile
        return None
    for finding in checked.findings:
        if finding.state in BAD:
            warn(finding.state, f"{finding.file}: {finding.text}")
    return _entry(journal, checked)


def _entry(journal: JournalFile, checked: CheckedJournal) -> SealedJournal:
    start_ns, end_ns = journal.received_range_ns
    identity = checked.target.identity
    last = journal.readings[-1] if journal.readings else None
    about = run_messages(journal)
    return SealedJournal(
        journal=journal.name,
        writer=identity.writer,
        run=identity.run,
        number=identity.number,
        first_seq=journal.first_seq,
        end_seq=journal.end_seq,
        start_ns=start_ns,
        end_ns=end_ns,
        bytes=checked.size,
        start_chain=checked.start_chain,
        chain=checked.chain,
        tail_from=checked.tail_from,
        tail=checked.tail,
        boot_id=str(about.get("boot_id", "")),
        boot_base_ns=None if last is None or last.boot_ns is None else last.log_ns - last.boot_ns,
        clock=tuple(journal.clock),
        synchronised=None if last is None else last.synchronised,
        config_hash=str(about.get("config_hash", "")),
        holes=tuple(
            Hole(gap.from_seq, gap.to_seq, gap.from_ns, gap.to_ns, gap.reason)
            for gap in holes(journal)
            if gap.from_seq is not None and gap.to_seq is not None
        ),
    )


STATE_S = 10.0  # between two writes of the heads


class Signer:
    """Seals and signs one store with its key, which is made when there is none."""

    def __init__(self, store: Store, journal: DerivedJournal | None = None) -> None:
        self._store = store
        self._journal = journal
        self._keys: StoreKeys | None = None
        self._stated_s: float | None = None
        self._trouble = ""

    def seal(self, stop: Callable[[], bool] = lambda: False, *, own: bool = False) -> None:
        """Seal finished journals; with ``own`` those of the maintenance process, too."""
        self._try(
            lambda: seal_journals(self._store, self._opened().key, self._log_event, stop, own=own)
        )

    def sign(self) -> None:
        """Sign the manifest as it is now; every 10 s, write the heads of the journals."""
        self._try(lambda: sign_manifest(self._store, self._opened().key))
        now_s = time.monotonic()
        if self._stated_s is None or now_s - self._stated_s >= STATE_S:
            self._stated_s = now_s
            self.state()

    def state(self) -> None:
        """Write the statement of the reach of all journals."""
        self._try(lambda: write_heads(self._store, self._opened().key))

    def close(self) -> None:
        """Seal, sign and state for the last time, the keeper's own finished journals included."""
        self._journal = None
        self.seal(own=True)
        self._try(lambda: sign_manifest(self._store, self._opened().key))
        self.state()

    def signature_of(self, head: str) -> Mapping[str, Any] | None:
        """Return the line that signs a head of the manifest; None without a key."""
        return signature_record(self._store, self._opened().key, head)

    def _opened(self) -> StoreKeys:
        """Open the keys once and log warnings about them."""
        if self._keys is None:
            self._keys = open_keys(self._store)
            for warning in self._keys.warnings:
                self._log_event("keys", warning)
            if self._keys.is_new:  # the last signature in the manifest must be that of this key
                sign_manifest(self._store, self._keys.key, again=True)
        return self._keys

    def _log_event(self, kind: str, text: str) -> None:
        if self._journal is None:
            print(f"amberbox keeper: {text}", file=sys.stderr)
            return
        with suppress(OSError):
            self._journal.write([event(kind, text, "keeper")])

    def _try(self, work: Callable[[], object]) -> None:
        """Do something that a full or failing disk may refuse; the next step tries again."""
        try:
            work()
        except OSError as error:
            text = f"cannot seal or sign: {error.strerror or error}"
            if text != self._trouble:
                self._trouble = text
                print(f"amberbox keeper: {text}", file=sys.stderr)
        else:
            self._trouble = ""
