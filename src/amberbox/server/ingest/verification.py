"""Verification of an uploaded journal in a worker process: hash, chain, signature and content."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.columns.unroll import MOST_SCHEMA_BYTES
from amberbox.blackbox.journal.chunk import Chunk, open_buffer
from amberbox.blackbox.journal.mcap import McapChannel, parse_chunk_head
from amberbox.blackbox.journal.scan import ChunkPlace, read_chunk, scan
from amberbox.blackbox.signing.findings import BAD
from amberbox.blackbox.signing.journal_check import (
    CheckedJournal,
    CheckTarget,
    JournalIdentity,
    check_journal,
)
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.journal_reader import JournalFile, describe, journal_file
from amberbox.blackbox.store.store import FOLDERS, run_and_number
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.names import has_item_form
from amberbox.core.types import Schema
from amberbox.link.frames import is_in_range
from amberbox.link.uploads import Proof, ProofError, ProvenSeal, check_proof
from amberbox.server.journals import JournalKey, inspect, sha256_of
from amberbox.server.workers.pool import PROGRAM, WorkerPool
from amberbox.server.workers.protocol import (
    BrokenError,
    BusyError,
    CancelledError,
    LimitError,
    WorkerTask,
    memory_limit,
)

MOST_CHANNELS = 10_000
# Limit of an unpacked chunk; the recorder packs about 1 MB at a time
MOST_CHUNK_BYTES = 64 << 20
# Limit of all unpacked chunks of a file; the recorder begins a new file after 64 MB
MOST_BYTES = 16 << 30
MOST_MESSAGES = 50_000_000
# Each day of receipt is a file of its own in each table; a recorder begins new files in minutes
MOST_DAYS = 400

_DAY_NS = 24 * 3600 * NS


class ContentError(ValueError):
    """A journal with content that no robot writes and no server accepts."""


def check_content(path: Path, name: str, identity: JournalIdentity) -> JournalFile:
    """Return the description of a journal after checking its whole content.

    Raises ContentError for one that is not the journal of its name, or has invalid names or
    content.
    """
    found = scan(path)
    summary = found.summary
    _check_definitions(summary.channels, summary.schemas)
    with open_buffer(path) as data:
        _check_sizes(data, found.places)
        _check_chunks(filter(None, (read_chunk(data, place) for place in found.places)))
    journal = describe(found, name)
    # readers use the identity stated in the file
    stated = journal.store_id, journal.writer, journal.run, journal.number
    if stated != (identity.store_id, identity.writer, identity.run, identity.number):
        raise ContentError("it does not say at its start that it is the file of its name")
    return journal


def _check_definitions(channels: Mapping[int, McapChannel], schemas: Mapping[int, Schema]) -> None:
    if max(len(channels), len(schemas)) > MOST_CHANNELS:
        raise ContentError(f"it has more than {MOST_CHANNELS} channels or schemas")
    for schema in schemas.values():
        if len(schema.data) > MOST_SCHEMA_BYTES:
            raise ContentError(f"a schema has more than {MOST_SCHEMA_BYTES >> 20} MB")
    for channel in channels.values():
        item = channel.metadata.get("item", "")
        if item and not has_item_form(item):
            shown = ascii(item[:60])
            raise ContentError(f"it names an item {shown}: letters, digits and _ make a name")


def _check_sizes(data: bytes | memoryview, places: list[ChunkPlace]) -> None:
    """Compare the sizes stated by compressed chunks with the limits, before any is unpacked."""
    total = 0
    for place in places:
        head = parse_chunk_head(data, place.offset)
        if head is None or not head.compression:
            continue
        total += head.size
        if head.size > MOST_CHUNK_BYTES:
            raise ContentError(f"a chunk unpacks to more than {MOST_CHUNK_BYTES >> 20} MB")
    if total > MOST_BYTES:
        raise ContentError(f"it unpacks to more than {MOST_BYTES >> 30} GB")


def _check_chunks(chunks: Iterator[Chunk]) -> None:
    messages, days = 0, set[int]()
    for chunk in chunks:
        _check_definitions(chunk.channels, chunk.schemas)
        messages += len(chunk)
        if not len(chunk):
            continue
        if int(chunk.log_ns.min()) < 0:
            raise ContentError("a message is of a time that no clock shows")
        days.update(np.unique(chunk.log_ns // _DAY_NS).tolist())
        if messages > MOST_MESSAGES:
            raise ContentError(f"it has more than {MOST_MESSAGES} messages")
        if len(days) > MOST_DAYS:
            raise ContentError(f"it has messages of more than {MOST_DAYS} days")


OP = "amberbox.server.ingest.worker:verify"

_FIRST_CHAIN = "0" * 64
_WRITER_OF = {folder: writer for writer, folder in FOLDERS.items()}
_MEMORY_BYTES = 2 << 30
_FACTS_BYTES = 8 << 20
_NICE = 5
_TRIES = 2
# Even the slowest computers verify many times as fast
_LEAST_S, _BYTES_PER_S = 60.0, 2e6


@dataclass(frozen=True, slots=True)
class UploadClaim:
    """An uploaded file, and the journal that the robot claims it to be."""

    path: Path
    robot: str
    store_id: str
    journal: str
    sha256: str
    proof: Proof | None
    public_key: str


@dataclass(frozen=True, slots=True)
class VerificationResult:
    """The result of a verification; ``reason`` is empty when the journal is valid.

    ``unread``: the file is not the one that was sent; sending it again may help.
    """

    reason: str = ""
    unread: bool = False
    signed: bool = False
    writer: str = ""
    run: int = 0
    number: int = 0
    first_seq: int = 0
    end_seq: int = 0
    start_ns: int = 0
    end_ns: int = 0


def verify(claim: UploadClaim) -> VerificationResult:
    """Verify a file against its robot's seal and signature; any damage becomes the ``reason``."""
    if sha256_of(claim.path) != claim.sha256:
        return VerificationResult("it did not arrive as it was sent", unread=True)
    proven = None
    try:
        proven = _proven(claim)
        sealed = proven.sealed if proven is not None else None
        run, number = run_and_number(Path(claim.journal))
        chains = tuple(c for c in (sealed.start_chain if sealed else "", _FIRST_CHAIN) if c)
        identity = JournalIdentity(claim.store_id, _WRITER_OF[_folder(claim)], run, number, chains)
        checked = check_journal(CheckTarget(claim.journal, claim.path, identity, False, sealed))
        return _in_range(_judged(claim, checked, proven))
    except ProofError as error:
        return VerificationResult(f"its proof does not hold: {error}")
    except ContentError as error:
        return _unreadable(f"it is not taken in: {error}", proven)
    except MemoryError:
        return _unreadable("to read it takes more memory than it may", proven)
    except Exception as error:  # any error from damaged bytes becomes the result
        return _unreadable(f"it cannot be read: {type(error).__name__}: {error}", proven)


def _in_range(result: VerificationResult) -> VerificationResult:
    """Refuse a journal whose positions or times do not fit databases, columns or dates."""
    numbers = (result.run, result.number, result.first_seq, result.end_seq)
    if is_in_range(*numbers, result.start_ns, result.end_ns):
        return result
    return VerificationResult("its positions or times are out of range", writer=result.writer)


def _unreadable(reason: str, proven: ProvenSeal | None) -> VerificationResult:
    """Return the result for an unreadable file, as far as its seal describes it."""
    if proven is None:
        return VerificationResult(reason)
    seal = proven.sealed
    return _in_range(VerificationResult(
        reason, False, proven.signed, seal.writer, seal.run, seal.number, seal.first_seq,
        seal.end_seq, seal.start_ns, seal.end_ns,
    ))  # fmt: skip


def _proven(claim: UploadClaim) -> ProvenSeal | None:
    """Check the robot's proof of the file; only the ring's journals have no seal."""
    if claim.proof is not None and claim.proof.lines:
        return check_proof(claim.proof, claim.store_id, claim.journal, claim.public_key)
    if _folder(claim) != FOLDERS["ring"]:
        raise ProofError("it was not sealed")
    return None


def _folder(claim: UploadClaim) -> str:
    return claim.journal.partition("/")[0]


def _judged(
    claim: UploadClaim, checked: CheckedJournal, proven: ProvenSeal | None
) -> VerificationResult:
    bad = [finding for finding in checked.findings if finding.state in BAD]
    identity = checked.target.identity
    journal = None if bad else _content(claim, identity)
    if proven is not None:
        known = proven.sealed
        edges = known.start_ns, known.end_ns
        first, end = known.first_seq, known.end_seq
    else:
        journal = journal or journal_file(claim.path, claim.journal)
        edges = ClockTable(journal.clock).bounds()
        edges = journal.start_ns + edges[0], journal.end_ns + edges[1]
        first, end = journal.first_seq, journal.end_seq
    return VerificationResult(
        "; ".join(f"{finding.state}: {finding.text}" for finding in bad[:5]),
        False, proven is not None and proven.signed, identity.writer, identity.run,
        identity.number, first, end, *edges,
    )  # fmt: skip


def _content(claim: UploadClaim, identity: JournalIdentity) -> JournalFile:
    """Check the content of a valid file, and the size of its facts for the catalogue."""
    journal = check_content(claim.path, claim.journal, identity)
    key = JournalKey(claim.robot, claim.store_id, claim.journal, claim.sha256)
    facts = inspect(key, claim.path, 0, is_checked=True).row["facts"]
    if len(facts) > _FACTS_BYTES:
        raise ContentError("it says more of its clock and its gaps than can be kept")
    return journal


def _seconds(path: Path) -> float:
    """Return the time limit in seconds for a file, much longer than any honest file takes."""
    try:
        return _LEAST_S + path.stat().st_size / _BYTES_PER_S
    except OSError:
        return _LEAST_S


class Verifier:
    """A worker process for verification; one that dies (archive bomb, no memory) is replaced.

    It has one file at a time, so the file is known over which it dies or never ends.
    """

    def __init__(self, seconds: Callable[[Path], float] = _seconds, program: str = PROGRAM) -> None:
        self._seconds = seconds
        self._pool = WorkerPool(Path(), 1, nice=_NICE, program=program)

    @property
    def pids(self) -> list[int]:
        """The process ids of the worker, while it runs."""
        return self._pool.pids

    def check(self, claim: UploadClaim) -> VerificationResult | None:
        """Verify a file; None when workers died while verifying it. Blocks: call it in a thread.

        A worker may also die for other reasons (the system needs memory), so there is a second try.
        Raises AmberboxError when the server stops meanwhile: the file's state is then unknown.
        """
        arguments = msgspec.to_builtins(claim, enc_hook=str)
        for _ in range(_TRIES):
            answer = bytearray()
            limit_s, memory_bytes = self._seconds(claim.path), memory_limit(_MEMORY_BYTES)
            task = WorkerTask(OP, arguments, answer.extend, limit_s, memory_bytes)
            try:
                self._pool.submit(task)
                task.done.result()
                return _result(answer)
            except LimitError:
                if task.exit_code is None:
                    return VerificationResult("to read it takes longer than it may")
            except BrokenError:
                continue
            except (BusyError, CancelledError):
                raise AmberboxError("the server stops", "send it again later") from None
        return None

    def close(self) -> None:
        """End the worker, also during a file, which is verified when it is sent again."""
        self._pool.close()


def _result(answer: bytearray) -> VerificationResult:
    """Decode the worker's answer; raises OSError for a file that could not be read."""
    found = msgspec.msgpack.decode(answer, type=Verified)
    if found.result is None:
        raise OSError(found.errno, found.error)
    return found.result


class Verified(msgspec.Struct):
    """The worker's answer: a result, or the system's error for an unreadable file."""

    result: VerificationResult | None = None
    errno: int = 0
    error: str = ""


def verify_arguments(arguments: Mapping[str, Any]) -> bytes:
    """Verify the file of a claim; return ``Verified`` as msgpack."""
    claim = msgspec.convert(arguments, UploadClaim, dec_hook=lambda kind, value: kind(value))
    try:
        result = verify(claim)
    except OSError as error:
        return msgspec.msgpack.encode(Verified(None, error.errno or 0, error.strerror or ""))
    reason = result.reason.encode("utf-8", "replace").decode()
    return msgspec.msgpack.encode(Verified(replace(result, reason=reason)))
