"""WHERE for archives: a server's data folder, or one robot's folder of journals in it."""

from __future__ import annotations

from pathlib import Path

DATABASE = "server.db"
JOURNALS = "journals"
TABLES = "tables"


def is_archive(folder: Path) -> bool:
    """Return whether a folder is a server's data folder with an archive in it."""
    return (folder / DATABASE).is_file() and (folder / TABLES).is_dir()


def archive_in(where: str | Path) -> tuple[Path, tuple[str, ...]] | None:
    """Return the data folder and the robots that ``where`` names; None if it is no archive."""
    path = Path(where)
    if is_archive(path):
        return path, ()
    if path.parent.name == JOURNALS and is_archive(path.parent.parent):
        return path.parent.parent, (path.name,)
    return None
