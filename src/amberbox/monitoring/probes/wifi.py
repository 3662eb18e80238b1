"""How well a wireless interface is connected, and to which network."""

from __future__ import annotations

import ctypes
import fcntl
import socket
import struct
from contextlib import suppress
from pathlib import Path

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "quality_percent": ("float", "%", "quality of the link, as the driver rates it"),
    "signal_dbm": ("float", "dBm", "strength of the signal: -50 is good, -80 is bad"),
    "ssid": ("string", "", "name of the network"),
}
SUBJECT = "name of the interface, such as wlan0"
PERIOD_S = 2.0

_BEST = 70.0  # the best quality reported by present drivers
_GET_NETWORK = 0x8B1B  # SIOCGIWESSID
_NAME_LENGTH = 32


def measure(subject: str) -> Measured:
    """Measure the interface; it is ok when it is connected."""
    found = read(Path("/proc/net/wireless"), Path("/sys/class/net"), subject)
    return found | {"ssid": network(subject)} if found["ok"] else found


def read(wireless: Path, interfaces: Path, name: str) -> dict[str, object]:
    """Read an interface's line of ``/proc/net/wireless``; raise AmberboxError without one."""
    if not name or "/" in name or name.startswith("."):
        raise UsageError(f"'{name}' is no network interface", "such as wlan0")
    place = interfaces / name
    if not place.is_dir():
        return {"ok": False, "error": f"there is no interface {name}"}
    if not (place / "wireless").is_dir() and not (place / "phy80211").exists():
        raise AmberboxError(f"{name} is no wireless interface")
    line = _line(wireless, name)
    if line is None:
        return {"ok": False, "error": f"{name} is not connected"}
    return judge(line, is_up=(place / "operstate").read_text().strip() == "up")


def judge(fields: list[str], *, is_up: bool) -> dict[str, object]:
    """Read the fields of a line: status, quality, level, noise."""
    quality, level = float(fields[1].rstrip(".")), float(fields[2].rstrip("."))
    dbm = level - 256 if level > 0 else level  # older drivers write the byte without its sign
    return {
        "ok": is_up and quality > 0,
        "quality_percent": min(100.0, 100 * quality / _BEST),
        "signal_dbm": dbm if dbm < 0 else None,
    }


def network(name: str) -> str | None:
    """Return the network's name from the driver; None where it is not known."""
    text = ctypes.create_string_buffer(_NAME_LENGTH + 1)
    request = struct.pack("16sPHH", name.encode()[:15], ctypes.addressof(text), _NAME_LENGTH, 0)
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, _GET_NETWORK, request)
        return text.value.decode(errors="replace") or None
    return None


def _line(wireless: Path, name: str) -> list[str] | None:
    for line in wireless.read_text().splitlines()[2:]:
        interface, _, rest = line.partition(":")
        if interface.strip() == name:
            return rest.split()
    return None
