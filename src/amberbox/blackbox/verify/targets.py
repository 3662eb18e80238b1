"""Which journal files are to be checked, and what is known of each before it is opened."""

from __future__ import annotations

from pathlib import Path

from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.store import FOLDERS, Store, run_and_number
from amberbox.blackbox.verify.block import Identity
from amberbox.blackbox.verify.journal import Target

_FOLDER_OF = {folder: writer for writer, folder in FOLDERS.items()}
FIRST_CHAIN = "0" * 64


def target_of(
    store: Store,
    path: Path,
    *,
    sealed: Sealed | None = None,
    before: str = "",
    live: bool = False,
    store_id: str = "",
) -> Target:
    """Describe a journal file; ``before`` is the last link of the file in front of it."""
    run, number = run_and_number(path)
    stated = (sealed.start_chain,) if sealed is not None else ()
    chains = tuple(chain for chain in (*stated, before, FIRST_CHAIN) if chain)
    writer = _FOLDER_OF[path.parent.name]
    identity = Identity(store_id or store.id, writer, run, number, chains)
    return Target(f"{path.parent.name}/{path.name}", path, identity, live, sealed)
