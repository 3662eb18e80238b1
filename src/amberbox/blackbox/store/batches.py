"""Batches: messages of one stream, unrolled, with the times and positions they carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from amberbox.blackbox.columns import Unroller, UnrollError
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.mcap import McapChannel
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.core.errors import AmberboxError
from amberbox.core.names import child_name, identifier, is_item, item_name, shortened
from amberbox.core.types import Batch, Gap, IntArray, Rows, Schema, Topic

# The reason of a gap of messages that do not fit their definition begins so
UNDECODABLE = "undecodable: "


@dataclass(frozen=True, slots=True)
class ItemStream:
    """One channel of one file: its item, and the unroller of its messages."""

    item: str
    topic: Topic
    source: str = ""
    repeated: bool = False
    stamp: str | None = None

    def unroller(self) -> Unroller:
        """Return the compiled unroller, shared by all streams of the same definition."""
        return _unroller(self.topic, self.stamp)


@lru_cache(maxsize=512)
def _unroller(topic: Topic, stamp: str | None) -> Unroller:
    if topic.schema is None and topic.name in channels.names():
        topic = replace(topic, schema=channels.schema_of(topic.name))
    return unroller(topic, stamp)


def stream_of(channel: McapChannel, schemas: Mapping[int, Schema]) -> ItemStream:
    """Return the stream of a channel: by its metadata in our journals, else by its topic.

    An item stated by a foreign file is brought into the form of an item name: items
    are names of folders, files and views.
    """
    marks = channel.metadata
    topic = Topic(
        channel.topic,
        channel.message_encoding,
        schemas.get(channel.schema_id),
        latched=marks.get("latched") == "1",
    )
    source = marks.get("source", "mcap")
    stated = marks.get("item")
    if stated and not is_item(stated):
        stated = shortened(identifier(stated))
    item = stated or item_name(source, channel.topic)
    return ItemStream(item, topic, source, marks.get("repeated") == "1", marks.get("stamp"))


@dataclass(frozen=True, slots=True)
class BatchOrigin:
    """Where messages come from: whose run, which stream, and how its log time is corrected."""

    writer: str
    run: int
    stream: ItemStream
    clock: ClockTable


@dataclass(frozen=True, slots=True)
class BatchResult:
    """A batch, if any message could be decoded, and the messages that could not."""

    batch: Batch | None
    gaps: Sequence[Gap] = ()


def make_batch(
    origin: BatchOrigin, seq: IntArray, log_ns: IntArray, messages: Sequence[bytes]
) -> BatchResult:
    """Unroll messages of one stream; those that do not decode are left out and named."""
    stream = origin.stream
    try:
        rows = stream.unroller().rows(messages)
    except UnrollError as error:
        return _without_bad(origin, seq, log_ns, messages, error)
    except AmberboxError as error:  # no definition, or one that cannot be read: raw is kept
        return BatchResult(None, [_undecodable(origin, seq, log_ns, error.what)])
    except MemoryError:
        raise
    except Exception as error:  # messages come from anybody, and fail in any way that bytes can
        why = f"{type(error).__name__}: {error}"[:300]
        return BatchResult(None, [_undecodable(origin, seq, log_ns, why)])
    received = origin.clock.received(log_ns)
    stamp = received if rows.stamp_ns is None else np.where(rows.stamp_ns, rows.stamp_ns, received)
    batch = Batch(
        item=stream.item,
        schema=stream.unroller().schema,
        writer=origin.writer,
        run=origin.run,
        seq=seq,
        log_time_ns=log_ns,
        received_ns=received,
        timestamp_ns=stamp,
        columns=rows.columns,
        topic=stream.topic.name,
        source=stream.source,
        encoding=stream.topic.message_encoding,
    )
    if not rows.children:
        return BatchResult(batch)
    message = np.arange(rows.count)
    return BatchResult(replace(batch, children=_children(batch, batch, rows, message, None)))


def _without_bad(
    origin: BatchOrigin,
    seq: IntArray,
    log_ns: IntArray,
    messages: Sequence[bytes],
    error: UnrollError,
) -> BatchResult:
    bad = np.array(error.bad, np.int64)
    good = np.setdiff1d(np.arange(len(messages)), bad)
    reason = f"messages do not fit the definition of {error.type_name}"
    in_a_row = np.split(bad, np.flatnonzero(np.diff(bad) > 1) + 1)
    gaps = [_undecodable(origin, seq[rows], log_ns[rows], reason) for rows in in_a_row]
    if not len(good):
        return BatchResult(None, gaps)
    rest = [messages[row] for row in good.tolist()]
    made = make_batch(origin, seq[good], log_ns[good], rest)
    return BatchResult(made.batch, [*gaps, *made.gaps])


def _undecodable(origin: BatchOrigin, seq: IntArray, log_ns: IntArray, why: str) -> Gap:
    from_ns, to_ns = origin.clock.received(log_ns[[0, -1]]).tolist()
    return Gap(
        origin.writer,
        origin.run,
        from_ns,
        to_ns + 1,
        f"{UNDECODABLE}{why}",
        origin.stream.item,
        len(seq),
        int(seq[0]),
        int(seq[-1]) + 1,
    )


def _children(
    whole: Batch, parent: Batch, rows: Rows, message: IntArray, number: IntArray | None
) -> dict[str, Batch]:
    """Build the child tables of a table whose rows belong to these messages of the whole batch."""
    return {
        path: _child(whole, parent, path, child, message, number)
        for path, child in rows.children.items()
    }


def _child(
    whole: Batch,
    parent: Batch,
    path: str,
    rows: Rows,
    parent_message: IntArray,
    parent_number: IntArray | None,
) -> Batch:
    """Build a child table: each row has its message, its place, and the row above it."""
    assert rows.parent_row is not None
    assert rows.index is not None
    message = parent_message[rows.parent_row]
    keys: dict[str, Any] = {"parent_seq": whole.seq[message], "index": rows.index}
    if parent_number is not None:
        keys["parent_index"] = parent_number[rows.parent_row]
    child = replace(
        whole,
        item=child_name(parent.item, path),
        schema=parent.schema.children[path],
        seq=whole.seq[message],
        log_time_ns=whole.log_time_ns[message],
        received_ns=whole.received_ns[message],
        timestamp_ns=whole.timestamp_ns[message],
        columns={**keys, **rows.columns},
    )
    if not rows.children:
        return child
    number = _number_within(message)
    return replace(child, children=_children(whole, child, rows, message, number))


def _number_within(message: IntArray) -> IntArray:
    """Count the rows of each message from 0."""
    if not len(message):
        return message
    starts = np.flatnonzero(np.concatenate(([True], message[1:] != message[:-1])))
    lengths = np.diff(np.append(starts, len(message)))
    counted: IntArray = np.arange(len(message)) - np.repeat(starts, lengths)
    return counted
