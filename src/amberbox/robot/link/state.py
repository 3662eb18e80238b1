"""How the link is doing, in a small file for ``doctor``, ``status`` and other programs."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from dataclasses import asdict, dataclass
from urllib.parse import urlsplit

from amberbox.blackbox.doctor.linked import STATE_FILE
from amberbox.blackbox.store import Store


@dataclass(frozen=True, slots=True)
class LinkState:
    """Whether there is a connection, why not, what waits; ``at_ns`` by the robot's clock."""

    server: str
    connected: bool
    trouble: str
    backlog: int
    copied: int
    at_ns: int

    def short(self) -> str:
        """Say in a line whether there is a link."""
        host = urlsplit(self.server).netloc
        if self.connected:
            return f"linked to {host}{f'; {self.trouble}' if self.trouble else ''}"
        return f"no link to {host}{f': {self.trouble}' if self.trouble else ''}"

    def in_words(self) -> str:
        """Say in a line how it is, with what waits."""
        waiting = (
            f"; the newest {self.backlog} records are not acknowledged yet" if self.backlog else ""
        )
        copied = f"; {self.copied} journals copied" if self.copied else ""
        return f"{self.short()}{waiting}{copied}"


def write_state(store: Store, state: LinkState) -> None:
    """Put the state where others find it; it is about now, so it need not survive anything."""
    part = store.path / f"{STATE_FILE}.part"
    with suppress(OSError):  # a full disk: what it says is shown by age
        part.write_text(json.dumps({**asdict(state), "pid": os.getpid()}))
        part.replace(store.path / STATE_FILE)
