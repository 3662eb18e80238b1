"""One file out of many: a ZIP with a list of what is in it."""

from __future__ import annotations

import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import msgspec

from amberbox.core.timetext import format_time
from amberbox.fleet.jobs.plan import file_name
from amberbox.fleet.jobs.workshop import Entry, Workshop

CONTENTS = "contents.json"

_COPY_BYTES = 1 << 20
_TEXTS = (".csv", ".json")


def pack(workshop: Workshop, asked_ns: int, made: list[Path]) -> Iterator[float]:
    """Put the files of a download into one, whose path is added to ``made``; gives progress."""
    entries = workshop.entries
    if len(entries) == 1:
        (entry,) = entries
        target = workshop.path / file_name(workshop.wanted, asked_ns, entry.path.suffix)
        os.link(entry.path, target)
    else:
        target = workshop.path / file_name(workshop.wanted, asked_ns, ".zip")
        yield from _zipped(workshop, asked_ns, target)
    with target.open("rb") as file:
        os.fsync(file.fileno())
    shutil.rmtree(workshop.path / "files", ignore_errors=True)
    made.append(target)


def _zipped(workshop: Workshop, asked_ns: int, target: Path) -> Iterator[float]:
    total = sum(entry.path.stat().st_size for entry in workshop.entries) or 1
    done = 0
    with zipfile.ZipFile(target, "w", allowZip64=True, compresslevel=3) as file:
        file.writestr(CONTENTS, _contents(workshop, asked_ns))
        for entry in workshop.entries:
            for size in _add(file, entry):
                done += size
                yield done / total


def _add(file: zipfile.ZipFile, entry: Entry) -> Iterator[int]:
    info = zipfile.ZipInfo.from_file(entry.path, entry.name)
    is_text = entry.path.suffix in _TEXTS
    info.compress_type = zipfile.ZIP_DEFLATED if is_text else zipfile.ZIP_STORED
    with entry.path.open("rb") as source, file.open(info, "w") as target:
        while piece := source.read(_COPY_BYTES):
            target.write(piece)
            yield len(piece)


def _contents(workshop: Workshop, asked_ns: int) -> bytes:
    files = [
        {"name": entry.name, "bytes": entry.path.stat().st_size, "sha256": entry.sha256 or None}
        for entry in workshop.entries
    ]
    asked = msgspec.to_builtins(workshop.wanted)
    for name in ("from_ns", "to_ns"):
        moment = asked.pop(name)
        asked[name.removesuffix("_ns")] = None if moment is None else format_time(moment)
    said = {"asked": asked, "asked_at": format_time(asked_ns), "files": files}
    return msgspec.json.format(msgspec.json.encode({**said, "notes": workshop.notes}), indent=2)
