"""Bytes by their place: a file on disk or a piece in memory, where what is missing is short."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

from amberbox.core.errors import AmberboxError


class ByteSource(Protocol):
    """Something that is read at an offset; behind the end there are no bytes."""

    size: int

    def read(self, offset: int, length: int) -> bytes:
        """Return up to ``length`` bytes from ``offset`` on."""


class FileBytes:
    """A file read by offset, not mapped: a bad sector is an error, not the end of the process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise AmberboxError(
                f"cannot open {path}: {error.strerror}", "check the path and its permissions"
            ) from None
        self.size = os.fstat(self._fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        try:
            return os.pread(self._fd, min(length, max(0, self.size - offset)), offset)
        except OSError as error:
            raise AmberboxError(
                f"cannot read {self.path} at byte {offset}: {error.strerror}",
                "copy the disk with ddrescue first and read the copy",
            ) from None

    def close(self) -> None:
        """Give the file back; closing twice is harmless."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class MemoryBytes:
    """Bytes in memory, such as a chunk that was unpacked."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.size = len(data)

    def read(self, offset: int, length: int) -> bytes:
        return self.data[offset : offset + length]
