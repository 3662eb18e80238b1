"""Which network the robot is on, and what may go over it."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from amberbox.link.robotend import LANES, Lane

_ROUTES = Path("/proc/net/route")
_ASK_S = 2.0


@dataclass(frozen=True, slots=True)
class Network:
    """The network of the default route; ``name`` is that of the wireless one, where it has one."""

    interface: str = ""
    name: str = ""

    def is_called(self, pattern: str) -> bool:
        """Tell whether a name or pattern means this network, by its name or interface."""
        return any(fnmatchcase(n, pattern) for n in (self.name, self.interface) if n)


@dataclass(frozen=True, slots=True)
class Allowed:
    """What may go over a network now."""

    lanes: frozenset[Lane] = frozenset(LANES)
    live: bool = True
    copies: bool = True


def allowed(network: Network, metered: Sequence[str], *, statuses: bool = True) -> Allowed:
    """Say what may go over a network: where bytes cost money, only what cannot wait.

    That is alarms, diagnoses and events, and, if ``statuses``, statuses as they come. The backlog,
    live values and journals wait for another network.
    """
    if not any(network.is_called(pattern) for pattern in metered):
        return Allowed()
    lanes: frozenset[Lane] = frozenset({"urgent", "status"} if statuses else {"urgent"})
    return Allowed(lanes, live=False, copies=False)


def current_network() -> Network:
    """Ask the system for the network of the default route; an empty one where there is none."""
    interface = default_interface(_read(_ROUTES))
    return Network(interface, _wireless_name(interface) if interface else "")


def default_interface(routes: str) -> str:
    """Find the interface of the default route with the least metric in ``/proc/net/route``."""
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
            [tool, interface, "--raw"], capture_output=True, text=True, timeout=_ASK_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return asked.stdout.strip()


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
