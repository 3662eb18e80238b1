"""Upload policy: what may go over which network, whether docked, and in which order."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Protocol

from amberbox.blackbox.robot_folder.robot_yaml import NETWORK
from amberbox.blackbox.store.manifest_entries import SealedJournal
from amberbox.link.robot_end import LANES, Lane

_ROUTES = Path("/proc/net/route")
_COMMAND_S = 2.0


@dataclass(frozen=True, slots=True)
class Network:
    """The network of the default route; ``name`` is that of a wireless one, else empty."""

    interface: str = ""
    name: str = ""

    def is_called(self, pattern: str) -> bool:
        """Return whether a name or pattern matches this network, by its name or interface."""
        return any(fnmatchcase(n, pattern) for n in (self.name, self.interface) if n)


@dataclass(frozen=True, slots=True)
class AllowedTraffic:
    """What may be sent over a network now."""

    lanes: frozenset[Lane] = frozenset(LANES)
    live: bool = True
    copies: bool = True


def allowed_traffic(
    network: Network, metered: Sequence[str], *, statuses: bool = True
) -> AllowedTraffic:
    """Return what may be sent over a network; over a metered one only what cannot wait.

    That is alarms, diagnoses, events and commands, and, if ``statuses``, new statuses. The backlog,
    live values and journals wait for another network.
    """
    if not any(network.is_called(pattern) for pattern in metered):
        return AllowedTraffic()
    lanes = frozenset(LANES) - ({"backlog"} if statuses else {"backlog", "status"})
    return AllowedTraffic(lanes, live=False, copies=False)


def current_network() -> Network:
    """Return the network of the default route; an empty one where there is none."""
    interface = default_interface(_read(_ROUTES))
    return Network(interface, _wireless_name(interface) if interface else "")


def default_interface(routes: str) -> str:
    """Return the interface of the default route with the least metric in ``/proc/net/route``."""
    found = []
    for line in routes.splitlines()[1:]:
        fields = line.split()
        if len(fields) > 7 and fields[1] == "00000000" and fields[7] == "00000000":
            found.append((int(fields[6]), fields[0]))
    return min(found)[1] if found else ""


def _wireless_name(interface: str) -> str:
    tool = shutil.which("iwgetid")
    if tool is None or not Path(f"/sys/class/net/{interface}/wireless").exists():
        return ""
    try:
        asked = subprocess.run(
            [tool, interface, "--raw"],
            capture_output=True,
            text=True,
            timeout=_COMMAND_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return asked.stdout.strip()


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


class PinnedWindow(Protocol):
    """A window of the record that an incident keeps."""

    def holds_received(self, run: int, from_ns: int, to_ns: int) -> bool:
        """Return whether it overlaps rows of a run that were received in ``[from, to]``."""


_NOWHERE = Network()


@dataclass(frozen=True, slots=True)
class CopySituation:
    """Inputs of the copy rule; ``docked`` is None where it is unknown.

    ``requested`` are journals of fetch requests, which are copied whenever copying is allowed.
    ``left_out`` are folders of journals that the server does not know.
    """

    docked: bool | None = None
    network: Network = _NOWHERE
    requested: frozenset[str] = frozenset()
    left_out: frozenset[str] = frozenset()


def may_copy(when: str, situation: CopySituation) -> bool:
    """Return whether journals that were not requested are copied now."""
    if when == "docked":
        return bool(situation.docked)
    if when.startswith(NETWORK):
        return situation.network.is_called(when[len(NETWORK) :].strip())
    return when == "always"


def journals_to_copy(
    journals: Iterable[SealedJournal],
    confirmed: Collection[str],
    pins: Sequence[PinnedWindow],
    when: str,
    situation: CopySituation,
) -> list[SealedJournal]:
    """Return the journals to copy now: requested ones, then incidents, then by age."""
    waiting = [journal for journal in journals if journal.journal not in confirmed]
    if not may_copy(when, situation):
        waiting = [journal for journal in waiting if journal.journal in situation.requested]
    return sorted(waiting, key=lambda journal: _rank(journal, pins, situation))


def _rank(
    journal: SealedJournal, pins: Sequence[PinnedWindow], situation: CopySituation
) -> tuple[bool, bool, int, int, str]:
    held = any(pin.holds_received(journal.run, journal.start_ns, journal.end_ns) for pin in pins)
    asked = journal.journal in situation.requested
    return not asked, not held, journal.run, journal.start_ns, journal.journal
