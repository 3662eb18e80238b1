"""What a server knows of the demonstration that it is a part of: robots that may be broken.

A server that somebody runs for robots of their own has none, and then nothing of it is there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from amberbox.fleet.accounts.signincodes import SignInCodes


class Demonstration(Protocol):
    """Simulated robots, and what can be broken in them; threads may share it."""

    @property
    def codes(self) -> SignInCodes:
        """Return the codes that sign people in."""

    @property
    def robots(self) -> Sequence[str]:
        """Return the ids of the robots."""

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults that are offered, by their names in the simulator's catalogue."""

    def broken(self) -> Mapping[str, str]:
        """Return which robot has which fault now; those that are well are not in it."""

    def damage(self, robot: str, fault: str) -> None:
        """Let a robot have a fault, instead of what it had; raises UsageError for unknown ones."""

    def repair(self, robot: str) -> None:
        """Let a robot be well again; raises UsageError for an unknown one."""

    def end(self) -> None:
        """Hear that the server is about to end: robots may end as well."""
