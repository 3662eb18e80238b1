"""What an export did: rows or messages per item, what was changed, what is not in it and why."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class ExportReport:
    """What an export did.

    ``counts`` are rows per table or messages per item. ``notes`` say what a reader should know,
    ``missing`` what was asked for and could not be exported.
    """

    target: Path | None
    form: str
    counts: dict[str, int] = field(default_factory=dict)
    bytes: int = 0
    notes: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """Rows or messages altogether."""
        return sum(self.counts.values())

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    def miss(self, text: str) -> None:
        """Name something that is not in the export, once."""
        if text not in self.missing:
            self.missing.append(text)

    def add(self, name: str, count: int) -> None:
        """Count rows or messages."""
        self.counts[name] = self.counts.get(name, 0) + count

    def lines(self) -> list[str]:
        """Write the report for a person."""
        counts = [f"  {name}: {count}" for name, count in sorted(self.counts.items())]
        missing = [f"  missing: {text}" for text in self.missing]
        return [*counts, *missing, *(f"  note: {text}" for text in self.notes)]

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON has it."""
        return {
            "target": str(self.target) if self.target else None,
            "format": self.form,
            "total": self.total,
            "counts": self.counts,
            "bytes": self.bytes,
            "notes": self.notes,
            "missing": self.missing,
        }
