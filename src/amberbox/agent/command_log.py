"""The robot's command log: a file of answers that are on the disk before they count.

One record a line, ``CRC JSON``: answers (``accepted`` is one), lease numbers, revocations, and how
far the server has stored the answers. What was appended is synced before ``add`` returns, so an
``accepted`` without an end was being carried out when the process or the power went. The newest
100,000 ids are remembered, so that no command runs twice. Answers to orders that came from this
robot itself carry their ``origin``; no server waits for them.

The file is replaced at opening, after a failure, and when most of it is no longer needed: the new
one is complete and synced before it takes the name, so that a power cut leaves the old or the new
one.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import msgspec
from msgspec import Struct

from amberbox.core.command import FINAL, MOST_ORDERS, CommandAnswer
from amberbox.core.errors import AmberboxError

MOST_IDS = 100_000
# Results of so many answers are kept until the server has them
RESULTS = 200
TIDY_BYTES = 1 << 20
# Orders of so many rules of recovery are counted, and of each the newest
MOST_RULES = 200
_NUMBERS_LOST = 1000  # a damaged line may have held higher numbers than those that can be read
_BLOCK = 1 << 20


class CommandLogError(AmberboxError):
    """The log could not be written or read; no command may run."""


class FileSystem(Protocol):
    """The system calls of the log; the module ``os`` has them, tests have a disk of their own."""

    def open(self, path: str, flags: int, mode: int = ..., /) -> int: ...
    def read(self, fd: int, size: int, /) -> bytes: ...
    def write(self, fd: int, data: bytes, /) -> int: ...
    def fsync(self, fd: int, /) -> None: ...
    def ftruncate(self, fd: int, size: int, /) -> None: ...
    def close(self, fd: int, /) -> None: ...
    def replace(self, source: str, target: str, /) -> None: ...


class _Answer(Struct, frozen=True, tag="answer"):
    digest: str
    answer: CommandAnswer
    origin: str = ""


class _Lease(Struct, frozen=True, tag="lease"):
    number: int


class _Revoked(Struct, frozen=True, tag="revoked"):
    keys: list[str]


class _Acknowledged(Struct, frozen=True, tag="acknowledged"):
    number: int


class _Counters(Struct, frozen=True, tag="counters"):
    """The first line of a file that replaced another one."""

    answers: int
    acknowledged: int
    lease: int


_Record = _Answer | _Lease | _Revoked | _Acknowledged | _Counters
_DECODER: msgspec.json.Decoder[_Record] = msgspec.json.Decoder(_Record)
_ANSWERS: msgspec.json.Decoder[_Answer] = msgspec.json.Decoder(_Answer)


class CommandLogFile:
    """The log in a file; only one process may have it open.

    ``notes`` says what was repaired at opening. Raises CommandLogError when the file cannot be
    read, or not be replaced. A file of at most ``tidy_bytes`` is not worth replacing.
    """

    def __init__(
        self,
        path: Path,
        system: FileSystem = os,
        most_ids: int = MOST_IDS,
        tidy_bytes: int = TIDY_BYTES,
    ) -> None:
        self._path, self._part = str(path), f"{path}.part"
        self._folder, self._system, self._most = str(path.parent), system, most_ids
        self._tidy_bytes = tidy_bytes
        self.notes: list[str] = []
        self.lease_number = 0
        self._answers = self._acknowledged = 0
        self._revoked: set[str] = set()
        # of each id the newest answer, encoded and without its result; in the order of first sight
        self._seen: dict[str, bytes] = {}
        self._running: dict[str, CommandAnswer] = {}
        self._unanswered: dict[str, CommandAnswer] = {}
        self._results: dict[str, None] = {}
        # of each origin the ids of its orders that were accepted, oldest first
        self._attempts: dict[str, dict[str, None]] = {}
        # whether all of the file is on the disk; else it is replaced before the next record
        self._is_sound = False
        self._size = self._replaced_size = 0
        try:
            self._fd = system.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o640)
        except OSError as error:
            raise _failure(self._path, error) from error
        try:
            self._read()
            # A sync may have failed before: what can be read need not be on the disk. And the torn
            # tail, and what a killed process did not sync, are dealt with on the way.
            self._replace()
        except OSError as error:
            self.close()
            raise _failure(self._path, error) from error

    def _read(self) -> None:
        """Read the records of the file; note what is torn or damaged."""
        content = bytearray()
        while block := self._system.read(self._fd, _BLOCK):
            content += block
        end = at = damaged = bad = 0
        for line in content.splitlines(keepends=True):
            at += len(line)
            record = _decoded(bytes(line))
            if record is None:
                bad += 1
                continue
            self._apply(record)
            end, damaged = at, bad
        if damaged:
            self._answers += _NUMBERS_LOST
            self.lease_number += _NUMBERS_LOST
            self.notes.append(f"{self._path}: {damaged} damaged lines were skipped")
        if end < len(content):
            what = f"the last {len(content) - end} bytes were torn and were cut off"
            self.notes.append(f"{self._path}: {what}")

    # -- what is known

    @property
    def revoked(self) -> Collection[str]:
        """Ids of the keys that were revoked."""
        return self._revoked

    def seen(self, command_id: str) -> tuple[str, CommandAnswer] | None:
        """Return digest and newest answer of a command; None for one that is not known."""
        known = self._seen.get(command_id)
        if known is None:
            return None
        found = _ANSWERS.decode(known)
        return found.digest, self._unanswered.get(command_id, found.answer)

    def origin(self, command_id: str) -> str:
        """Return where an order of this robot itself came from; empty for any other command."""
        known = self._seen.get(command_id)
        return "" if known is None else _ANSWERS.decode(known).origin

    def attempts(self, origin: str) -> list[CommandAnswer]:
        """Return the newest answer of each order of an origin that was accepted, oldest first."""
        found = map(self.seen, self._attempts.get(origin, ()))
        return [known[1] for known in found if known is not None]

    def running(self) -> list[tuple[str, CommandAnswer]]:
        """Return digest and answer of each command that was accepted and has not ended."""
        return [found for found in map(self.seen, self._running) if found is not None]

    def unanswered(self) -> list[CommandAnswer]:
        """Return the answers that the server has not stored yet, of each command the newest."""
        return sorted(self._unanswered.values(), key=lambda answer: answer.number)

    # -- what is added

    def add(self, answer: CommandAnswer, digest: str, origin: str = "") -> CommandAnswer:
        """Store an answer under the next number, and return it once it survives a power cut.

        ``origin`` is that of an order of this robot itself; later answers to it keep it. Raises
        CommandLogError, and then it does not count.
        """
        numbered = msgspec.structs.replace(answer, number=self._answers + 1)
        self._append(_Answer(digest, numbered, origin or self.origin(answer.id)))
        return numbered

    def add_lease(self, number: int) -> None:
        """Store the number of a lease that is about to be given; raises CommandLogError."""
        self._append(_Lease(number))

    def add_revoked(self, keys: Iterable[str]) -> None:
        """Store ids of revoked keys; raises CommandLogError."""
        self._append(_Revoked(sorted(keys)))

    def acknowledge(self, number: int) -> None:
        """Note that the server has stored all answers up to a number.

        A number that was never given is of another history, and means nothing. It is not synced:
        at worst answers are sent again. Raises CommandLogError.
        """
        if self._acknowledged < number <= self._answers:
            self._append(_Acknowledged(number), is_synced=False)

    def _append(self, record: _Record, *, is_synced: bool = True) -> None:
        line = _line(record)
        try:
            if not self._is_sound:
                self._replace()
            _write(self._system, self._fd, line)
            if is_synced:
                self._system.fsync(self._fd)
        except OSError as error:
            # After a failed sync the system takes the pages as written: only a new file is sure.
            self._is_sound = False
            with suppress(OSError):  # so that a record that does not count is not found either
                self._system.ftruncate(self._fd, self._size)
            raise _failure(self._path, error) from error
        self._size += len(line)
        self._apply(record)

    def _apply(self, record: _Record) -> None:
        match record:
            case _Answer():
                self._apply_answer(record)
            case _Lease(number):
                self.lease_number = max(self.lease_number, number)
            case _Revoked(keys):
                self._revoked.update(keys)
            case _Acknowledged(number):
                self._acknowledged = max(self._acknowledged, number)
                kept = {i: a for i, a in self._unanswered.items() if a.number > number}
                self._unanswered = kept
                self._results = {i: None for i in self._results if i in kept}
            case _Counters():
                self._answers = max(self._answers, record.answers)
                self._acknowledged = max(self._acknowledged, record.acknowledged)
                self.lease_number = max(self.lease_number, record.lease)

    def _apply_answer(self, record: _Answer) -> None:
        answer = record.answer
        self._answers = max(self._answers, answer.number)
        bare = msgspec.structs.replace(answer, result="")
        self._seen[answer.id] = msgspec.json.encode(msgspec.structs.replace(record, answer=bare))
        if answer.state in FINAL:
            self._running.pop(answer.id, None)
        else:
            self._running[answer.id] = bare
        if record.origin:
            self._count_attempt(record.origin, answer)
        elif answer.number > self._acknowledged:
            self._unanswered[answer.id] = answer
            if answer.result:
                self._results[answer.id] = None
        if len(self._results) > RESULTS:
            oldest = next(iter(self._results))
            del self._results[oldest]
            without = msgspec.structs.replace(self._unanswered[oldest], result="")
            self._unanswered[oldest] = without
        while len(self._seen) > self._most and self._forget_oldest():
            pass

    def _count_attempt(self, origin: str, answer: CommandAnswer) -> None:
        if answer.state == "refused":
            return
        ids = self._attempts.setdefault(origin, {})
        ids[answer.id] = None
        if len(ids) > MOST_ORDERS:
            del ids[next(iter(ids))]
        if len(self._attempts) > MOST_RULES:
            del self._attempts[next(iter(self._attempts))]

    def _forget_oldest(self) -> bool:
        """Forget the oldest id that is no longer needed; return whether there was one.

        Needed are commands that run, and orders that count against a limit.
        """
        kept = {*self._running, *(one for ids in self._attempts.values() for one in ids)}
        oldest = next((known for known in self._seen if known not in kept), None)
        if oldest is None:
            return False
        del self._seen[oldest]
        self._unanswered.pop(oldest, None)
        self._results.pop(oldest, None)
        return True

    # -- compaction

    def tidy(self) -> None:
        """Replace the file where at least half of it is no longer needed.

        It takes as long as the disk needs for up to 40 MB, so call it while nothing runs. Without
        room for the new file the old one goes on.
        """
        if self._size > max(self._tidy_bytes, 2 * self._replaced_size):
            with suppress(OSError):
                self._replaced_size = self._size  # not at once again where it fails
                self._replace()

    def _replace(self) -> None:
        """Write what is known to a new file and give it the name of the old one."""
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_TRUNC
        fd = self._system.open(self._part, flags, 0o640)
        try:
            size = 0
            for data in _blocks(self._records()):
                _write(self._system, fd, data)
                size += len(data)
            self._system.fsync(fd)
            self._system.replace(self._part, self._path)
        except BaseException:
            self._system.close(fd)
            raise
        old, self._fd = self._fd, fd
        self._size = self._replaced_size = size
        self._is_sound = False  # until its name is on the disk, too
        self._system.close(old)
        folder = self._system.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            self._system.fsync(folder)
        finally:
            self._system.close(folder)
        self._is_sound = True

    def _records(self) -> Iterator[_Record]:
        yield _Counters(self._answers, self._acknowledged, self.lease_number)
        if self._revoked:
            yield _Revoked(sorted(self._revoked))
        for command_id, known in self._seen.items():
            found = _ANSWERS.decode(known)
            answer = self._unanswered.get(command_id, found.answer)
            yield _Answer(found.digest, answer, found.origin)

    def close(self) -> None:
        """Close the file."""
        self._system.close(self._fd)


def _failure(path: str, error: OSError) -> CommandLogError:
    why = error.strerror or str(error)
    return CommandLogError(
        f"the command log {path} cannot be used: {why}", "no command runs before that is repaired"
    )


def _line(record: _Record) -> bytes:
    text = msgspec.json.encode(record)
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _decoded(line: bytes) -> _Record | None:
    """Return the record in a line; None if it is torn or damaged."""
    checksum, _, text = line.removesuffix(b"\n").partition(b" ")
    if not line.endswith(b"\n") or checksum != b"%08x" % zlib.crc32(text):
        return None
    try:
        return _DECODER.decode(text)
    except msgspec.MsgspecError:
        return None


def _blocks(records: Iterable[_Record]) -> Iterator[bytes]:
    block = bytearray()
    for record in records:
        block += _line(record)
        if len(block) >= _BLOCK:
            yield bytes(block)
            block.clear()
    yield bytes(block)


def _write(system: FileSystem, fd: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[system.write(fd, bytes(view)) :]
