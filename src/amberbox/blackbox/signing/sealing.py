"""Sealing: when nobody writes a journal file any more, the manifest says what it is like."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from amberbox.blackbox.follow.read import JournalFile, holes, journal_file, run_messages
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Hole, Sealed, to_record
from amberbox.blackbox.signing.keys import SigningKey
from amberbox.blackbox.signing.signing import LOCKS, STATED, sign_manifest
from amberbox.blackbox.store import Store, is_locked
from amberbox.blackbox.verify.findings import BAD
from amberbox.blackbox.verify.journal import Checked, check_journal
from amberbox.blackbox.verify.targets import target_of

Warn = Callable[[str, str], None]
"""Takes the kind of an event and its text."""


def seal_journals(
    store: Store,
    key: SigningKey | None,
    warn: Warn = lambda kind, text: None,
    stop: Callable[[], bool] = lambda: False,
    *,
    own: bool = False,
) -> list[Sealed]:
    """Seal every journal file that nobody writes any more, and sign; return what was sealed.

    Each is hashed once and made durable first. ``warn`` is told of what does not hold. With
    ``own`` the keeper has finished its own journals, too. Only the keeper calls this.
    Raises OSError when the disk does not take the entries.
    """
    known = mf.read(store.path).sealed
    done: list[Sealed] = []
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
    store: Store, sealed: Mapping[str, Sealed], *, own: bool = False
) -> Iterator[Path]:
    """List the files that are to be sealed, oldest first; not those of the ring."""
    for writer in STATED:
        paths = store.journal_files(writer)
        is_own = writer in LOCKS
        if (is_own and not own) or (not is_own and is_locked(store, writer)):
            paths = paths[:-1]
        yield from (path for path in paths if f"{path.parent.name}/{path.name}" not in sealed)


def _seal(store: Store, path: Path, warn: Warn) -> Sealed | None:
    try:
        _sync(path)
        target = target_of(store, path)
        checked = check_journal(target)
        journal = journal_file(path, target.name)
    except FileNotFoundError:  # it was deleted meanwhile
        return None
    for finding in checked.findings:
        if finding.state in BAD:
            warn(finding.state, f"{finding.file}: {finding.text}")
    return _entry(journal, checked)


def _sync(path: Path) -> None:
    """Make a file durable: what is sealed must not be lost by a power cut afterwards."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _entry(journal: JournalFile, checked: Checked) -> Sealed:
    edges = np.array([journal.start_ns, journal.end_ns])
    start_ns, end_ns = ClockTable(journal.clock).received(edges).tolist()
    identity = checked.target.identity
    last = journal.readings[-1] if journal.readings else None
    about = run_messages(journal)
    return Sealed(
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
        holes=_holes(journal),
    )


def _holes(journal: JournalFile) -> tuple[Hole, ...]:
    return tuple(
        Hole(gap.from_seq, gap.to_seq, gap.from_ns, gap.to_ns, gap.reason)
        for gap in holes(journal)
        if gap.from_seq is not None and gap.to_seq is not None
    )
