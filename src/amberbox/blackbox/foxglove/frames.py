"""Frames of a time range: messages as they came, or rows as JSON, in order of receipt."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

import numpy as np

from amberbox.blackbox.exporting.jsonrows import json_rows, json_topic
from amberbox.blackbox.exporting.looking import Looking
from amberbox.blackbox.exporting.messages import MessageStream, latched_before, without_originals
from amberbox.blackbox.exporting.report import ExportReport
from amberbox.blackbox.exporting.tables import TableStream, table_streams
from amberbox.blackbox.exporting.view import View, Window, chosen_items
from amberbox.blackbox.foxglove.server import Frame
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.query.catalogue import Catalogue
from amberbox.blackbox.query.record import Record
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Topic


@dataclass
class MessageFrames:
    """The messages of a window as they came."""

    record: Record
    items: Sequence[str]
    window: Window

    def __post_init__(self) -> None:
        self.report = ExportReport(None, "messages")
        self.looking = Looking(self.record.path, self.report)
        view = View(items=self.items)
        self.chosen = MessageStream(self.looking.ask(lambda known: chosen_items(known, view)))
        for text in without_originals(self.looking.catalogue, self.chosen, self.window):
            self.report.miss(text)

    @cached_property
    def topics(self) -> list[Topic]:
        """The topics that there are."""
        return [stream.topic for stream in self.looking.ask(self.chosen.streams)]

    def latched(self, at_ns: int) -> list[Frame]:
        """Return what latched topics had said before a moment."""
        found = self.looking.ask(lambda known: latched_before(known, self.chosen, at_ns))
        return [Frame(stream.topic, at_ns, data) for stream, _, data in found]

    def read(self, from_ns: int) -> Iterator[Frame]:
        """Read on from a moment."""
        for block, _ in self.chosen.read(self.looking, (from_ns, self.window[1])):
            topics = [stream.topic for stream in block.streams]
            times, places = block.received_ns.tolist(), block.stream.tolist()
            for place, at_ns, data in zip(places, times, block.data, strict=True):
                yield Frame(topics[place], at_ns, data)


@dataclass
class ColumnFrames:
    """The rows of a window as JSON, one topic per table."""

    record: Record
    items: Sequence[str]
    window: Window

    def __post_init__(self) -> None:
        self.report = ExportReport(None, "columns")
        self.looking = Looking(self.record.path, self.report)
        view = View(items=self.items)
        self._streams = self.looking.ask(lambda known: table_streams(known, view))

    @cached_property
    def topics(self) -> list[Topic]:
        """One topic per table."""
        return [json_topic(stream) for stream in self._streams]

    def latched(self, at_ns: int) -> list[Frame]:
        """Return nothing: rows are not latched."""
        return []

    def read(self, from_ns: int) -> Iterator[Frame]:
        """Read on from a moment."""
        window = (from_ns, self.window[1])
        streams = [
            TableStream(stream.schema, stream.wanted, [window], stream.by)
            for stream in self._streams
        ]
        rows = [self._rows(s, t) for s, t in zip(streams, self.topics, strict=True)]
        return heapq.merge(*rows, key=attrgetter("received_ns"))

    def _rows(self, stream: TableStream, topic: Topic) -> Iterator[Frame]:
        for block in stream.blocks(self.looking):
            messages = (message for part in json_rows(block.table) for message in part)
            for at_ns, message in zip(block.received_ns.tolist(), messages, strict=True):
                yield Frame(topic, at_ns, message)


Frames = MessageFrames | ColumnFrames


def span_of(catalogue: Catalogue, window: Window) -> tuple[int, int]:
    """Return first and last moment of what a record holds in a window.

    Raises AmberboxError when there is nothing.
    """
    bounds = list(_bounds(catalogue))
    first = min((low for low, _ in bounds), default=None)
    last = max((high for _, high in bounds), default=None)
    if first is None or last is None:
        raise AmberboxError(f"nothing is recorded in {catalogue.store}", "record something first")
    start = first if window[0] is None else max(first, window[0])
    stop = last if window[1] is None else min(last, window[1])
    if start > stop:
        raise AmberboxError("nothing is recorded in this range", "choose --from and --to otherwise")
    return start, stop


def _bounds(catalogue: Catalogue) -> Iterator[tuple[int, int]]:
    for segments in catalogue.manifest.segments.values():
        yield from (segment.received_range_ns for segment in segments)
    for journal in catalogue.journals(skip=()):
        if journal.places:
            edges = np.array([journal.start_ns, journal.end_ns])
            low, high = ClockTable(journal.clock).received(edges).tolist()
            yield low, high
