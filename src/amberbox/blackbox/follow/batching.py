"""Batches: messages of one stream, unrolled, with the times and positions they carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.journal.mcap import Channel
from amberbox.blackbox.unroll import Unroller, UnrollError, unroller
from amberbox.core.errors import AmberboxError
from amberbox.core.names import identifier, item_name
from amberbox.core.types import Batch, Gap, IntArray, ItemSchema, Rows, Schema, Topic


@dataclass(frozen=True, slots=True)
class Stream:
    """One channel of one file: what item it belongs to and how its messages unroll."""

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
    if topic.schema is None and topic.name in reserved.names():
        topic = replace(topic, schema=reserved.schema_of(topic.name))
    return unroller(topic, stamp)


def stream_of(channel: Channel, schemas: Mapping[int, Schema]) -> Stream:
    """Say what a channel is: by its metadata in journals of ours, else by its topic."""
    marks = channel.metadata
    topic = Topic(
        channel.topic,
        channel.message_encoding,
        schemas.get(channel.schema_id),
        latched=marks.get("latched") == "1",
    )
    source = marks.get("source", "mcap")
    item = marks.get("item") or item_name(source, channel.topic)
    return Stream(item, topic, source, marks.get("repeated") == "1", marks.get("stamp"))


@dataclass(frozen=True, slots=True)
class Made:
    """A batch, if anything could be decoded, and what could not."""

    batch: Batch | None
    gaps: Sequence[Gap] = ()


def make_batch(
    writer: str,
    run: int,
    stream: Stream,
    seq: IntArray,
    log_ns: IntArray,
    messages: Sequence[bytes],
    clock: ClockTable,
) -> Made:
    """Unroll messages of one stream; those that do not decode are left out and named."""
    try:
        rows = stream.unroller().rows(messages)
    except UnrollError as error:
        return _without_bad(writer, run, stream, seq, log_ns, messages, clock, error)
    except AmberboxError as error:  # no definition, or one that nobody can read: raw is kept
        return Made(None, [_undecodable(writer, run, stream.item, seq, log_ns, error.what)])
    received = clock.received(log_ns)
    stamp = received if rows.stamp_ns is None else np.where(rows.stamp_ns, rows.stamp_ns, received)
    return Made(
        Batch(
            item=stream.item,
            schema=stream.unroller().schema,
            writer=writer,
            run=run,
            seq=seq,
            log_time_ns=log_ns,
            received_ns=received,
            timestamp_ns=stamp,
            columns=rows.columns,
            children=_children(stream, rows, writer, run, seq, log_ns, received, stamp),
            topic=stream.topic.name,
            source=stream.source,
        )
    )


def _without_bad(
    writer: str,
    run: int,
    stream: Stream,
    seq: IntArray,
    log_ns: IntArray,
    messages: Sequence[bytes],
    clock: ClockTable,
    error: UnrollError,
) -> Made:
    bad = np.array(error.bad, np.int64)
    good = np.setdiff1d(np.arange(len(messages)), bad)
    gaps = [
        _undecodable(
            writer, run, stream.item, seq[row : row + 1], log_ns[row : row + 1], error.what
        )
        for row in bad.tolist()
    ]
    if not len(good):
        return Made(None, gaps)
    rest = [messages[row] for row in good.tolist()]
    made = make_batch(writer, run, stream, seq[good], log_ns[good], rest, clock)
    return Made(made.batch, [*gaps, *made.gaps])


def _undecodable(
    writer: str, run: int, item: str, seq: IntArray, log_ns: IntArray, why: str
) -> Gap:
    return Gap(
        writer,
        run,
        int(log_ns[0]),
        int(log_ns[-1]) + 1,
        f"undecodable: {why}",
        item,
        len(seq),
        int(seq[0]),
        int(seq[-1]) + 1,
    )


def _children(
    stream: Stream,
    rows: Rows,
    writer: str,
    run: int,
    seq: IntArray,
    log_ns: IntArray,
    received: IntArray,
    stamp: IntArray,
) -> dict[str, Batch]:
    schemas = stream.unroller().schema.children
    message_row = np.arange(rows.count)
    return {
        path: _child(stream, f"{stream.item}__{identifier(path)}", schemas[path], child,
                     message_row, None, writer, run, seq, log_ns, received, stamp)
        for path, child in rows.children.items()
    }  # fmt: skip


def _child(
    stream: Stream,
    item: str,
    schema: ItemSchema,
    rows: Rows,
    parent_message: IntArray,
    parent_number: IntArray | None,
    writer: str,
    run: int,
    seq: IntArray,
    log_ns: IntArray,
    received: IntArray,
    stamp: IntArray,
) -> Batch:
    """Build a child table: each row knows its message, its place, and the row above it."""
    assert rows.parent_row is not None
    assert rows.index is not None
    message = parent_message[rows.parent_row]
    number = _number_within(message)
    keys: dict[str, Any] = {"parent_seq": seq[message], "index": rows.index}
    if parent_number is not None:
        keys["parent_index"] = parent_number[rows.parent_row]
    children = {
        path: _child(stream, f"{item}__{identifier(path)}", schema.children[path], child,
                     message, number, writer, run, seq, log_ns, received, stamp)
        for path, child in rows.children.items()
    }  # fmt: skip
    return Batch(
        item=item,
        schema=schema,
        writer=writer,
        run=run,
        seq=seq[message],
        log_time_ns=log_ns[message],
        received_ns=received[message],
        timestamp_ns=stamp[message],
        columns={**keys, **rows.columns},
        children=children,
        topic=stream.topic.name,
        source=stream.source,
    )


def _number_within(message: IntArray) -> IntArray:
    """Count the rows of each message from 0."""
    if not len(message):
        return message
    starts = np.flatnonzero(np.concatenate(([True], message[1:] != message[:-1])))
    lengths = np.diff(np.append(starts, len(message)))
    counted: IntArray = np.arange(len(message)) - np.repeat(starts, lengths)
    return counted
