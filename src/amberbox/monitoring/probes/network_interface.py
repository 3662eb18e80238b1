"""Whether a network interface is up and its cable is in, with its speed and errors."""

from __future__ import annotations

from pathlib import Path

from amberbox.core.errors import UsageError
from amberbox.core.host import link_state, number_in
from amberbox.core.probe import Measured

MEASURES = {
    "state": ("string", "", "up, down, dormant ... as the kernel says it; absent: there is none"),
    "carrier": ("bool", "", "whether something is connected at the other end"),
    "speed_mbit": ("int", "Mbit/s", "speed of the link; null where the driver does not say"),
    "rx_errors": ("int", "", "broken frames received since it is up"),
    "tx_errors": ("int", "", "frames that could not be sent since it is up"),
}
SUBJECT = "name of the interface, such as eth0 or can0"

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
    link = link_state(place)
    return {
        "ok": link.carrier and link.state in _WORKS,
        "state": link.state,
        "carrier": link.carrier,
        "speed_mbit": link.speed_mbit,
        **{name: number_in(place / "statistics" / name) for name in ("rx_errors", "tx_errors")},
    }
