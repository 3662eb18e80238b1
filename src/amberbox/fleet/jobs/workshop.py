"""Where a download is made: its files, what is noted about it, and how much room it has."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.core.files import below
from amberbox.fleet.asking.errors import LimitError
from amberbox.fleet.jobs.wanted import Wanted

_FREE_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class Entry:
    """A file of a download: its name there, where it lies, and its SHA-256 if that is known."""

    name: str
    path: Path
    sha256: str = ""


@dataclass
class Workshop:
    """The folder ``path`` of one download; ``server`` is the server's data folder."""

    server: Path
    path: Path
    wanted: Wanted
    most_bytes: int
    entries: list[Entry] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def place(self, folder: str, name: str) -> Path:
        """Return the path of a new file."""
        where = self.path / "files" / folder
        where.mkdir(parents=True, exist_ok=True)
        return below(where, name)

    def add(self, path: Path) -> None:
        """Count a file that is finished among those of the download."""
        self.entries.append(Entry(str(path.relative_to(self.path / "files")), path))

    def note(self, *texts: str) -> None:
        """Say what whoever asked should know; once."""
        self.notes += [text for text in dict.fromkeys(texts) if text not in self.notes]

    def check(self, more: Sequence[Path] = ()) -> None:
        """Raise LimitError when the download, or the disk, has become too full."""
        size = sum(entry.path.stat().st_size for entry in self.entries)
        size += sum(path.stat().st_size for path in more if path.exists())
        if size > self.most_bytes:
            limit = f"{self.most_bytes / 1e9:g} GB"
            raise LimitError(f"the download would be larger than {limit}", "ask for less at a time")
        if shutil.disk_usage(self.path).free < _FREE_BYTES:
            raise LimitError("the server's disk is nearly full", "make room, then ask again")
