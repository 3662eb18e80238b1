"""Rows of the audit log as API and pages show them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Select, select

from amberbox.core.api import AuditRow
from amberbox.core.clock import Clock
from amberbox.core.timestamps import format_time, ordered_span
from amberbox.server import audit
from amberbox.server.audit import AuditLogRow
from amberbox.server.schema import AUDIT
from amberbox.server.services.context import Services, query_time_ns

Result = Literal["", "ok", "refused", "failed"]
Order = Literal["newest", "oldest"]


def list_rows(
    fleet: Services, wanted: AuditQuery, order: Order = "newest", after: int = 0, limit: int = 100
) -> list[AuditRow]:
    """List rows, newest first or oldest first; ``after`` continues after a row."""
    chosen = select_rows(wanted, fleet.clock).limit(limit)
    if order == "oldest":
        chosen = chosen.where(AUDIT.c.seq > after).order_by(AUDIT.c.seq)
    else:
        chosen = chosen.where(AUDIT.c.seq < after) if after else chosen
        chosen = chosen.order_by(AUDIT.c.seq.desc())
    with fleet.database.reading() as connection:
        return [audit_row(AuditLogRow(**row)) for row in connection.execute(chosen).mappings()]


def read_head(fleet: Services) -> AuditHead:
    """Return the head of the log, to be stored elsewhere from time to time."""
    with fleet.database.reading() as connection:
        return audit_head(audit.head(connection))


@dataclass(frozen=True, slots=True)
class AuditHead:
    """How far the log goes. Noted elsewhere, ``text`` proves all rows up to there."""

    seq: int
    hash: str
    text: str


def select_rows(wanted: AuditQuery, clock: Clock) -> Select[Any]:
    """Return the question for the rows that fit."""
    from_ns, to_ns = ordered_span(
        query_time_ns(wanted.from_, clock), query_time_ns(wanted.to, clock)
    )
    chosen = select(AUDIT)
    chosen = chosen if from_ns is None else chosen.where(AUDIT.c.time_ns >= from_ns)
    chosen = chosen if to_ns is None else chosen.where(AUDIT.c.time_ns < to_ns)
    for name in ("principal", "action", "result"):
        value = getattr(wanted, name)
        chosen = chosen.where(AUDIT.c[name] == value) if value else chosen
    begins = AUDIT.c.object.startswith(wanted.object, autoescape=True)
    return chosen.where(begins) if wanted.object else chosen


def audit_head(head: audit.AuditChainHead) -> AuditHead:
    """Return a head in its published form."""
    return AuditHead(head.seq, head.hash, str(head))


def audit_row(row: AuditLogRow) -> AuditRow:
    """Return a row in its published form."""
    return AuditRow(
        row.seq, format_time(row.time_ns), row.principal, row.address, row.action, row.object,
        row.result, json.loads(row.details), row.hash,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class AuditQuery:
    """A selection of rows; an empty field matches all. ``object`` matches by its beginning."""

    from_: str = ""
    to: str = ""
    principal: str = ""
    action: str = ""
    object: str = ""
    result: Result = ""
