"""A file in memory, read as it is needed."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeAlias

Buffer: TypeAlias = "bytes | memoryview"


@contextmanager
def open_buffer(path: Path) -> Iterator[Buffer]:
    """Map a file into memory; an empty file gives empty bytes."""
    with path.open("rb") as file:
        if file.seek(0, 2) == 0:
            yield b""
            return
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    view = memoryview(mapped)
    try:
        yield view
    finally:
        with suppress(BufferError):  # an exception may still hold a slice of it
            view.release()
            mapped.close()
