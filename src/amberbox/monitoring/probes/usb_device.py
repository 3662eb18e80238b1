"""Whether a USB device is connected, by its vendor and product or its serial number."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from amberbox.core.errors import UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "count": ("int", "", "how many such devices are connected"),
    "port": ("string", "", "where the first one is connected, such as 1-2.4"),
    "speed_mbit": ("float", "Mbit/s", "its speed: 12 on a port or hub that should give 480 is bad"),
    "name": ("string", "", "what it calls itself"),
}
SUBJECT = "VENDOR:PRODUCT, VENDOR:PRODUCT:SERIAL or SERIAL, such as 15d1:0000 (see lsusb)"


def measure(subject: str) -> Measured:
    """Find the device among all that are connected."""
    return read(Path("/sys/bus/usb/devices"), subject)


def read(root: Path, subject: str) -> Measured:
    """Find the devices that are meant below ``/sys/bus/usb/devices``."""
    wanted = _wanted(subject)
    found = [place for place in sorted(root.iterdir()) if all(_matches(place, wanted))]
    if not found:
        return {"ok": False, "count": 0}
    first = found[0]
    speed, name = _text(first / "speed"), _text(first / "product")
    return {
        "ok": True,
        "count": len(found),
        "port": first.name,
        "speed_mbit": float(speed) if speed.replace(".", "").isdecimal() else None,
        "name": name or None,
    }


def _wanted(subject: str) -> dict[str, str]:
    """Return the wanted content of a device's files, by file name."""
    parts = subject.strip().split(":", 2)
    if not parts[0] or (len(parts) > 1 and any(len(part) != 4 for part in parts[:2])):
        raise UsageError(f"'{subject}' is no USB device", "such as 15d1:0000, as lsusb shows it")
    if len(parts) == 1:
        return {"serial": parts[0]}
    return dict(zip(("idVendor", "idProduct", "serial"), parts, strict=False))


def _matches(place: Path, wanted: dict[str, str]) -> Iterator[bool]:
    for file, text in wanted.items():
        found = _text(place / file)
        yield found == text if file == "serial" else found.lower() == text.lower()


def _text(path: Path) -> str:
    """Read a file of a device, which may have been unplugged meanwhile."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
