"""What the link remembers over a restart: a small file in the store, replaced as a whole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.store import Store
from amberbox.core.files import replace_file
from amberbox.link.positions import Place

NAME = "link.json"


@dataclass(frozen=True, slots=True)
class Remembered:
    """How far the server had acknowledged; ``server`` is its address, times by the robot's clock.

    It is for people and for the account of the backlog. Where rows go on is what the server says.
    """

    server: str
    cursor: Mapping[str, Place] = field(default_factory=dict)
    epoch: int = 0
    at_ns: int = 0


def remember(store: Store, what: Remembered) -> None:
    """Write it down so that a power cut leaves the old or the new.

    Raises OSError when the disk does not take it.
    """
    cursor = {writer: [at.run, at.seq] for writer, at in what.cursor.items()}
    values = {"server": what.server, "store_id": store.id, "cursor": cursor,
              "epoch": what.epoch, "at_ns": what.at_ns}  # fmt: skip
    replace_file(store.path / NAME, json.dumps(values) + "\n")


def recall(store: Store) -> Remembered | None:
    """Read what was written; None where there is nothing, or it is of another store."""
    return _read(store.path / NAME, store.id)


def _read(path: Path, store_id: str) -> Remembered | None:
    try:
        values = json.loads(path.read_text())
        if values["store_id"] != store_id:
            return None
        cursor = {w: Place(int(run), int(seq)) for w, (run, seq) in values["cursor"].items()}
        return Remembered(values["server"], cursor, int(values["epoch"]), int(values["at_ns"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
