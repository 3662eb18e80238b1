"""The audit log: looked through, taken away (which is noted in it), and verified."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from fastapi import Depends, Query
from fastapi.responses import StreamingResponse
from sqlalchemy import Select, select

from amberbox.core.clock import Clock
from amberbox.core.timetext import format_time, in_order
from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.forms import Limit, TimeText, download, time_of
from amberbox.fleet.audit import export, log, verify
from amberbox.fleet.audit.entry import Row
from amberbox.fleet.audit.tables import AUDIT
from amberbox.fleet.database.database import Database

routes = Routes("audit")

_AT_ONCE = 1_000

Form = Literal["csv", "jsonl"]
Result = Literal["", "ok", "refused", "failed"]
_KINDS = {"csv": "text/csv; charset=utf-8", "jsonl": "application/x-ndjson"}
_ABOUT: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "the rows, oldest first",
        "content": {"text/csv": {"schema": {"type": "string"}},
                    "application/x-ndjson": {"schema": {"type": "string"}}},
    }
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class AuditRow:
    """A row of the log; ``hash`` ties it to the row before."""

    seq: int
    time: str
    principal: str
    address: str
    action: str
    object: str
    result: str
    details: dict[str, Any]
    hash: str


@dataclass(frozen=True, slots=True)
class AuditHead:
    """How far the log goes. Noted elsewhere, ``text`` proves all rows up to there."""

    seq: int
    hash: str
    text: str


@dataclass(frozen=True, slots=True)
class AuditVerdict:
    """Whether every row follows on the one before; if not, the first that does not, and why."""

    holds: bool
    rows: int
    head: AuditHead
    broken: int | None
    what: str


@dataclass(frozen=True, slots=True)
class Filter:
    """Which rows; what is empty fits all. ``object`` fits what begins with it."""

    from_: Annotated[TimeText, Query(alias="from")] = ""
    to: TimeText = ""
    principal: Annotated[str, Query(max_length=140)] = ""
    action: Annotated[str, Query(max_length=64)] = ""
    object: Annotated[str, Query(max_length=300)] = ""
    result: Result = ""


Filtered = Annotated[Filter, Depends()]
After = Annotated[int, Query(ge=0, le=2**62, description="the number of the last row before")]
Kept = Annotated[
    list[Annotated[str, Query(max_length=90)]],
    Query(max_length=100, description="a head that was noted before: number, space, hash"),
]


@routes.get("/audit", "audit.read")
def list_rows(
    fleet: Fleet,
    wanted: Filtered,
    order: Literal["newest", "oldest"] = "newest",
    after: After = 0,
    limit: Limit = 100,
) -> list[AuditRow]:
    """List rows, newest first or oldest first; ``after`` goes on behind a row."""
    chosen = _chosen(wanted, fleet.clock).limit(limit)
    if order == "oldest":
        chosen = chosen.where(AUDIT.c.seq > after).order_by(AUDIT.c.seq)
    else:
        chosen = chosen.where(AUDIT.c.seq < after) if after else chosen
        chosen = chosen.order_by(AUDIT.c.seq.desc())
    with fleet.database.reading() as connection:
        return [_noted(Row(**row)) for row in connection.execute(chosen).mappings()]


@routes.get("/audit/head", "audit.read")
def read_head(fleet: Fleet) -> AuditHead:
    """Return how far the log goes: note it elsewhere from time to time."""
    with fleet.database.reading() as connection:
        return _head(log.head(connection))


@routes.get("/audit/verify", "audit.read")
def verify_rows(fleet: Fleet, head: Kept = []) -> AuditVerdict:  # noqa: B006 -- FastAPI copies it
    """Follow the log from its first row to its last, by the heads that were noted before too."""
    kept = [log.Head.from_text(text) for text in head]
    with fleet.database.reading() as connection:
        found = verify.verify(connection, kept)
    broken = found.broken
    return AuditVerdict(
        found.holds, found.rows, _head(found.head),
        None if broken is None else broken.seq, "" if broken is None else broken.what,
    )  # fmt: skip


@routes.get("/audit/export", "audit.read", response_class=StreamingResponse, responses=_ABOUT)
def export_rows(fleet: Fleet, who: Who, wanted: Filtered, form: Form = "csv") -> StreamingResponse:
    """Download rows; that somebody did is in the log, too."""
    chosen = _chosen(wanted, fleet.clock)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        last = log.head(connection).seq
        who.note(connection, now_ns, "audit.export", form, details={"rows up to": last})
    lines = _lines(fleet.database, chosen, last, form)
    return StreamingResponse(
        lines, headers=download(f"amberbox-audit.{form}"), media_type=_KINDS[form]
    )


def _lines(database: Database, chosen: Select[Any], last: int, form: Form) -> Iterator[str]:
    """Yield the text of rows up to the last, a page per transaction: none stays open for long."""
    to_text = export.csv_lines if form == "csv" else export.json_lines
    after, head = 0, list(export.csv_lines(())) if form == "csv" else []
    yield from head
    while rows := _page(database, chosen, after, last):
        yield "".join(list(to_text(rows))[len(head) :])
        after = rows[-1].seq


def _page(database: Database, chosen: Select[Any], after: int, last: int) -> list[Row]:
    here = chosen.where(AUDIT.c.seq > after, AUDIT.c.seq <= last).order_by(AUDIT.c.seq)
    with database.reading() as connection:
        return [Row(**row) for row in connection.execute(here.limit(_AT_ONCE)).mappings()]


def _chosen(wanted: Filter, clock: Clock) -> Select[Any]:
    from_ns, to_ns = in_order(time_of(wanted.from_, clock), time_of(wanted.to, clock))
    chosen = select(AUDIT)
    chosen = chosen if from_ns is None else chosen.where(AUDIT.c.time_ns >= from_ns)
    chosen = chosen if to_ns is None else chosen.where(AUDIT.c.time_ns < to_ns)
    for name in ("principal", "action", "result"):
        value = getattr(wanted, name)
        chosen = chosen.where(AUDIT.c[name] == value) if value else chosen
    begins = AUDIT.c.object.startswith(wanted.object, autoescape=True)
    return chosen.where(begins) if wanted.object else chosen


def _head(head: log.Head) -> AuditHead:
    return AuditHead(head.seq, head.hash, str(head))


def _noted(row: Row) -> AuditRow:
    return AuditRow(
        row.seq, format_time(row.time_ns), row.principal, row.address, row.action, row.object,
        row.result, json.loads(row.details), row.hash,
    )  # fmt: skip
