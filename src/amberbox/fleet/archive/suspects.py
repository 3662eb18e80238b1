"""Journals over which a commit failed: tried again, then each alone, then refused.

A batch is for many journals, so one that kills the worker would hold up all others for ever. What
is known of failures stands in the database: it outlives the worker, and the server.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, Row

from amberbox import __version__
from amberbox.fleet.archive.catalogue import PUT, REFUSED, Batch, Catalogue, name_of
from amberbox.fleet.archive.journal import decode, encode
from amberbox.fleet.linkend.events import note
from amberbox.fleet.options import options

TRIES = 2
"""So often a batch is begun: a worker may also die of something else."""

KIND = "journal_refused"
"""Kind of the event about a journal that was refused."""

_NAME = "archive.suspects"


@dataclass(frozen=True, slots=True)
class Suspects:
    """How often which batch failed, over which journal and why; what is committed ``alone``.

    Journals are named ``robot/store_id/folder/file``; ``at`` is empty when different ones were at
    hand, or none.
    """

    batch: int = 0
    times: int = 0
    at: str = ""
    why: str = ""
    alone: tuple[str, ...] = ()

    def is_given_up(self, batch: Batch) -> bool:
        """Tell whether a batch is not to be begun again."""
        return self.batch == batch.number and self.times >= TRIES


def read(connection: Connection) -> Suspects:
    """Return what is known of failures."""
    return options.read(connection, _NAME, Suspects)


def known(catalogue: Catalogue) -> Suspects:
    """Return what is known of failures."""
    with catalogue.database.reading() as connection:
        return read(connection)


def note_failure(catalogue: Catalogue, now_ns: int, at: str, why: str) -> None:
    """Count that the open batch failed over the journal ``at``."""
    batch = catalogue.open_batch()
    if batch is None:
        return
    with catalogue.database.begin() as connection:
        before = read(connection)
        if before.batch != batch.number:
            before = replace(before, batch=batch.number, times=0, at=at)
        after = replace(
            before, times=before.times + 1, at=at if at == before.at else "", why=why[:500]
        )
        options.write(connection, now_ns, _NAME, after)


def give_up(catalogue: Catalogue, batch: Batch, now_ns: int) -> int:
    """End a batch that failed, of which no row is in any table; return how many were refused.

    The journal over which it happened is committed alone from now on, or each of them when it is
    not known which one. One that failed so is refused.
    """
    with catalogue.database.begin() as connection:
        suspects = read(connection)
        names = {name_of(row): row for row in batch.journals}
        blamed = {suspects.at} & names.keys() or names.keys()
        left = [name for name in suspects.alone if name not in names]
        refused = next((row for name, row in names.items() if name in suspects.alone), None)
        if refused is not None:
            facts = decode(refused.facts)
            facts.refused, facts.by = f"it cannot be made rows of: {suspects.why}", __version__
            catalogue.change_in(connection, [refused], state=REFUSED, facts=encode(facts))
            note(connection, refused.robot, now_ns, KIND, _told(refused, facts.refused))
            blamed = set()
        catalogue.cancel(connection, batch)
        after = Suspects(alone=(*left, *sorted(blamed)))
        options.write(connection, now_ns, _NAME, after)
    return 0 if refused is None else 1


def clear(catalogue: Catalogue, batch: Batch, now_ns: int) -> None:
    """Forget what was suspected of journals that are committed now."""
    before = known(catalogue)
    if before == Suspects():
        return
    done = {name_of(row) for row in batch.journals}
    left = tuple(name for name in before.alone if name not in done)
    with catalogue.database.begin() as connection:
        options.write(connection, now_ns, _NAME, Suspects(alone=left))


def try_again(catalogue: Catalogue, now_ns: int) -> int:
    """Have journals committed, alone, that another version of the server refused; count them."""
    rows = [row for row in catalogue.journals() if row.state == REFUSED and not row.raw_gone]
    found = [row for row in rows if decode(row.facts).by not in ("", __version__)]
    with catalogue.database.begin() as connection:
        for row in found:
            facts = decode(row.facts)
            facts.refused = facts.by = ""
            catalogue.change_in(connection, [row], state=PUT, facts=encode(facts))
        before = read(connection)
        alone = (*before.alone, *map(name_of, found))
        options.write(connection, now_ns, _NAME, replace(before, alone=alone))
    return len(found)


def _told(row: Row[Any], reason: str) -> str:
    return (
        f"{row.file} is kept and in no table: {reason}. It is damaged or forged, or this server "
        "has a mistake: run amberbox verify on the robot, and report the error of the server's "
        f"log with the file journals/{name_of(row)}. After an update it is tried again"
    )
