"""WHERE for models: a file, a robot folder, its record, or an archive of a server."""

from __future__ import annotations

import argparse
from pathlib import Path

from amberbox.blackbox.store.store import is_store
from amberbox.cli._arguments import accept_any_order, add_where
from amberbox.core.errors import UsageError
from amberbox.diagnosis.models import FOLDER, ModelKind, find_model
from amberbox.server.archive.location import archive_in


def add_model(parser: argparse.ArgumentParser, files: str) -> None:
    """Add WHERE, which may also be a file, and the name of a model."""
    accept_any_order(parser)
    what = "a file with a model, a robot folder with models, its record, a server's archive"
    add_where(parser, what, f"WHERE|{files}")
    parser.add_argument(
        "name", nargs="?", default="", metavar="NAME", help="which model, where there are several"
    )


def model_path(where: str, kind: ModelKind, name: str) -> Path:
    """Return the file of a model; raises UsageError where it is not clear which one."""
    path = Path(where)
    if not path.is_dir():
        if name:
            raise UsageError(f"{where} is one model's file", f"leave out {name}")
        return path
    return find_model(_folder(path), kind, name).path


def _folder(path: Path) -> Path:
    """Return the robot folder at a path, or that a record or an archive belongs to."""
    archive = archive_in(path)
    if archive is not None:
        return _archived(*archive)
    owner = path.absolute().parent
    return owner if is_store(path) and (owner / FOLDER).is_dir() else path


def _archived(data: Path, robots: tuple[str, ...]) -> Path:
    try:
        from amberbox.server.ingest.folders import archived_folder
    except ImportError:
        what = f"{data} is a server's archive: reading it needs what servers have installed"
        raise UsageError(what, "pip install 'amberbox[server]'") from None
    return archived_folder(data, robots)
