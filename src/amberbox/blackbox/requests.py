"""Requests to the keeper: small files by which other processes ask it to write something down.

Only one process writes a store's manifest and the keeper's journal. Whoever else has something to
say (the command line, the API, the robot's agent) leaves a request; where no keeper runs, the
asking process is the keeper for a moment.
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.blackbox.store import Store
from amberbox.core.files import replace_file

FOLDER = "requests"


@dataclass(frozen=True, slots=True)
class Request:
    """One request: its kind, when it was made (wall clock and boot clock), and what it says."""

    path: Path
    kind: str
    wall_ns: int
    boot_ns: int
    values: Mapping[str, Any]


def submit(store: Store, kind: str, values: Mapping[str, Any]) -> Path:
    """Leave a request so that it survives a power cut; it is gone once it has been seen to."""
    folder = store.path / FOLDER
    folder.mkdir(exist_ok=True)
    wall_ns, boot_ns = time.time_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    path = folder / f"{boot_ns:020d}-{os.getpid()}-{uuid.uuid4().hex[:8]}.json"
    document = {"kind": kind, "wall_ns": wall_ns, "boot_ns": boot_ns, "values": dict(values)}
    replace_file(path, json.dumps(document))
    return path


def pending(store: Store) -> list[Request]:
    """Return the requests that nobody has seen to yet, oldest first.

    A file that is no request is moved aside to ``<name>.refused``; only the keeper calls this.
    """
    found = []
    for path in sorted((store.path / FOLDER).glob("*.json")):
        try:
            document = json.loads(path.read_text())
            times = int(document["wall_ns"]), int(document["boot_ns"])
            found.append(Request(path, str(document["kind"]), *times, dict(document["values"])))
        except FileNotFoundError:
            continue
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
            text = f"{FOLDER}/{path.name} cannot be read: what it asked for was not done"
            with suppress(OSError):  # a full disk: it is refused with the next step
                about = {"kind": "request_refused", "text": text, "source": "keeper"}
                submit(store, "event", about)
                path.rename(path.with_suffix(".refused"))
    return found


def finish(request: Request) -> None:
    """Remove a request that has been seen to."""
    request.path.unlink(missing_ok=True)
