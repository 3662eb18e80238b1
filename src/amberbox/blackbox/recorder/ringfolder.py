"""Where the ring lies: in the store, or elsewhere (in memory, say) with a link to it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from pathlib import Path

from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.store import Store
from amberbox.core.errors import AmberboxError
from amberbox.core.files import sync_folder

_MOVING = "ring.moving"


def place_ring(store: Store, elsewhere: Path | None) -> None:
    """Let ``STORE/ring`` be a folder, or a link to the store's own folder below ``elsewhere``.

    Files of the ring that lie elsewhere are moved; a folder that is gone after a restart of the
    computer is made again. Only who holds the ring's lock may call this. Raises AmberboxError when
    the folder cannot be written.
    """
    try:
        if elsewhere is None:
            _bring_home(store)
        else:
            _link(store, elsewhere.absolute() / store.id / "ring")
    except OSError as error:
        raise AmberboxError(
            f"cannot keep the ring in {elsewhere or store.path}: {error.strerror}",
            "choose a folder that can be written in robot.yaml store.ring_path",
        ) from error


def _link(store: Store, target: Path) -> None:
    ring = store.folder("ring")
    target.mkdir(parents=True, exist_ok=True)
    if not os.access(target, os.W_OK):
        raise PermissionError(13, os.strerror(13))
    if ring.is_symlink() and ring.readlink() == target:
        return
    _move_files(ring, target)
    if ring.is_symlink():
        ring.unlink()
    elif ring.exists():
        shutil.rmtree(ring)  # what is left is the head, a hint that is written anew
    ring.symlink_to(target)
    sync_folder(store.path)


def _bring_home(store: Store) -> None:
    ring, moving = store.folder("ring"), store.path / _MOVING
    if ring.is_symlink():
        moving.mkdir(exist_ok=True)
        _move_files(ring, moving)
        ring.unlink()
    if moving.exists() and not ring.exists():
        moving.rename(ring)
        sync_folder(store.path)


def _move_files(ring: Path, target: Path) -> None:
    for path in sorted(ring.glob("*.mcap")):
        shutil.move(path, target / path.name)


def writers_elsewhere(store: Store) -> Collection[str]:
    """Name the journals that do not lie on the store's disk."""
    device = store.path.stat().st_dev
    folders = {writer: store.folder(writer) for writer in RECORDED}
    return {w for w, folder in folders.items() if _device(folder, device) != device}


def _device(folder: Path, default: int) -> int:
    try:
        return folder.stat().st_dev
    except OSError:  # not there yet: it will be made in the store
        return default
