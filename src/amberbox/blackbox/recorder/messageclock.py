"""Time as messages tell it: inside a recording that is imported, or in a simulation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class MessageClock:
    """Stands at the newest message heard; never steps, and nobody disciplines it."""

    at_ns: int = 0

    def heard(self, received_ns: int) -> None:
        """Move on to a message that was heard."""
        self.at_ns = max(self.at_ns, received_ns)

    def now_ns(self) -> int:
        return self.at_ns

    def boot_ns(self, log_ns: int) -> None:
        """Return None: this time is not counted from the start of a computer."""

    def offset_ns(self) -> int:
        return 0

    def new_epoch(self) -> None:
        """Do nothing: this time does not step."""

    def synchronised(self) -> bool | None:
        return None
