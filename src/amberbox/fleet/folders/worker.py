"""What is done with a folder that came in, in a worker: nothing of it is read anywhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from amberbox.fleet.folders.masking import masked
from amberbox.fleet.folders.shelf import Shelf
from amberbox.link.folders import unpack


class Kept(msgspec.Struct, frozen=True):
    """What became of a folder: how much it is, which files had something to mask."""

    files: int
    bytes: int
    masked: list[str]


def keep(folder: Path, arguments: dict[str, Any]) -> bytes:
    """Unpack a folder, mask what looks like a secret, put it up; raises FolderError."""
    files, hidden = masked(unpack(arguments["data"]))
    Shelf(folder).keep(arguments["robot"], arguments["config_hash"], files)
    size = sum(map(len, files.values()))
    return msgspec.msgpack.encode(Kept(len(files), size, hidden))
