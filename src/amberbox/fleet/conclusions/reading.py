"""What a robot concluded in a range of time, from the archive and the link, each record once."""

from __future__ import annotations

from typing import Protocol

from amberbox.core.errors import AmberboxError
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.conclusions.columns import Span, from_columns
from amberbox.fleet.conclusions.early import from_aside, from_link, offsets
from amberbox.fleet.conclusions.entry import Entry
from amberbox.fleet.database.database import Database

MOST = 100_000
"""Records in one answer."""
_ATTEMPTS = 5


class Stores(Protocol):
    """Where records lie; the services of a server are one."""

    @property
    def database(self) -> Database:
        """The server's database."""

    @property
    def archive(self) -> FolderArchive:
        """The archive."""


def entries(
    services: Stores,
    robot: str,
    channel: str,
    span: Span = (None, None),
    limit: int = 1000,
    *,
    newest: bool = False,
    aside: bool = False,
) -> list[Entry]:
    """Return what a robot wrote on a channel within ``[from, to)``, each record once.

    ``channel`` is one of ``blackbox.journal.reserved`` (``reserved.EVENT``); ``values`` is the
    record, as the functions of ``monitoring.messages`` read it. In order of time, at most
    ``limit``: the first ones, or with ``newest`` the last. With ``aside`` also what was put aside.
    """
    limit = min(limit, MOST)
    # first the link: what is committed in between is then found in the archive as well, not lost
    with services.database.reading() as connection:
        early = from_link(connection, robot, channel, span, limit, newest=newest)
        lost = from_aside(connection, robot, channel, span) if aside else []
        ahead = offsets(connection, robot)
    late = _from_archive(services.archive, robot, channel, span, limit, newest=newest)
    known = {entry.place for entry in late}
    found = [*late, *(entry for entry in early if entry.place not in known), *lost]
    found.sort(key=lambda entry: entry.order)
    chosen = found[-limit:] if newest else found[:limit]
    return [e.ahead(ahead.get((e.store_id, e.writer, e.run))) for e in chosen]


def _from_archive(
    archive: FolderArchive, robot: str, channel: str, span: Span, limit: int, *, newest: bool
) -> list[Entry]:
    """Read from one look at the tables; look again when files were joined meanwhile."""
    sources = archive.catalogue.sources([robot])
    for _ in range(_ATTEMPTS):
        reader = Reader(archive.layout, archive.catalogue, sources)
        try:
            return [
                entry
                for source in sources
                for entry in from_columns(reader, source, channel, span, limit, newest=newest)
            ]
        except FileNotFoundError:
            continue
    raise AmberboxError(f"the archive of {robot} changed while it was being read", "ask again")
