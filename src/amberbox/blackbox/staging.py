"""Where an import writes until it is whole, and which recordings a store has already.

An import that is broken off leaves nothing in the store but a folder that the next one removes.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from amberbox.blackbox.follow import read
from amberbox.blackbox.follow.read import JournalFile
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.store import FOLDERS, Store, WriterLock
from amberbox.core.errors import AmberboxError
from amberbox.core.files import sync_folder
from amberbox.core.names import identifier

FOLDER = "importing"
_WRITERS = (*(writer for writer in FOLDERS if writer != "main"), "main")
"""The file that says that an import is whole belongs to the last one."""


@dataclass(frozen=True, slots=True)
class StagedStore(Store):
    """A store whose new journals lie aside; its names, locks and runs are those of the store."""

    def folder(self, writer: str) -> Path:
        """Folder of a writer's journal until the import is whole."""
        return self.path / FOLDER / FOLDERS[writer]

    def next_run(self) -> int:
        """Count one more run of the store."""
        return Store(self.path, self.id).next_run()


@contextmanager
def staged(store: Store) -> Iterator[StagedStore]:
    """Give a store to write an import to; its journals become the store's when all went well."""
    remove_leftovers(store)
    stage = StagedStore(store.path, store.id)
    try:
        yield stage
        _publish(store, stage)
    finally:
        shutil.rmtree(store.path / FOLDER, ignore_errors=True)


def remove_leftovers(store: Store) -> None:
    """Remove what a killed import has left; raises UsageError while another one is under way."""
    lock = WriterLock(store, "main")
    try:
        shutil.rmtree(store.path / FOLDER, ignore_errors=True)
    finally:
        lock.release()


def _publish(store: Store, stage: StagedStore) -> None:
    """Move the journals into the store, the one that ends with the word that all is there last."""
    try:
        for writer in _WRITERS:
            files = stage.journal_files(writer)
            if files:
                store.folder(writer).mkdir(exist_ok=True)
            for path in files:
                path.rename(store.folder(writer) / path.name)
            if files:
                sync_folder(store.folder(writer))
    except OSError as error:
        raise AmberboxError(
            f"the store {store.path} does not take what was imported: {error.strerror}",
            "see that its folders can be written, then import again",
        ) from error


def imported_digests(store: Store) -> set[str]:
    """Return the digests of all recordings that were imported whole, by the store's own events.

    Raw journals may be gone by now; events are never deleted.
    """
    from amberbox.blackbox.query.catalogue import look
    from amberbox.blackbox.query.record import Record
    from amberbox.blackbox.segments.build import can_build

    item = identifier(reserved.EVENT)
    if item not in look(store.path, with_segments=can_build()).schemas:
        return set()
    table = Record(store.path).query(item, ["kind", "details"])
    rows = zip(table.values("kind"), table.values("details"), strict=True)
    found = [msgspec.json.decode(details) for kind, details in rows if kind == "imported"]
    return {str(details["sha256"]) for details in found if "sha256" in details}


def broken_imports(store: Store, whole: set[str]) -> dict[str, list[JournalFile]]:
    """Return the files of imports that were broken off, by the digests of their recordings."""
    broken: dict[str, list[JournalFile]] = {}
    for journal in read.journals(store.path):
        if journal.places:
            digest = str(read.run_messages(journal).get("input") or "")
            if digest and digest not in whole:
                broken.setdefault(digest, []).append(journal)
    return broken


def discard(store: Store, files: Sequence[JournalFile]) -> str:
    """Remove what an import that was broken off has left; return what stays of it."""
    lock = WriterLock(store, "main")  # it may just be under way
    in_segments = manifest.read(store.path).journals.keys()
    for journal in files:
        if journal.name not in in_segments:
            journal.path.unlink(missing_ok=True)
    lock.release()
    stays = sum(journal.rows for journal in files if journal.name in in_segments)
    return f"an earlier import was broken off, {stays} of its messages are twice" if stays else ""
