"""Conditions at the end, whatever happened: nothing lost, nothing twice, byte for byte."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sqlalchemy import select

from amberbox.blackbox.store import manifest, store
from amberbox.blackbox.store.journal_reader import journal_file, sound_chunks
from amberbox.blackbox.store.manifest import KIND as CONFIRM
from amberbox.blackbox.store.store import open_store
from amberbox.link.client import load_acknowledged
from amberbox.link.frames import START, JournalPosition
from amberbox.link.record_reader import ReachReader
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import UPLOAD, WRITER
from tests.link.robot.rig import Held, conclusions_of, held, put_aside, recorded
from tests.support.manual_recorder import COUNT


@dataclass(frozen=True, slots=True)
class Copy:
    """A journal on the server."""

    store_id: str
    journal: str
    sha256: str
    state: str
    path: Path


def copies(database: ServerDatabase, data: Path, robot: str) -> list[Copy]:
    """Return the journals of a robot that the server holds."""
    with database.reading() as connection:
        rows = connection.execute(select(UPLOAD).where(UPLOAD.c.robot == robot)).all()
    return [Copy(r.store_id, r.journal, r.sha256, r.state, data / r.path) for r in rows]


def is_caught_up(database: ServerDatabase, path: Path, robot: str) -> bool:
    """Return whether the server has acknowledged all rows of a store's journals, and each journal.

    Rows that are in the archive are deleted from the table of the link, so its cursor counts.
    """
    store, said = open_store(path), manifest.read(path)
    names = {name for name in said.sealed if name not in said.raw_gone}
    if not names or names - confirmed(path):
        return False
    table = WRITER.c
    chosen = select(WRITER).where(table.robot == robot, table.store_id == store.id)
    with database.reading() as connection:
        cursor = {r.writer: JournalPosition(r.run, r.seq) for r in connection.execute(chosen)}
    ends = {writer: reach.end for writer, reach in ReachReader(store).state().items()}
    return all(cursor.get(writer, START) >= end for writer, end in ends.items())


def confirmed(path: Path) -> set[str]:
    """Return the journals that were confirmed to the robot, including unprocessed requests."""
    waiting = (r for r in store.pending(open_store(path)) if r.kind == CONFIRM)
    return {*manifest.read(path).confirmed, *(n for r in waiting for n in r.values["journals"])}


def on_server(database: ServerDatabase, data: Path, robot: str) -> Held:
    """Return the rows that are part of a robot's record on the server, from link and journals.

    What both have is the same, and no two journals have the same row.
    """
    known = held(database, robot)
    found: Held = {}
    for copy in copies(database, data, robot):
        if copy.state == "verified":
            rows = conclusions_of(journal_file(copy.path, copy.journal), copy.store_id)
            assert not found.keys() & rows.keys(), "a row is in two journals"
            assert all(known.get(place, row) == row for place, row in rows.items())
            found |= rows
    return found | known


def judge_rows(
    database: ServerDatabase, data: Path, robot: str, path: Path, old: list[Path]
) -> int:
    """Check that each row of the record is on the server once, and each acknowledged row too."""
    known, aside = on_server(database, data, robot), put_aside(database, robot)
    store_id = open_store(path).id
    wanted = recorded(path)
    ours = {place: row for place, row in known.items() if place[0] == store_id}
    assert ours == wanted, "the server's rows are those of the record, each once"
    assert all(known.get(place) != row for place, row in aside.items()), "none is there twice"
    for before in old:
        for place, row in _acknowledged(before).items():
            assert row in (known.get(place), aside.get(place)), "acknowledged, and lost"
    return len(wanted)


def _acknowledged(path: Path) -> Held:
    """Return the rows of a store that its link knew to be safe on the server."""
    remembered = load_acknowledged(open_store(path))
    cursor = remembered.cursor if remembered is not None else {}
    return {
        (store, writer, run, seq): row
        for (store, writer, run, seq), row in recorded(path).items()
        if JournalPosition(run, seq) < cursor.get(writer, START)
    }


def judge_journals(database: ServerDatabase, data: Path, robot: str, stores: list[Path]) -> int:
    """Check that all confirmed journals are on the server, byte for byte; return their number."""
    there = copies(database, data, robot)
    by_content = {(c.store_id, c.journal, c.sha256): c for c in there}
    count = 0
    for path in stores:
        store = open_store(path)
        for name in confirmed(path):
            content = store.journal_path(name).read_bytes()
            copy = by_content[store.id, name, hashlib.sha256(content).hexdigest()]
            assert copy.state in ("verified", "aside") and copy.path.read_bytes() == content
            count += 1
    assert not [copy for copy in there if copy.state == "quarantined"]
    return count


def judge_data(database: ServerDatabase, data: Path, robot: str, path: Path) -> int:
    """Each message that the record holds is in the server's journals, none of them twice."""
    there = copies(database, data, robot)
    verified = [n for c in there if c.state == "verified" for n in _numbers(c.path, c.journal)]
    aside = {n for c in there if c.state == "aside" for n in _numbers(c.path, c.journal)}
    assert len(verified) == len(set(verified)), "a message is there twice"
    wanted = [
        n
        for file in open_store(path).journal_files("main")
        for n in _numbers(file, f"journal/{file.name}")
    ]
    assert set(wanted) <= set(verified) | aside, "a message is lost"
    return len(wanted)


def _numbers(path: Path, name: str) -> Iterator[int]:
    journal = journal_file(path, name)
    chosen = [n for n, stream in journal.streams.items() if stream.topic.name == COUNT.name]
    for chunk in sound_chunks(journal):
        rows = np.flatnonzero(np.isin(chunk.channel, chosen))
        yield from (int.from_bytes(m, "little", signed=True) for m in chunk.messages(rows))
