"""A journal that arrives: is it whole and sound, and what does the catalogue have to know of it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.follow.read import JournalFile, holes, journal_file
from amberbox.blackbox.journal.clocktable import ClockReading, ClockTable
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.segments.build import selection_of
from amberbox.blackbox.store import FOLDERS, run_and_number
from amberbox.blackbox.verify.block import Identity
from amberbox.blackbox.verify.findings import BAD
from amberbox.blackbox.verify.journal import Target, check_journal
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.ids import is_id
from amberbox.core.types import Gap
from amberbox.fleet.archive.store import JournalKey

_WRITERS = {folder: writer for writer, folder in FOLDERS.items()}
_HINT = "the file stays where it was; ask the robot for it again"


class GapFact(msgspec.Struct):
    """A hole in a journal: the fields of a ``Gap`` that last."""

    from_ns: int
    to_ns: int
    reason: str
    item: str = ""
    count: int | None = None
    from_seq: int | None = None
    to_seq: int | None = None


class Facts(msgspec.Struct):
    """What the catalogue keeps of a journal beside its place: clock, variables, holes.

    ``refused`` is why it is in no table; ``by`` is the version of the server that could not make
    rows of it, empty for a file that had changed.
    """

    clock: list[tuple[int, int, bool | None, int | None]] = []
    selection: dict[str, list[str]] = {}
    gaps: list[GapFact] = []
    refused: str = ""
    by: str = ""

    @property
    def readings(self) -> tuple[ClockReading, ...]:
        """The readings of the clock."""
        return tuple(ClockReading(*reading) for reading in self.clock)


def decode(text: str) -> Facts:
    """Read facts as they stand in the catalogue."""
    return msgspec.json.decode(text, type=Facts)


def encode(facts: Facts) -> str:
    """Write facts for the catalogue."""
    return msgspec.json.encode(facts).decode()


@dataclass(frozen=True, slots=True)
class Arrived:
    """A journal file that holds, and its row in the catalogue."""

    file: JournalFile
    row: dict[str, Any]


def checked_key(key: JournalKey) -> str:
    """Return the folder of a key.

    Raises UsageError for a key that names no journal: nothing else may become a path.
    """
    folder, _, name = key.file.partition("/")
    run, _ = run_and_number(Path(name))
    plain = name == Path(name).name and name.endswith(".mcap") and run > 0
    if folder not in _WRITERS or not plain or not is_id(key.robot) or not is_id(key.store_id):
        raise UsageError(
            f"{key.robot}/{key.store_id}/{key.file} is no name of a journal",
            "robot id, store id and folder/run-boot-number.mcap are needed",
        )
    return folder


def sha256_of(path: Path) -> str:
    """Hash a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def inspect(key: JournalKey, path: Path, put_ns: int, *, is_checked: bool = False) -> Arrived:
    """Check a journal file from its first byte to its last, and describe it.

    With ``is_checked`` somebody has just done so. Raises AmberboxError for one that is another,
    damaged, unfinished, or of another store.
    """
    folder = checked_key(key)
    if not is_checked:
        _check(key, folder, path)
    file = journal_file(path, key.file)
    return Arrived(file, _row(key, folder, file, put_ns))


def _check(key: JournalKey, folder: str, path: Path) -> None:
    if sha256_of(path) != key.sha256:
        raise AmberboxError(f"{key.file}: its content is not what was announced", _HINT)
    run, number = run_and_number(Path(key.file))
    start = start_record(path)
    identity = Identity(key.store_id, _WRITERS[folder], run, number, (start.get("chain", ""),))
    checked = check_journal(Target(key.file, path, identity))
    bad = [finding for finding in checked.findings if finding.state in BAD]
    if bad or checked.torn or not start:
        text = bad[0].text if bad else "its end is torn" if checked.torn else "it is no journal"
        raise AmberboxError(f"{key.file}: {text}", _HINT)


def _row(key: JournalKey, folder: str, file: JournalFile, put_ns: int) -> dict[str, Any]:
    start_ns, end_ns = (
        ClockTable(file.clock).received(np.array([file.start_ns, file.end_ns])).tolist()
    )
    facts = Facts(_few(file), selection_of(file), gap_facts(holes(file)))
    return {
        "robot": key.robot, "store_id": key.store_id, "file": key.file, "sha256": key.sha256,
        "bytes": file.bytes, "keeping": _WRITERS[folder], "writer": file.writer, "run": file.run,
        "first_seq": file.first_seq, "end_seq": file.end_seq, "start_ns": start_ns,
        "end_ns": end_ns, "facts": encode(facts), "put_ns": put_ns, "batch": None,
        "state": "put", "rows": file.rows, "raw_gone": False, "columns_gone": False,
        "own_gone": False,
    }  # fmt: skip


def _few(file: JournalFile) -> list[tuple[int, int, bool | None, int | None]]:
    """Leave out readings of the clock that lie on the line between others."""
    needed = {log_ns for log_ns, _ in file.clock}
    kept: list[ClockReading] = []
    for number, reading in enumerate(file.readings):
        is_last = number == len(file.readings) - 1
        turned = bool(kept) and kept[-1].synchronised != reading.synchronised
        if is_last or turned or not kept or reading.log_ns in needed:
            kept.append(reading)
    return [(r.log_ns, r.offset_ns, r.synchronised, r.boot_ns) for r in kept]


def gap_facts(gaps: Sequence[Gap]) -> list[GapFact]:
    """Keep of gaps what lasts."""
    return [
        GapFact(g.from_ns, g.to_ns, g.reason, g.item, g.count, g.from_seq, g.to_seq) for g in gaps
    ]
