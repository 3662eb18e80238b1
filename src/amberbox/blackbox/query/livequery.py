"""Query that goes on: tables of new rows of one item, as they are recorded."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

from amberbox.blackbox.follow.follow import follow
from amberbox.blackbox.query.catalogue import look
from amberbox.blackbox.query.gather import merge
from amberbox.blackbox.query.record import Record, Time, make_table, needed_columns, wanted_columns
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments.build import can_build
from amberbox.blackbox.segments.flat import Flat, flatten
from amberbox.core.clock import NS
from amberbox.core.types import Batch

_NOW_S = 1e-3


def follow_tables(
    record: Record,
    item: str,
    variables: Sequence[str] | None = None,
    from_: Time = None,
    *,
    live: bool = True,
    stop: threading.Event | None = None,
) -> Iterator[Table]:
    """Yield rows of an item as they come, from ``from_`` on, or from the newest one.

    Raises UsageError for an item or variable that is not there.
    """
    catalogue = look(record.path, with_segments=can_build())
    schema = catalogue.schema(item)
    wanted = wanted_columns(catalogue, schema, variables)
    needed = needed_columns(wanted)
    from_ns, last_ns = record.time_ns(from_), record.last_ns()
    lookback_s = _NOW_S
    if from_ns is not None and last_ns is not None:
        lookback_s = max((last_ns - from_ns) / NS, 0.0) + _NOW_S
    top = schema.parent or schema.item
    for delivery in follow(record.path, {top}, lookback_s=lookback_s, live=live, stop=stop):
        if isinstance(delivery, Batch):
            for rows in _rows(delivery, schema.item, from_ns):
                yield make_table(schema, wanted, merge([rows], schema, needed, "received"))


def _rows(batch: Batch, table: str, from_ns: int | None) -> Iterator[Flat]:
    for flat in flatten(batch):
        if flat.schema.item == table:
            rows = flat if from_ns is None else flat.take(flat.received_ns >= from_ns)
            if len(rows):
                yield rows
