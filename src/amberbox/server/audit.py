"""The audit log: an append-only, hash-chained table; append, read, export and verify its rows."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, astuple, dataclass, field, replace
from typing import Any, Literal

from sqlalchemy import Connection, Select, select

from amberbox.core.errors import UsageError
from amberbox.core.redaction import MASK, sounds_secret
from amberbox.core.safe_text import spreadsheet_safe
from amberbox.core.timestamps import format_time
from amberbox.server.database import upsert_rows
from amberbox.server.schema import AUDIT, AUDIT_HEAD

Result = Literal["ok", "refused", "failed"]
# The hash before the first row
START = "0" * 64

_LONGEST = {"principal": 140, "address": 64, "action": 64, "object": 300}
_LONGEST_DETAILS = 8_000
# Further names of secrets in requests
_SECRET_HERE = ("csrf", "cookie", "private")


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One action: ``principal`` from ``address`` did ``action`` to ``object``.

    ``details`` is JSON-serialisable. Values whose key names a secret are masked, and long texts are
    cut, so that requests cannot fill the disk through the log.
    """

    principal: str
    address: str
    action: str
    object: str = ""
    result: Result = "ok"
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class AuditLogRow:
    """A stored row; ``details`` is JSON text, ``hash`` 64 hex digits."""

    seq: int
    time_ns: int
    principal: str
    address: str
    action: str
    object: str
    result: str
    details: str
    hash: str


def row_after(previous_seq: int, previous_hash: str, now_ns: int, entry: AuditEntry) -> AuditLogRow:
    """Return the row that follows the row with this number and hash."""
    cut = {name: _plain(getattr(entry, name))[:most] for name, most in _LONGEST.items()}
    details = _details(entry.details)
    row = AuditLogRow(
        seq=previous_seq + 1, time_ns=now_ns, **cut, result=entry.result, details=details, hash=""
    )
    return replace(row, hash=chain_hash(previous_hash, row))


def chain_hash(previous_hash: str, row: AuditLogRow) -> str:
    """Return the hash of a row: SHA-256 of the previous hash and the row as JSON."""
    text = json.dumps([previous_hash, *astuple(row)[:-1]], ensure_ascii=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def _plain(text: str) -> str:
    """Replace characters that databases refuse: NUL and lone surrogates."""
    return (
        text.encode("utf-8", "replace").decode("utf-8").replace("\0", "\N{REPLACEMENT CHARACTER}")
    )


def _details(details: Mapping[str, Any]) -> str:
    text = json.dumps(_masked(details), sort_keys=True, default=str)
    if len(text) <= _LONGEST_DETAILS:
        return text
    return json.dumps({"cut": text[: _LONGEST_DETAILS // 2], "characters": len(text)})


def _masked(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(_masked_pairs(value))
    if isinstance(value, list | tuple | set | frozenset):
        return [_masked(inner) for inner in value]
    return value


def _masked_pairs(pairs: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in pairs.items():
        secret = isinstance(value, str) and _is_secret(str(key))
        yield str(key), MASK if secret else _masked(value)


def _is_secret(key: str) -> bool:
    return sounds_secret(key) or any(word in key.lower() for word in _SECRET_HERE)


_AT_ONCE = 1_000


@dataclass(frozen=True, slots=True)
class AuditChainHead:
    """Number and hash of the newest row. A copy kept elsewhere proves all rows up to there."""

    seq: int
    hash: str

    def __str__(self) -> str:
        return f"{self.seq} {self.hash}"

    @classmethod
    def from_text(cls, text: str) -> AuditChainHead:
        """Parse the printed form ``number hash``; raises UsageError."""
        number, _, digest = text.strip().partition(" ")
        if number.isdecimal() and len(digest) == len(START) and not set(digest) - set(_HEX):
            return cls(int(number), digest)
        raise UsageError(
            f"not a head of an audit log: {text!r}", "it is a number, a space and 64 hex digits"
        )


_HEX = "0123456789abcdef"


def append(connection: Connection, now_ns: int, entry: AuditEntry) -> AuditLogRow:
    """Append a row; ``connection`` is in a writing transaction."""
    before = _held(connection)
    row = row_after(before.seq, before.hash, now_ns, entry)
    connection.execute(AUDIT.insert(), [asdict(row)])
    newest = {"one": 1, "seq": row.seq, "hash": row.hash}
    upsert_rows(connection, AUDIT_HEAD, [newest], ("seq", "hash"))
    return row


def _held(connection: Connection) -> AuditChainHead:
    """Return the head, created if absent, and lock it against other writers until the commit."""
    upsert_rows(connection, AUDIT_HEAD, [{"one": 1, "seq": 0, "hash": START}])
    chosen = select(AUDIT_HEAD.c.seq, AUDIT_HEAD.c.hash).with_for_update()
    return AuditChainHead(*connection.execute(chosen).one())


def head(connection: Connection) -> AuditChainHead:
    """Return the newest row's number and hash; number 0 for an empty log."""
    found = connection.execute(select(AUDIT_HEAD.c.seq, AUDIT_HEAD.c.hash)).one_or_none()
    return AuditChainHead(0, START) if found is None else AuditChainHead(*found)


def rows(
    connection: Connection,
    *,
    after_seq: int = 0,
    from_ns: int | None = None,
    to_ns: int | None = None,
    principal: str = "",
    action: str = "",
) -> Iterator[AuditLogRow]:
    """Yield the rows that match all filters, in order, read in batches; an empty filter matches
    all.
    """
    chosen = select(AUDIT).order_by(AUDIT.c.seq).limit(_AT_ONCE)
    chosen = chosen if from_ns is None else chosen.where(AUDIT.c.time_ns >= from_ns)
    chosen = chosen if to_ns is None else chosen.where(AUDIT.c.time_ns < to_ns)
    chosen = chosen.where(AUDIT.c.principal == principal) if principal else chosen
    chosen = chosen.where(AUDIT.c.action == action) if action else chosen
    while some := _after(connection, chosen, after_seq):
        yield from some
        after_seq = some[-1].seq


def _after(
    connection: Connection, chosen: Select[tuple[object, ...]], seq: int
) -> list[AuditLogRow]:
    found = connection.execute(chosen.where(AUDIT.c.seq > seq)).mappings()
    return [AuditLogRow(**row) for row in found]


@dataclass(frozen=True, slots=True)
class BrokenAuditRow:
    """The first row that is wrong, and the reason."""

    seq: int
    what: str


@dataclass(frozen=True, slots=True)
class AuditVerification:
    """The result of a verification: count of valid rows, the last valid and the first wrong one."""

    rows: int
    head: AuditChainHead
    broken: BrokenAuditRow | None

    @property
    def holds(self) -> bool:
        """Return whether no row is missing, changed or added, as far as the heads can show."""
        return self.broken is None


def verify(connection: Connection, kept: Iterable[AuditChainHead] = ()) -> AuditVerification:
    """Verify the hash chain from the first row to the last.

    ``kept`` are heads that were copied elsewhere earlier: with one of them, a change of rows up to
    there is detected, even if it was made by a person with write access to the database.
    """
    return follow(rows(connection), head(connection), kept)


def follow(
    chain: Iterable[AuditLogRow], stated: AuditChainHead, kept: Iterable[AuditChainHead] = ()
) -> AuditVerification:
    """Verify rows, in order of their numbers, against the stored head and copied heads."""
    wanted = {one.seq: one.hash for one in kept}
    reached = AuditChainHead(0, START)
    for row in chain:
        broken = _judge(reached, row, wanted)
        if broken is not None:
            return AuditVerification(reached.seq, reached, broken)
        reached = AuditChainHead(row.seq, row.hash)
    return AuditVerification(reached.seq, reached, _end(reached, stated, wanted))


def _judge(
    reached: AuditChainHead, row: AuditLogRow, wanted: dict[int, str]
) -> BrokenAuditRow | None:
    if row.seq != reached.seq + 1:
        return BrokenAuditRow(
            reached.seq + 1, f"missing: row {row.seq} comes after row {reached.seq}"
        )
    if row.hash != chain_hash(reached.hash, row):
        return BrokenAuditRow(
            row.seq, "changed: its hash is not that of its contents and the row before"
        )
    if wanted.get(row.seq, row.hash) != row.hash:
        return BrokenAuditRow(
            row.seq, "rewritten: it has another hash than the head that was noted"
        )
    return None


def _end(
    reached: AuditChainHead, stated: AuditChainHead, wanted: dict[int, str]
) -> BrokenAuditRow | None:
    furthest = max(stated.seq, *wanted, 0)
    if reached.seq < furthest:
        return BrokenAuditRow(reached.seq + 1, f"missing: the log went to row {furthest}")
    if stated != reached:
        return BrokenAuditRow(stated.seq + 1, f"added: the log went to row {stated.seq} only")
    return None


COLUMNS = ("seq", "time", "principal", "address", "action", "object", "result", "details", "hash")


def json_lines(rows: Iterable[AuditLogRow]) -> Iterator[str]:
    """Yield one JSON line per row; ``time`` is RFC 3339, ``time_ns`` the value that is hashed."""
    for row in rows:
        record = {
            "seq": row.seq,
            "time": format_time(row.time_ns),
            "time_ns": str(row.time_ns),
            "principal": row.principal,
            "address": row.address,
            "action": row.action,
            "object": row.object,
            "result": row.result,
            "details": json.loads(row.details),
            "hash": row.hash,
        }
        yield json.dumps(record) + "\n"


def csv_lines(rows: Iterable[AuditLogRow]) -> Iterator[str]:
    """Yield CSV lines, header first; text that a spreadsheet would execute gets a leading ``'``."""
    yield _csv_line(COLUMNS)
    for row in rows:
        texts = (row.principal, row.address, row.action, row.object, row.result, row.details)
        cells = map(spreadsheet_safe, texts)
        yield _csv_line((str(row.seq), format_time(row.time_ns), *cells, row.hash))


def _csv_line(cells: Iterable[str]) -> str:
    line = io.StringIO()
    csv.writer(line, quoting=csv.QUOTE_ALL, lineterminator="\r\n").writerow(list(cells))
    return line.getvalue()
