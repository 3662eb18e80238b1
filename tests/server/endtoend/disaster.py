"""Disasters of a store: a power cut, a new card, an old image that is restored."""

from __future__ import annotations

import shutil
from pathlib import Path

from amberbox.blackbox.journal.tail import HEAD_NAME as HEAD
from amberbox.blackbox.journal.tail import JournalHead, read_head
from amberbox.blackbox.store.journal_reader import journal_file
from amberbox.blackbox.store.store import Store, open_store, run_and_number


def cut_power(path: Path) -> int:
    """Remove from each newest journal the data that were not durable; return the bytes."""
    store = open_store(path)
    return sum(_cut(store, writer) for writer in store.writers())


def _cut(store: Store, writer: str) -> int:
    files, head = store.journal_files(writer), read_head(store.folder(writer))
    if head is None or not files or files[-1].name != head.file:
        return 0
    (store.folder(writer) / HEAD).unlink()
    size = files[-1].stat().st_size
    at = _durable_bytes(files[-1], head)
    with files[-1].open("r+b") as file:
        file.truncate(at)
    return size - at


def _durable_bytes(path: Path, head: JournalHead) -> int:
    """Return where the first chunk begins that was written after the last sync."""
    journal = journal_file(path)
    seq = journal.first_seq
    for place in journal.places:
        if seq >= head.durable_seq and run_and_number(path)[0] == head.run:
            return place.offset
        seq += place.count
    return path.stat().st_size


def new_card(path: Path) -> Path:
    """Remove the card; return its new path, for comparison."""
    number = len(list(path.parent.glob(f"{path.name}-old*")))
    return path.rename(path.with_name(f"{path.name}-old{number}"))


def image(path: Path) -> Path:
    """Make an image of the card."""
    return shutil.copytree(path, path.with_name(f"{path.name}-image"))


def restore(path: Path) -> Path:
    """Restore the image; return the path of the replaced store, for comparison."""
    old = new_card(path)
    path.with_name(f"{path.name}-image").rename(path)
    return old
