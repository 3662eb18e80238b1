"""Compare two captures byte for byte and show where they begin to differ."""

from __future__ import annotations

import difflib
import io
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

_CONTEXT = 2
_WIDTH = 220


def differences(base: Path, new: Path) -> list[str]:
    """Return the paths, relative to the captures, of files that differ or are on one side only."""
    names = {
        path.relative_to(side).as_posix()
        for side in (base, new)
        for path in side.rglob("*")
        if path.is_file()
    }
    return sorted(name for name in names if not _same(base / name, new / name))


def report(base: Path, new: Path, found: list[str], *, files: int = 12, lines: int = 30) -> str:
    """Show the first differences of the first files that differ."""
    shown = []
    for name in found[:files]:
        shown.append(f"=== {name}")
        shown += [line[:_WIDTH] for line in _first(base / name, new / name, lines)]
    if len(found) > files:
        shown += ["", f"{len(found) - files} more files differ:", *found[files : files + 40]]
    return "\n".join(shown)


def _same(base: Path, new: Path) -> bool:
    return base.is_file() and new.is_file() and base.read_bytes() == new.read_bytes()


def _first(base: Path, new: Path, lines: int) -> Iterator[str]:
    for side, path in (("base", base), ("new", new)):
        if not path.is_file():
            yield f"is not there on the side of {side}"
            return
    before, after = _readable(base), _readable(new)
    found = difflib.unified_diff(before, after, "base", "new", lineterm="", n=_CONTEXT)
    shown = [line for _, line in zip(range(lines), found, strict=False)]
    if not shown:
        shown = [_offset(base.read_bytes(), new.read_bytes())]
    yield from shown


def _offset(base: bytes, new: bytes) -> str:
    place = next((i for i, (a, b) in enumerate(zip(base, new, strict=False)) if a != b), -1)
    place = min(len(base), len(new)) if place < 0 else place
    return (
        f"{len(base)} and {len(new)} bytes, different from byte {place}: "
        f"{base[place : place + 24].hex(' ')} | {new[place : place + 24].hex(' ')}"
    )


def _readable(path: Path) -> list[str]:
    """Return a file as lines: journals and tables decoded, other binaries as nothing."""
    data = path.read_bytes()
    with suppress(Exception):  # a broken file is shown by its bytes
        if path.suffix == ".mcap":
            return list(_messages(data))
        if path.suffix == ".parquet":
            return list(_rows(data))
    try:
        return data.decode().splitlines()
    except UnicodeDecodeError:
        return []


def _messages(data: bytes) -> Iterator[str]:
    from mcap.reader import make_reader

    for _, channel, message in make_reader(io.BytesIO(data)).iter_messages():
        yield f"{message.log_time} {message.sequence} {channel.topic} {message.data!r}"


def _rows(data: bytes) -> Iterator[str]:
    import pyarrow.parquet

    table: Any = pyarrow.parquet.read_table(io.BytesIO(data))
    yield from str(table.schema).splitlines()
    for row in table.to_pylist():
        yield json.dumps(row, default=str)
