"""Journals as the server stores them: keys, retention rules, inspection of received files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.signing.findings import BAD
from amberbox.blackbox.signing.journal_check import CheckTarget, JournalIdentity, check_journal
from amberbox.blackbox.store.clocks import ClockReading, ClockTable
from amberbox.blackbox.store.journal_reader import JournalFile, holes, journal_file
from amberbox.blackbox.store.segment_builder import selection_of
from amberbox.blackbox.store.store import FOLDERS, run_and_number
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.names import is_id
from amberbox.core.types import Gap

# Keeping class of the recorder's own channels: statuses, events, gaps, incidents, runs
OWN = "own"

Kind = Literal["lost_at_power_cut", "deleted_before_copy"]
LOST: Kind = "lost_at_power_cut"
DELETED: Kind = "deleted_before_copy"


@dataclass(frozen=True, slots=True)
class JournalKey:
    """The identity of a journal: ``file`` is ``folder/name.mcap`` as on the robot, ``sha256`` its
    content.
    """

    robot: str
    store_id: str
    file: str
    sha256: str


@dataclass(frozen=True, slots=True)
class MissingRows:
    """Rows ``[from_seq, to_seq)`` of a writer's run that will never arrive, and why.

    ``lost_at_power_cut``: the server had received them, the robot has lost them.
    ``deleted_before_copy``: the robot deleted them; ``reason`` is that of its tombstone.
    """

    writer: str
    run: int
    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int
    kind: Kind
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Retention:
    """How long data are kept, in seconds since they came; None is for ever.

    ``robot`` and ``keeping`` (``main``, ``bulk``, ``ring``, ``watch``, ``keep``, ``kept``, ``act``)
    choose; ``*`` is every robot, or the classes ``main``, ``bulk`` and ``ring``. What the box
    itself says goes only by a rule for ``own``, journals of ``watch``, ``keep``, ``kept`` and
    ``act`` only by a rule that names them. What a pinned incident covers stays.
    """

    robot: str = "*"
    keeping: str = "*"
    journals_s: float | None = None
    columns_s: float | None = None


@dataclass(frozen=True, slots=True)
class PutResult:
    """The result of ``put``: whether the journal is new here, and its path."""

    is_new: bool
    path: Path


@dataclass(frozen=True, slots=True)
class CommitResult:
    """What one commit added, and how long to wait (s) until the next one is due."""

    journals: int = 0
    rows: int = 0
    tables: int = 0
    refused: int = 0
    waiting: int = 0
    next_in_s: float = 0.0


_WRITERS = {folder: writer for writer, folder in FOLDERS.items()}
_HINT = "the file stays where it was; ask the robot for it again"


class GapFact(msgspec.Struct):
    """A gap in a journal: the fields of a ``Gap`` that are stored."""

    from_ns: int
    to_ns: int
    reason: str
    item: str = ""
    count: int | None = None
    from_seq: int | None = None
    to_seq: int | None = None


class JournalFacts(msgspec.Struct):
    """The catalogue's data about a journal beside its key: clock readings, variables, gaps.

    ``refused`` is the reason why it is in no table; ``by`` is the version of the server that could
    not convert it into rows, empty for a file that had changed.
    """

    clock: list[tuple[int, int, bool | None, int | None]] = []
    selection: dict[str, list[str]] = {}
    gaps: list[GapFact] = []
    refused: str = ""
    by: str = ""

    @property
    def readings(self) -> tuple[ClockReading, ...]:
        """The clock readings."""
        return tuple(ClockReading(*reading) for reading in self.clock)


def decode(text: str) -> JournalFacts:
    """Decode facts from the JSON text in the catalogue."""
    return msgspec.json.decode(text, type=JournalFacts)


def encode(facts: JournalFacts) -> str:
    """Encode facts as JSON text for the catalogue."""
    return msgspec.json.encode(facts).decode()


@dataclass(frozen=True, slots=True)
class InspectedJournal:
    """A verified journal file, and its row for the catalogue."""

    file: JournalFile
    row: dict[str, Any]


def checked_key(key: JournalKey) -> str:
    """Return the folder of a key.

    Raises UsageError for an invalid key, since paths are built from it.
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
    """Return the SHA-256 of a file, 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def inspect(
    key: JournalKey, path: Path, put_ns: int, *, is_checked: bool = False
) -> InspectedJournal:
    """Verify a whole journal file and return its description.

    With ``is_checked`` the verification is skipped, since the caller has just done it. Raises
    AmberboxError for a file with another hash, a damaged or unfinished one, or one of another
    store.
    """
    folder = checked_key(key)
    if not is_checked:
        _check(key, folder, path)
    file = journal_file(path, key.file)
    return InspectedJournal(file, _row(key, folder, file, put_ns))


def _check(key: JournalKey, folder: str, path: Path) -> None:
    if sha256_of(path) != key.sha256:
        raise AmberboxError(f"{key.file}: its content is not what was announced", _HINT)
    run, number = run_and_number(Path(key.file))
    start = start_record(path)
    identity = JournalIdentity(
        key.store_id, _WRITERS[folder], run, number, (start.get("chain", ""),)
    )
    checked = check_journal(CheckTarget(key.file, path, identity))
    bad = [finding for finding in checked.findings if finding.state in BAD]
    if bad or checked.torn or not start:
        text = bad[0].text if bad else "its end is torn" if checked.torn else "it is no journal"
        raise AmberboxError(f"{key.file}: {text}", _HINT)


def _row(key: JournalKey, folder: str, file: JournalFile, put_ns: int) -> dict[str, Any]:
    start_ns, end_ns = (
        ClockTable(file.clock).received(np.array([file.start_ns, file.end_ns])).tolist()
    )
    facts = JournalFacts(_few(file), selection_of(file), gap_facts(holes(file)))
    return {
        "robot": key.robot, "store_id": key.store_id, "file": key.file, "sha256": key.sha256,
        "bytes": file.bytes, "keeping": _WRITERS[folder], "writer": file.writer, "run": file.run,
        "first_seq": file.first_seq, "end_seq": file.end_seq, "start_ns": start_ns,
        "end_ns": end_ns, "facts": encode(facts), "put_ns": put_ns, "batch": None,
        "state": "put", "rows": file.rows, "raw_gone": False, "columns_gone": False,
        "own_gone": False,
    }  # fmt: skip


def _few(file: JournalFile) -> list[tuple[int, int, bool | None, int | None]]:
    """Return the clock readings without those that lie on the line between others."""
    needed = {log_ns for log_ns, _ in file.clock}
    kept: list[ClockReading] = []
    for number, reading in enumerate(file.readings):
        is_last = number == len(file.readings) - 1
        turned = bool(kept) and kept[-1].synchronised != reading.synchronised
        if is_last or turned or not kept or reading.log_ns in needed:
            kept.append(reading)
    return [(r.log_ns, r.offset_ns, r.synchronised, r.boot_ns) for r in kept]


def gap_facts(gaps: Sequence[Gap]) -> list[GapFact]:
    """Return the fields of gaps that are stored."""
    return [
        GapFact(g.from_ns, g.to_ns, g.reason, g.item, g.count, g.from_seq, g.to_seq) for g in gaps
    ]
