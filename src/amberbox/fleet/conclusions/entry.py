"""A record of what a robot concluded, wherever it lies now."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

Place: TypeAlias = tuple[str, str, int, int]
"""Store, writer, run, number: what a record is known by."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One record; ``at_ns`` is when the robot wrote it, by its clock as it is known now.

    ``server_ns`` is the same by the server's clock, None where it was never compared. ``aside``
    says why a record is none of the robot's record any more (``lost_at_power_cut``).
    """

    channel: str
    at_ns: int
    log_ns: int
    store_id: str
    writer: str
    run: int
    seq: int
    values: Mapping[str, Any]
    aside: str = ""
    server_ns: int | None = None

    @property
    def place(self) -> Place:
        """Return what it is known by."""
        return self.store_id, self.writer, self.run, self.seq

    @property
    def order(self) -> tuple[int, str, int, int]:
        """Return by what records are ordered: time, then place."""
        return self.at_ns, self.writer, self.run, self.seq

    def ahead(self, offset_ns: int | None) -> Entry:
        """Return it with the server's time, where the offset of its boot is known."""
        return self if offset_ns is None else replace(self, server_ns=self.at_ns + offset_ns)
