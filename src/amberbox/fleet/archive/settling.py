"""What follows from a commit: the link's early rows go, and what will not come is written down."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection, Row, and_, exists, func, select, update

from amberbox.blackbox.segments.entries import Tombstone, from_record
from amberbox.blackbox.segments.lines import decode
from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.archive.catalogue import COMMITTED
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.store import DELETED, LOST, JournalKey, Missing
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.committed import drop_committed
from amberbox.fleet.linkend.tables import ASIDE
from amberbox.fleet.options import options
from amberbox.fleet.uploads.tables import UPLOAD
from amberbox.link import history
from amberbox.link.uploads import Proof

_SETTLED = "archive.settled"
_AT_ONCE = 20
"""Journals whose rows are dropped in one transaction: others want to write, too."""


@dataclass(frozen=True, slots=True)
class Settled:
    """Up to which batch the link's early rows are dropped."""

    batch: int = 0


def settle(database: Database, clock: Clock) -> list[str]:
    """Drop early rows that the archive holds since; return the robots that this is about.

    Done again after a crash it changes nothing.
    """
    robots: set[str] = set()
    while rows := _next(database):
        robots |= {row.robot for row in rows}
        for start in range(0, len(rows), _AT_ONCE):
            with database.begin() as connection:
                for row in rows[start : start + _AT_ONCE]:
                    drop_committed(connection, row.robot, row.store_id, row.writer, row.run,
                                   row.first_seq, row.end_seq)  # fmt: skip
        with database.begin() as connection:
            options.write(connection, clock.wall_ns(), _SETTLED, Settled(rows[0].batch))
    return sorted(robots)


def _next(database: Database) -> Sequence[Row[Any]]:
    """Return the journals of the first batch that is committed and not settled."""
    with database.reading() as connection:
        settled = options.read(connection, _SETTLED, Settled).batch
        later = and_(JOURNALS.c.state == COMMITTED, JOURNALS.c.batch > settled)
        batch = connection.scalar(select(func.min(JOURNALS.c.batch)).where(later))
        if batch is None:
            return []
        return connection.execute(select(JOURNALS).where(later, JOURNALS.c.batch == batch)).all()


def take_over(archive: FolderArchive, database: Database, folder: Path) -> int:
    """Hand verified journals to the archive that it has not got; return how many it took.

    A server that died between both leaves such. One that does not hold any more is logged.
    """
    with database.reading() as connection:
        rows = connection.execute(select(UPLOAD).where(UPLOAD.c.state == "verified", _unknown()))
        found = [
            (JournalKey(row.robot, row.store_id, row.journal, row.sha256), folder / row.path)
            for row in rows
        ]
    return sum(_taken(archive, key, path) for key, path in found if path.exists())


def take_confirmed(archive: FolderArchive, database: Database, folder: Path) -> int:
    """Hand journals to the archive whose key was confirmed since; return how many it took."""
    confirmed = and_(UPLOAD.c.state == "verified", UPLOAD.c.path.like("aside/%"))
    with database.reading() as connection:
        rows = connection.execute(select(UPLOAD).where(confirmed)).all()
    taken = 0
    for row in rows:
        key = JournalKey(row.robot, row.store_id, row.journal, row.sha256)
        path = archive.layout.journal(row.robot, row.store_id, row.journal)
        taken += (folder / row.path).exists() and _taken(archive, key, folder / row.path)
        if path.exists():
            moved = {"path": path.relative_to(folder).as_posix()}
            mine = and_(UPLOAD.c.path == row.path, UPLOAD.c.sha256 == row.sha256)
            with database.begin() as connection:
                connection.execute(update(UPLOAD).where(mine).values(**moved))
    return taken


def _taken(archive: FolderArchive, key: JournalKey, path: Path) -> bool:
    try:
        return archive.put(key, path).is_new
    except AmberboxError as error:
        logging.getLogger(__name__).warning("%s (%s)", error.what, error.hint)
    except Exception:  # an older server let in what this one refuses: it must start nevertheless
        logging.getLogger(__name__).exception("%s of %s cannot be read", key.file, key.robot)
    return False


def _unknown() -> Any:
    same = and_(
        JOURNALS.c.robot == UPLOAD.c.robot,
        JOURNALS.c.store_id == UPLOAD.c.store_id,
        JOURNALS.c.file == UPLOAD.c.journal,
    )
    return ~exists().where(same)


def note_lost(archive: FolderArchive, database: Database) -> None:
    """Tell the archive what power cuts took from robots, as far as the server had seen it."""
    with database.reading() as connection:
        for row in _lost(connection):
            one = Missing(
                row.writer, row.run, row.first, row.last + 1, row.from_ns, row.to_ns, LOST,
                "rows that came early are kept apart",
            )  # fmt: skip
            archive.note_missing(row.robot, row.store_id, [one])


def _lost(connection: Connection) -> Sequence[Any]:
    seq, at = ASIDE.c.seq, ASIDE.c.log_ns
    keys = (ASIDE.c.robot, ASIDE.c.store_id, ASIDE.c.writer, ASIDE.c.run)
    ends = (func.min(seq).label("first"), func.max(seq).label("last"),
            func.min(at).label("from_ns"), func.max(at).label("to_ns"))  # fmt: skip
    wanted = select(*keys, *ends).where(ASIDE.c.why == history.LOST).group_by(*keys)
    return connection.execute(wanted).all()


def deleted(proof: Proof) -> Iterator[Missing]:
    """Yield what a proof says was deleted on the robot before any server had it."""
    for line in f"{proof.lines}\n{proof.gone}".encode().split(b"\n"):
        if b',"kind":"gone",' not in line:
            continue
        tombstone = _tombstone(decode(line))
        if tombstone is not None and tombstone.what != "columns" and not tombstone.confirmed:
            yield Missing(
                tombstone.writer, tombstone.run, tombstone.first_seq, tombstone.end_seq,
                tombstone.start_ns, tombstone.end_ns, DELETED, tombstone.reason[:500],
            )  # fmt: skip


def _tombstone(record: dict[str, Any] | None) -> Tombstone | None:
    try:
        found = from_record(record) if record is not None else None
    except (msgspec.ValidationError, KeyError, TypeError):
        return None
    return found if isinstance(found, Tombstone) else None
