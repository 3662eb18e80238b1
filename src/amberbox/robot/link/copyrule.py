"""When journals are copied to the server, and in which order: pure functions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from amberbox.blackbox.folder.server import NETWORK
from amberbox.blackbox.segments.entries import Sealed
from amberbox.robot.link.network import Network


class Pinned(Protocol):
    """A stretch of the record that an incident keeps."""

    def holds_received(self, run: int, from_ns: int, to_ns: int) -> bool:
        """Tell whether it meets rows of a run that were received in ``[from, to]``."""


_NOWHERE = Network()


@dataclass(frozen=True, slots=True)
class Situation:
    """What the rule goes by; ``docked`` is None where nobody knows.

    ``requested`` are journals that somebody has asked for: they go whenever anything may.
    """

    docked: bool | None = None
    network: Network = _NOWHERE
    requested: frozenset[str] = frozenset()


def may_copy(when: str, situation: Situation) -> bool:
    """Tell whether journals nobody has asked for are copied now."""
    if when == "docked":
        return bool(situation.docked)
    if when.startswith(NETWORK):
        return situation.network.is_called(when[len(NETWORK) :].strip())
    return when == "always"


def due(
    journals: Iterable[Sealed],
    confirmed: Collection[str],
    pins: Sequence[Pinned],
    when: str,
    situation: Situation,
) -> list[Sealed]:
    """Return what is to be copied now, first what was asked for, then incidents, then by age."""
    waiting = [journal for journal in journals if journal.journal not in confirmed]
    if not may_copy(when, situation):
        waiting = [journal for journal in waiting if journal.journal in situation.requested]
    return sorted(waiting, key=lambda journal: _rank(journal, pins, situation))


def _rank(
    journal: Sealed, pins: Sequence[Pinned], situation: Situation
) -> tuple[bool, bool, int, int, str]:
    held = any(pin.holds_received(journal.run, journal.start_ns, journal.end_ns) for pin in pins)
    asked = journal.journal in situation.requested
    return not asked, not held, journal.run, journal.start_ns, journal.journal
