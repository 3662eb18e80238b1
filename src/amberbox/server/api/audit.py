"""Routes of the audit log: read, export and verify it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from fastapi import Query
from fastapi.responses import StreamingResponse
from sqlalchemy import Select

from amberbox.core.api import AuditRow
from amberbox.server import audit
from amberbox.server.audit import AuditLogRow
from amberbox.server.database import ServerDatabase
from amberbox.server.http.auth import Fleet, Routes, Who
from amberbox.server.http.forms import AuditFilter, Limit, download_headers
from amberbox.server.schema import AUDIT
from amberbox.server.services import audit as services
from amberbox.server.services.audit import AuditHead, Order, audit_head, select_rows

routes = Routes("audit")

_AT_ONCE = 1_000

ExportFormat = Literal["csv", "jsonl"]
_KINDS = {"csv": "text/csv; charset=utf-8", "jsonl": "application/x-ndjson"}
_ABOUT: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "the rows, oldest first",
        "content": {"text/csv": {"schema": {"type": "string"}},
                    "application/x-ndjson": {"schema": {"type": "string"}}},
    }
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class AuditVerdict:
    """Whether every row follows on the one before; if not, the first that does not, and why."""

    holds: bool
    rows: int
    head: AuditHead
    broken: int | None
    what: str


After = Annotated[int, Query(ge=0, le=2**62, description="the number of the last row before")]
Kept = Annotated[
    list[Annotated[str, Query(max_length=90)]],
    Query(max_length=100, description="a head that was noted before: number, space, hash"),
]


@routes.get("/audit", "audit.read")
def list_rows(
    fleet: Fleet,
    wanted: AuditFilter,
    order: Order = "newest",
    after: After = 0,
    limit: Limit = 100,
) -> list[AuditRow]:
    """List rows, newest first or oldest first; ``after`` goes on behind a row."""
    return services.list_rows(fleet, wanted, order, after, limit)


@routes.get("/audit/head", "audit.read")
def read_head(fleet: Fleet) -> AuditHead:
    """Return how far the log goes: note it elsewhere from time to time."""
    return services.read_head(fleet)


@routes.get("/audit/verify", "audit.read")
def verify_rows(fleet: Fleet, head: Kept = []) -> AuditVerdict:  # noqa: B006 -- FastAPI copies it
    """Follow the log from its first row to its last, by the heads that were noted before too."""
    kept = [audit.AuditChainHead.from_text(text) for text in head]
    with fleet.database.reading() as connection:
        found = audit.verify(connection, kept)
    broken = found.broken
    return AuditVerdict(
        found.holds, found.rows, audit_head(found.head),
        None if broken is None else broken.seq, "" if broken is None else broken.what,
    )  # fmt: skip


@routes.get("/audit/export", "audit.read", response_class=StreamingResponse, responses=_ABOUT)
def export_rows(
    fleet: Fleet, who: Who, wanted: AuditFilter, form: ExportFormat = "csv"
) -> StreamingResponse:
    """Download rows; that somebody did is in the log, too."""
    chosen = select_rows(wanted, fleet.clock)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        last = audit.head(connection).seq
        who.note(connection, now_ns, "audit.export", form, details={"rows up to": last})
    lines = _lines(fleet.database, chosen, last, form)
    return StreamingResponse(
        lines, headers=download_headers(f"amberbox-audit.{form}"), media_type=_KINDS[form]
    )


def _lines(
    database: ServerDatabase, chosen: Select[Any], last: int, form: ExportFormat
) -> Iterator[str]:
    """Yield the text of rows up to the last, a page per transaction: none stays open for long."""
    to_text = audit.csv_lines if form == "csv" else audit.json_lines
    after, head = 0, list(audit.csv_lines(())) if form == "csv" else []
    yield from head
    while rows := _page(database, chosen, after, last):
        yield "".join(list(to_text(rows))[len(head) :])
        after = rows[-1].seq


def _page(
    database: ServerDatabase, chosen: Select[Any], after: int, last: int
) -> list[AuditLogRow]:
    here = chosen.where(AUDIT.c.seq > after, AUDIT.c.seq <= last).order_by(AUDIT.c.seq)
    with database.reading() as connection:
        return [AuditLogRow(**row) for row in connection.execute(here.limit(_AT_ONCE)).mappings()]
