"""The audit log as JSON lines, for programs, and as CSV, for spreadsheets that must not run it."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator

from amberbox.core.spreadsheets import harmless
from amberbox.core.timetext import format_time
from amberbox.fleet.audit.entry import Row

COLUMNS = ("seq", "time", "principal", "address", "action", "object", "result", "details", "hash")


def json_lines(rows: Iterable[Row]) -> Iterator[str]:
    """Yield one line of JSON per row; ``time`` is RFC 3339, ``time_ns`` what the hash covers."""
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


def csv_lines(rows: Iterable[Row]) -> Iterator[str]:
    """Yield CSV, its header first; text that a spreadsheet would run begins with ``'``."""
    yield _csv_line(COLUMNS)
    for row in rows:
        texts = (row.principal, row.address, row.action, row.object, row.result, row.details)
        cells = map(harmless, texts)
        yield _csv_line((str(row.seq), format_time(row.time_ns), *cells, row.hash))


def _csv_line(cells: Iterable[str]) -> str:
    line = io.StringIO()
    csv.writer(line, quoting=csv.QUOTE_ALL, lineterminator="\r\n").writerow(list(cells))
    return line.getvalue()
