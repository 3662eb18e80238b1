"""Whether a network interface is up and its cable is in, with its speed and errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amberbox.core.errors import UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "state": ("string", "", "up, down, dormant ... as the kernel says it; absent: there is none"),
    "carrier": ("bool", "", "whether something is connected at the other end"),
    "speed_mbit": ("int", "Mbit/s", "speed of the link; null where the driver does not say"),
    "rx_errors": ("int", "", "broken frames received since it is up"),
    "tx_errors": ("int", "", "frames that could not be sent since it is up"),
}
SUBJECT = "name of the interface, such as eth0 or can0"

_UP = 0x1  # IFF_UP
_WORKS = ("up", "unknown")  # drivers without an operating state (CAN, loopback) say unknown


def measure(subject: str) -> Measured:
    """Measure the interface; it is ok when it is switched on and has a carrier."""
    return read(Path("/sys/class/net"), subject)


def read(root: Path, name: str) -> Measured:
    """Read the state of an interface from ``/sys/class/net``."""
    if not name or "/" in name or name.startswith("."):
        raise UsageError(f"'{name}' is no network interface", "such as eth0")
    if name not in [place.name for place in root.iterdir()]:
        return {"ok": False, "state": "absent"}
    place = root / name
    is_up = bool(int((place / "flags").read_text(), 16) & _UP)
    carrier = is_up and _number(place / "carrier") == 1
    state = (place / "operstate").read_text().strip()
    speed = _number(place / "speed")
    found: dict[str, Any] = {"ok": carrier and state in _WORKS, "state": state, "carrier": carrier}
    found["speed_mbit"] = speed if speed is not None and speed > 0 else None
    for error in ("rx_errors", "tx_errors"):
        found[error] = _number(place / "statistics" / error)
    return found


def _number(path: Path) -> int | None:
    """Read a number that drivers may refuse (an interface that is down has no speed)."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
