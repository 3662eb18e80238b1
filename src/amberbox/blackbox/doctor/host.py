"""The computer as the doctor sees it: small files of the system, read and never written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.core.clock import Clock, SystemClock


@dataclass(frozen=True)
class Host:
    """Where the system's files lie (tests have a root of their own), and its clock."""

    root: Path = Path("/")
    clock: Clock = field(default_factory=SystemClock)

    def path(self, path: str | Path) -> Path:
        """Return a system path as seen from the root."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str:
        """Return a small file's text; empty if it cannot be read."""
        try:
            return self.path(path).read_text(errors="replace").strip()
        except OSError:
            return ""

    def has(self, path: str | Path) -> bool:
        """Tell whether something is there."""
        return self.path(path).exists()

    def processes(self) -> Iterator[str]:
        """Yield the names of running programs, cut to 15 characters as the kernel does."""
        for entry in self.path("/proc").glob("[0-9]*/comm"):
            try:
                yield entry.read_text().strip()
            except OSError:  # it has just ended
                continue
