"""The hash chain from run to run: where a writer's next file takes up the thread."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.journal.writer import EMPTY_CHAIN
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.store import Store, run_and_number

Place = tuple[int, int]
"""Run of a file and its number within the run: the order in which files were written."""


def previous_chain(store: Store, writer: str) -> str:
    """Return the last link of a writer's newest file that can still be read, else zeros.

    Of a file that was deleted since, its tombstone knows the link.
    """
    place, chain = max(_buried(store, writer), default=((-1, -1), EMPTY_CHAIN))
    for path in reversed(store.journal_files(writer)):
        if run_and_number(path) <= place:
            break
        link = _last_link(path)
        if link:
            return link
    return chain


def _last_link(path: Path) -> str:
    """Return a file's last link, or where it began if it ended before the first; or nothing."""
    try:
        return journal_file(path).chain or start_record(path).get("chain", "")
    except OSError:  # deleted or unreadable: the file before it is the best there is
        return ""


def _buried(store: Store, writer: str) -> Iterator[tuple[Place, str]]:
    for stone in manifest.read(store.path).tombstones:
        if stone.writer == writer and stone.what != "columns" and stone.chain:
            yield (
                max(run_and_number(Path(PurePosixPath(name).name)) for name in stone.journals),
                (stone.chain),
            )
