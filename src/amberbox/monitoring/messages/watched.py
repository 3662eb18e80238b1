"""Which files of a robot folder the watcher goes by, and which have changed since it began."""

from __future__ import annotations

import json
from contextlib import suppress

from amberbox.blackbox.folder.folder import RobotFolder, configuration_files, hash_files
from amberbox.blackbox.store import Store, is_locked
from amberbox.monitoring.messages.pulse import WATCH

FILE = "watch-folder.json"


def write_watched(store: Store, folder: RobotFolder) -> None:
    """Write down the files as the watcher that begins now has read them, for ``changed_files``."""
    part = store.path / f"{FILE}.part"
    with suppress(OSError):  # a full disk: what changed is then not known by name
        part.write_text(json.dumps({"config_hash": folder.config_hash, "files": _files(folder)}))
        part.replace(store.path / FILE)


def changed_files(store: Store, folder: RobotFolder) -> list[str]:
    """Return what differs in a folder from what the present watcher has read, by name.

    Empty where nothing does, or nobody watches.
    """
    if not is_locked(store, WATCH):
        return []
    try:
        values = json.loads((store.path / FILE).read_text())
        before, config_hash = dict(values["files"]), values["config_hash"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    if config_hash == folder.config_hash:
        return []
    now = _files(folder)
    return [
        f"{name} ({_what(before.get(name), now.get(name))})"
        for name in sorted({*before, *now})
        if before.get(name) != now.get(name)
    ]


def _files(folder: RobotFolder) -> dict[str, str]:
    files = configuration_files(folder)
    return {name: hash_files({name: path}) for name, path in files.items()}


def _what(before: str | None, now: str | None) -> str:
    return "new" if before is None else "gone" if now is None else "changed"
