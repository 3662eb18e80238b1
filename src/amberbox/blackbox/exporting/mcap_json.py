"""MCAP files with flat columns as JSON, for tools that do not know the types."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TypeAlias

import numpy as np

from amberbox.blackbox.exporting.job import Job, new_file, size_of
from amberbox.blackbox.exporting.jsonrows import json_rows, json_topic
from amberbox.blackbox.exporting.mcapfile import McapFile
from amberbox.blackbox.exporting.tablefiles import streams_of
from amberbox.blackbox.exporting.tables import TableStream
from amberbox.blackbox.journal.frame import Rows

Row: TypeAlias = tuple[int, int, int, int, bytes]
"""Time of receipt, channel, number of the row, timestamp, message."""

_TOGETHER = 4000


@dataclass
class _Done:
    """How much of each table is written."""

    job: Job
    parts: list[float]

    def tell(self, number: int, done: float) -> None:
        self.parts[number] = done
        self.job.progress(sum(self.parts) / len(self.parts))


def write_mcap_json(job: Job) -> None:
    """Write one MCAP file: a channel per table, rows of all tables in order of receipt."""
    streams = streams_of(job)
    done = _Done(job, [0.0] * len(streams))
    with new_file(job.path) as part, part.open("wb") as file:
        output = McapFile(file, "")
        for stream in streams:
            schema = stream.schema
            output.channel(json_topic(stream), {"item": schema.item, "source": schema.source})
            job.report.add(schema.item, 0)
        sources = [_rows(job, stream, number, done) for number, stream in enumerate(streams)]
        for block in _together(heapq.merge(*sources, key=itemgetter(0, 1))):
            output.write(_packed(block))
        output.close()
    job.report.bytes = size_of(job.path)
    job.progress(1.0)


def _rows(job: Job, stream: TableStream, number: int, done: _Done) -> Iterator[Row]:
    count = 0
    for block in stream.blocks(job.looking):
        stamps = block.timestamp_ns.tolist()
        received = block.received_ns.tolist()
        messages = (message for part in json_rows(block.table) for message in part)
        for at_ns, stamp_ns, message in zip(received, stamps, messages, strict=True):
            yield at_ns, number, count, stamp_ns, message
            count += 1
        job.report.add(stream.schema.item, len(block.table))
        done.tell(number, block.done)


def _together(rows: Iterator[Row]) -> Iterator[list[Row]]:
    block: list[Row] = []
    for row in rows:
        block.append(row)
        if len(block) == _TOGETHER:
            yield block
            block = []
    if block:
        yield block


def _packed(block: Sequence[Row]) -> Rows:
    received, channels, numbers, stamps, messages = zip(*block, strict=True)
    return Rows(
        np.array(channels, np.uint16),
        np.array(numbers),
        np.array(received),
        np.array(stamps),
        messages,
    )
