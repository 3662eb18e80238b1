"""A clock that tests move by hand."""

from __future__ import annotations

from dataclasses import dataclass

from amberbox.core.clock import NS


@dataclass
class ManualClock:
    """Stands still until ``advance`` or ``step`` is called."""

    wall: int = 1_700_000_000 * NS
    boot: int = 100 * NS
    boot_name: str = "00000000-0000-4000-8000-000000000000"
    is_synchronised: bool | None = True

    def wall_ns(self) -> int:
        return self.wall

    def boot_ns(self) -> int:
        return self.boot

    def boot_id(self) -> str:
        return self.boot_name

    def synchronised(self) -> bool | None:
        return self.is_synchronised

    def advance(self, seconds: float) -> None:
        """Let time pass on both clocks."""
        self.wall += round(seconds * NS)
        self.boot += round(seconds * NS)

    def step(self, seconds: float) -> None:
        """Set the wall clock forward (or back) as NTP or a person would."""
        self.wall += round(seconds * NS)
