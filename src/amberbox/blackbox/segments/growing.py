"""A file of lines that is read again and again while it grows: each line is looked at once."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Generic, Protocol, TypeVar

from amberbox.blackbox.segments.lines import MALFORMED, NONSENSE, LineReader, Record

Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)


class State(Protocol[Result_co]):
    """What the lines read so far add up to."""

    def take(self, record: Mapping[str, Any]) -> None:
        """Add one record."""

    def result(self, read: LineReader) -> Result_co:
        """Return what it all says, not touched by records to come."""


class GrowingLines(Generic[Result]):
    """Reads one file, and later only what was appended since; a replaced file is read anew."""

    def __init__(self, path: Path, begin: Callable[[], State[Result]]) -> None:
        self._path = path
        self._begin = begin
        self._nothing = begin().result(LineReader())
        self._lock = threading.Lock()
        self._start_again()

    def _start_again(self) -> None:
        self._state, self._lines = self._begin(), LineReader()
        self._size, self._last_line = 0, b""
        self._seen: tuple[int, int, int] | None = None
        self._result = self._nothing

    def read(self) -> Result:
        """Return what the file says now; nothing when it is not there."""
        with self._lock:
            try:
                with self._path.open("rb") as file:
                    return self._read(file)
            except FileNotFoundError:
                return self._nothing

    def _read(self, file: BinaryIO) -> Result:
        status = os.fstat(file.fileno())
        seen = (status.st_ino, status.st_mtime_ns, status.st_size)
        if seen != self._seen:
            if not self._goes_on(file, status):
                self._start_again()
            self._result = self._read_on(file)
            self._seen = seen
        return self._result

    def _goes_on(self, file: BinaryIO, status: os.stat_result) -> bool:
        """Tell whether the file is the one read before, with lines added."""
        if self._seen is None or status.st_ino != self._seen[0] or status.st_size <= self._size:
            return False
        file.seek(self._size - len(self._last_line))
        return file.read(len(self._last_line)) == self._last_line

    def _read_on(self, file: BinaryIO) -> Result:
        file.seek(self._size)
        whole, newline, torn = file.read().rpartition(b"\n")
        if newline:
            _take(self._state, self._lines, self._lines.take(whole))
            self._size += len(whole) + 1
            self._last_line = whole[whole.rfind(b"\n") + 1 :] + newline
        return self._with_torn(file) if torn else self._state.result(self._lines)

    def _with_torn(self, file: BinaryIO) -> Result:
        """Read all of it aside: what has no end yet may come differently next time."""
        file.seek(0)
        state, reader = self._begin(), LineReader()
        _take(state, reader, reader.take(file.read(), ends=False))
        return state.result(reader)


def _take(state: State[Any], reader: LineReader, records: Iterable[tuple[int, Record]]) -> None:
    """Add records; one that cannot be understood although its hash holds is named as damage."""
    for number, record in records:
        try:
            state.take(record)
        except MALFORMED:
            reader.damage.append(f"line {number}: {NONSENSE}")
