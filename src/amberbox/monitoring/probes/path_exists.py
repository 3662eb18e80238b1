"""Whether a file, folder or device is there, such as the device of a laser scanner."""

from __future__ import annotations

from pathlib import Path

from amberbox.core.errors import UsageError
from amberbox.core.probe import Measured

MEASURES = dict[str, tuple[str, str, str]]()
SUBJECT = "an absolute path, such as /dev/front_laser; links are followed"


def measure(subject: str) -> Measured:
    """Check whether the path exists; without permission it is unknown (OSError)."""
    if not subject.startswith("/"):
        raise UsageError(f"'{subject}' is no absolute path", "begin it with /")
    try:
        Path(subject).stat()
    except (FileNotFoundError, NotADirectoryError):
        return {"ok": False}
    return {"ok": True}
