"""WHERE on the command line and in the API: a robot folder or a store becomes a store's path."""

from __future__ import annotations

from pathlib import Path

from amberbox.blackbox.folder.folder import store_of
from amberbox.blackbox.store import is_store
from amberbox.core.errors import UsageError


def store_path(where: str | Path) -> Path:
    """Find the store that ``where`` (a store or a robot folder) means.

    Raises UsageError when there is none.
    """
    path = Path(where)
    if path.parts[:1] in (("https:",), ("http:",)):
        raise UsageError(
            "this takes what is on this computer, not a server",
            "amberbox export URL --format journals downloads what a robot has signed",
        )
    if is_store(path):
        return path
    store = store_of(path)
    if store is not None:
        if is_store(store):
            return store
        raise UsageError(
            f"{path} has no record yet (no store at {store})",
            f"record something first: amberbox record {path}",
        )
    if not path.exists():
        raise UsageError(f"there is nothing at {path}", "name a robot folder or a store")
    raise UsageError(
        f"{path} is neither a store nor a robot folder",
        "a store holds store.json, a robot folder holds robot.yaml and black_box.yaml",
    )
