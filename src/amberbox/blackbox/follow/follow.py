"""Follow a record with a cursor: the one interface that everything behind the recorder stands on.

Live and replay are the same: rows come in ``seq`` order per writer, damage comes as gaps, and a
follower that stored its cursor goes on exactly where it was.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from amberbox.blackbox.follow.tail import WriterTail, position_at
from amberbox.blackbox.store import open_store
from amberbox.blackbox.where import store_path
from amberbox.core.types import Batch, Cursor, Gap, Watermark, WriterCursor

Delivery: TypeAlias = Batch | Gap | Watermark

RECORDED = ("main", "bulk", "ring")
"""The writers that are followed unless others are named: what the recorder writes."""


def follow(
    where: str | Path,
    items: Collection[str] | None = None,
    cursor: Cursor | None = None,
    lookback_s: float = 0.0,
    *,
    live: bool = True,
    writers: Sequence[str] = RECORDED,
    stop: threading.Event | None = None,
    poll_s: float = 0.02,
) -> Iterator[Delivery]:
    """Yield what a store holds and, while ``live``, what is being added to it.

    Without ``cursor`` it begins with the oldest row, or ``lookback_s`` before the newest one.
    With ``cursor`` it goes on there; ``lookback_s`` then repeats the rows of that many seconds
    before it (``cursor.writers[w].has_read(run, seq, item)`` tells them), so that windows can be
    filled again. A cursor of another store starts anew, which a Gap says. ``items`` are names;
    None means all. Each delivery carries the cursor that is right once it has been used.

    Raises UsageError when there is no store at ``where``.
    """
    store = open_store(store_path(where))
    stop = stop or threading.Event()
    known = cursor if cursor is not None and cursor.store_id == store.id else None
    if cursor is not None and known is None:
        yield Gap("", 0, 0, 0, f"the cursor is of another store ({cursor.store_id}): starting anew")
    tails: dict[str, WriterTail] = {}
    floor = known.writers if known else {}
    while True:
        for writer in (w for w in store.writers() if w in writers and w not in tails):
            start = position_at(store, writer, floor.get(writer), lookback_s)
            tails[writer] = WriterTail(store, writer, items, start)
        moved = False
        for writer, tail in tails.items():
            for delivery in tail.step():
                moved = True
                at = {w: t.position() for w, t in tails.items()}
                at[writer] = delivery.cursor.writers[writer]
                here = {w: _not_before(position, floor.get(w)) for w, position in at.items()}
                yield replace(delivery, cursor=Cursor(store.id, {**floor, **here}))
        if not moved and (not live or stop.wait(poll_s)):
            return


def _not_before(position: WriterCursor, floor: WriterCursor | None) -> WriterCursor:
    """Keep the cursor where it was while a look back repeats rows before it."""
    if floor is None or (position.run, position.seq) > (floor.run, floor.seq):
        return position
    if (position.run, position.seq) < (floor.run, floor.seq):
        return floor
    ahead = {**position.ahead}
    for item, seq in floor.ahead.items():
        ahead[item] = max(seq, ahead.get(item, 0))
    return WriterCursor(floor.run, floor.seq, ahead)
