"""Verification of a journal that has come: hash, chain and signature, in a process of its own."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.follow.read import JournalFile, journal_file
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.store import FOLDERS, run_and_number
from amberbox.blackbox.verify.block import Identity
from amberbox.blackbox.verify.findings import BAD
from amberbox.blackbox.verify.journal import Checked, Target, check_journal
from amberbox.core.errors import AmberboxError
from amberbox.fleet.archive.journal import inspect
from amberbox.fleet.archive.store import JournalKey
from amberbox.fleet.asking.memory import limit_memory
from amberbox.fleet.uploads.content import ContentError, check_content
from amberbox.link.positions import is_in_range
from amberbox.link.proof import ProofError, Proven, prove
from amberbox.link.uploads import Proof

_FIRST_CHAIN = "0" * 64
_WRITER_OF = {folder: writer for writer, folder in FOLDERS.items()}
_MEMORY_BYTES = 2 << 30
_FACTS_BYTES = 8 << 20
_READ_BYTES = 1 << 20
_NICE = 5
_TRIES = 2
_LEAST_S, _BYTES_PER_S = 60.0, 2e6
"""Even the slowest computers verify many times as fast."""


@dataclass(frozen=True, slots=True)
class Claim:
    """A file that has come, and what its robot says it is."""

    path: Path
    robot: str
    store_id: str
    journal: str
    sha256: str
    proof: Proof | None
    public_key: str


@dataclass(frozen=True, slots=True)
class Result:
    """What a journal turned out to be; ``reason`` is empty when all of it holds.

    ``unread`` says that the file is not the one that was sent: sending it again may help.
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


def verify(claim: Claim) -> Result:
    """Check a file against what its robot has sealed and signed; any kind of damage is a reason."""
    if _sha256(claim.path) != claim.sha256:
        return Result("it did not arrive as it was sent", unread=True)
    proven = None
    try:
        proven = _proven(claim)
        sealed = proven.sealed if proven is not None else None
        checked = check_journal(_target(claim, sealed))
        return _in_range(_judged(claim, checked, proven))
    except ProofError as error:
        return Result(f"its proof does not hold: {error}")
    except ContentError as error:
        return _unreadable(f"it is not taken in: {error}", proven)
    except MemoryError:
        return _unreadable("to read it takes more memory than it may", proven)
    except Exception as error:  # whatever bytes do to a reader: it is told, and not taken
        return _unreadable(f"it cannot be read: {type(error).__name__}: {error}", proven)


def _in_range(result: Result) -> Result:
    """Refuse a journal whose positions or times no database, column or date can hold."""
    numbers = (result.run, result.number, result.first_seq, result.end_seq)
    if is_in_range(*numbers, result.start_ns, result.end_ns):
        return result
    return Result("its positions or times are out of range", writer=result.writer)


def _unreadable(reason: str, proven: Proven | None) -> Result:
    """Say what a file was that cannot be read, as far as its seal tells."""
    if proven is None:
        return Result(reason)
    seal = proven.sealed
    return _in_range(Result(
        reason, False, proven.signed, seal.writer, seal.run, seal.number, seal.first_seq,
        seal.end_seq, seal.start_ns, seal.end_ns,
    ))  # fmt: skip


def _proven(claim: Claim) -> Proven | None:
    """Check what the robot says of the file; only the ring's journals come without a seal."""
    if claim.proof is not None and claim.proof.lines:
        return prove(claim.proof, claim.store_id, claim.journal, claim.public_key)
    if _folder(claim) != FOLDERS["ring"]:
        raise ProofError("it was not sealed")
    return None


def _folder(claim: Claim) -> str:
    return claim.journal.partition("/")[0]


def _target(claim: Claim, sealed: Sealed | None) -> Target:
    run, number = run_and_number(Path(claim.journal))
    chains = tuple(c for c in (sealed.start_chain if sealed else "", _FIRST_CHAIN) if c)
    identity = Identity(claim.store_id, _WRITER_OF[_folder(claim)], run, number, chains)
    return Target(claim.journal, claim.path, identity, False, sealed)


def _judged(claim: Claim, checked: Checked, proven: Proven | None) -> Result:
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
    return Result(
        "; ".join(f"{finding.state}: {finding.text}" for finding in bad[:5]),
        False, proven is not None and proven.signed, identity.writer, identity.run,
        identity.number, first, end, *edges,
    )  # fmt: skip


def _content(claim: Claim, identity: Identity) -> JournalFile:
    """Look at what a sound file holds, and at what the archive will keep of it."""
    journal = check_content(claim.path, claim.journal, identity)
    key = JournalKey(claim.robot, claim.store_id, claim.journal, claim.sha256)
    facts = inspect(key, claim.path, 0, is_checked=True).row["facts"]
    if len(facts) > _FACTS_BYTES:
        raise ContentError("it says more of its clock and its gaps than can be kept")
    return journal


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(_READ_BYTES):
            digest.update(part)
    return digest.hexdigest()


def _seconds(path: Path) -> float:
    """Return how long a file may take: much longer than any that is none of a bomb."""
    try:
        return _LEAST_S + path.stat().st_size / _BYTES_PER_S
    except OSError:
        return _LEAST_S


class Verifier:
    """A worker process for verification; one that dies (a bomb, no memory) is replaced.

    It has one file at a time: what it dies over, or never comes to an end with, is that one.
    """

    def __init__(self, seconds: Callable[[Path], float] = _seconds) -> None:
        self._seconds = seconds
        self._turn = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None
        self._is_closed = False

    def check(self, claim: Claim) -> Result | None:
        """Verify a file; None when workers died over it. Blocks: call it in a thread.

        A worker may also die of something else (the system needs memory), so there is a second
        try. Raises AmberboxError when the server stops meanwhile: nothing is known of the file.
        """
        with self._turn:
            for _ in range(_TRIES):
                if self._is_closed:
                    raise AmberboxError("the server stops", "send it again later")
                self._pool = self._pool or _new_pool()
                found = self._tried(self._pool, claim)
                if found is not None:
                    return found
                self._stop()
        if self._is_closed:
            raise AmberboxError("the server stops", "send it again later")
        return None

    def _tried(self, pool: ProcessPoolExecutor, claim: Claim) -> Result | None:
        try:
            return pool.submit(verify, claim).result(self._seconds(claim.path))
        except TimeoutError:
            self._stop()
            return Result("to read it takes longer than it may")
        except (BrokenProcessPool, CancelledError, RuntimeError):
            return None

    def close(self) -> None:
        """End the worker, also in the middle of a file: it is verified when it is sent again."""
        self._is_closed = True
        self._stop()

    def _stop(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            # Python names no other way to the processes before 3.14
            workers = list((pool._processes or {}).values())
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.kill()


def _new_pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        1, mp_context=multiprocessing.get_context("spawn"), initializer=_begin
    )


def _begin() -> None:
    """Keep the worker from taking the server's memory or time, and from outliving a killed one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends it
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    os.nice(_NICE)
    limit_memory(_MEMORY_BYTES)


def _leave_with_parent() -> None:
    """End at once when the server has ended: it can be killed without a word to its workers."""
    server = multiprocessing.parent_process()
    if server is not None:
        server.join()
        os._exit(1)
