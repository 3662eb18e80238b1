"""Rows of one chunk: by item, by type, and what the box itself says among them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import msgspec
import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.core.types import Gap, IntArray


def by_item(
    chunk: Chunk, streams: Any, items: Collection[str] | None
) -> list[tuple[str, IntArray]]:
    """Group rows by item, in the order of their first row."""
    rows: dict[str, list[IntArray]] = {}
    numbers, firsts = np.unique(chunk.channel, return_index=True)
    for number in numbers[np.argsort(firsts)].tolist():
        stream = streams[number]
        if not stream.repeated and (items is None or stream.item in items):
            rows.setdefault(stream.item, []).append(chunk.rows_of(number))
    return [(item, np.sort(np.concatenate(parts))) for item, parts in rows.items()]


def runs_of_channel(rows: IntArray, chunk: Chunk) -> list[IntArray]:
    """Split rows where the type of their messages changes."""
    if not len(rows):
        return []
    channel = chunk.channel[rows]
    return np.split(rows, np.flatnonzero(channel[1:] != channel[:-1]) + 1)


def own_messages(chunk: Chunk, streams: Any, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
    """Give the records of one of the box's own channels, each with its log time."""
    for number in np.unique(chunk.channel).tolist():
        if streams[number].topic.name == topic:
            rows = chunk.rows_of(number)
            for log_ns, message in zip(
                chunk.log_ns[rows].tolist(), chunk.messages(rows), strict=True
            ):
                yield log_ns, msgspec.json.decode(message)


def clock_points(chunk: Chunk, streams: Any) -> list[tuple[int, int]]:
    """Return what a chunk says of the clock: log times and offsets."""
    found = own_messages(chunk, streams, reserved.CLOCK)
    return [(log_ns, int(values["offset_ns"])) for log_ns, values in found]


def gap_records(
    chunk: Chunk, streams: Any, writer: str, run: int, clock: ClockTable
) -> Iterator[Gap]:
    """Turn closed gap records of the recorder into gaps."""
    for _, values in own_messages(chunk, streams, reserved.GAP):
        if values.get("to_ns") is not None:
            times = clock.received(np.array([values["from_ns"], values["to_ns"]])).tolist()
            yield Gap(
                writer, run, times[0], times[1], values["reason"], values["item"],
                values.get("count"),
            )  # fmt: skip
