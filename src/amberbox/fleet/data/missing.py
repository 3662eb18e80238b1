"""What is missing of a robot's record and why, as the API lists it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from sqlalchemy import Row, exists, select

from amberbox.blackbox.store import FOLDERS, run_and_number
from amberbox.core.timetext import format_time
from amberbox.core.types import Gap
from amberbox.fleet.archive.catalogue import Source
from amberbox.fleet.archive.gaps import WAITING, gaps_of
from amberbox.fleet.archive.holes import REFUSED, TO_COME, Refused
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.data.asked import Asked
from amberbox.fleet.data.look import Look
from amberbox.fleet.uploads.tables import UPLOAD

GapKind = Literal["to_come", "waiting", "refused", "deleted", "filtered", "lost", "uncovered"]
_WRITERS = {folder: writer for writer, folder in FOLDERS.items()}
_KINDS: Sequence[tuple[GapKind, re.Pattern[str]]] = (
    ("to_come", re.compile(f"^{re.escape(TO_COME)}")),
    ("waiting", re.compile(f"^{re.escape(WAITING)}")),
    ("refused", re.compile(f"^{re.escape(REFUSED)}")),
    ("deleted", re.compile("^deleted")),
    ("filtered", re.compile("filter|unchanged|rate.?limit", re.IGNORECASE)),
    ("lost", re.compile("lost|drop|queue|damaged|torn|refused|corrupt|decod|columns", re.I)),
)
"""Records say why rows are missing in words, those of years ago too: the first that fits."""


def kind_of(reason: str) -> GapKind:
    """Sort a reason; what fits none says that nothing was recorded."""
    return next((kind for kind, words in _KINDS if words.search(reason)), "uncovered")


def gaps_json(look: Look, asked: Asked) -> dict[str, Any]:
    """List gaps of an item (all without a name) that meet ``[from, to)``, in order of time.

    Journals that wait for their columns are none where questions are answered from them, too.
    """
    item, span = asked.item or None, (asked.from_ns, asked.to_ns)
    read = {f"{one.source.store_id}/{one.row.file}" for one in look.readable}
    found = gaps_of(look.reader, look.catalogue, item, span, refused(look, asked.robot), read)
    return {"gaps": [_gap(gap) for gap in found[: asked.limit]], "more": len(found) > asked.limit}


def _gap(gap: Gap) -> dict[str, Any]:
    return {
        "item": gap.item, "writer": gap.writer, "run": gap.run, "from": format_time(gap.from_ns),
        "to": format_time(gap.to_ns), "kind": kind_of(gap.reason), "reason": gap.reason,
        "count": gap.count, "publisher": gap.peer,
    }  # fmt: skip


def refused(look: Look, robot: str) -> Mapping[Source, Sequence[Refused]]:
    """Return the files of a robot's stores that came, do not hold, and have no better one."""
    j, u = JOURNALS.c, UPLOAD.c
    held = exists().where(j.robot == u.robot, j.store_id == u.store_id, j.file == u.journal)
    chosen = select(UPLOAD).where(u.robot == robot, u.state == "quarantined", ~held)
    with look.catalogue.database.reading() as connection:
        rows = connection.execute(chosen.order_by(u.ended_ns)).all()
    found: dict[Source, dict[str, Refused]] = {}
    for row in rows:  # of one that came several times the last counts
        found.setdefault(Source(row.robot, row.store_id), {})[row.journal] = _refused(row)
    return {source: list(files.values()) for source, files in found.items()}


def _refused(row: Row[Any]) -> Refused:
    path = Path(row.journal)
    return Refused(
        _WRITERS[path.parent.name], *run_and_number(path), row.journal, row.reason,
        row.ended_ns or row.began_ns, row.first_seq, row.end_seq, row.start_ns, row.end_ns,
    )  # fmt: skip
