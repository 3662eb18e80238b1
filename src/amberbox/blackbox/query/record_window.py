"""A part of a record, and when recorder and watcher ran in it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from amberbox.blackbox.query.record import Record
from amberbox.blackbox.retention.missions import RecordedMission
from amberbox.blackbox.store.catalogue import StoreCatalogue, query_catalogue
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.tail import RECORDED
from amberbox.core.clock import NS
from amberbox.core.contracts import Span
from amberbox.core.names import identifier
from amberbox.core.timestamps import format_time

DAY_NS = 86_400 * NS
WATCH = ("watch",)
_LATE_NS = 10 * NS


@dataclass(frozen=True)
class RecordWindow:
    """A record and the part of it that is read.

    ``is_given``: the user has named this part, so that it may be long.
    """

    record: Record
    from_ns: int | None = None
    to_ns: int | None = None

    @property
    def is_given(self) -> bool:
        """Return whether the user gave its beginning."""
        return self.from_ns is not None

    @cached_property
    def recorded(self) -> tuple[Span, ...]:
        """Return the runs of the recorder, nanoseconds."""
        return self._runs(RECORDED)

    @cached_property
    def watched(self) -> tuple[Span, ...]:
        """Return the runs of the watcher, nanoseconds."""
        return self._runs(WATCH)

    @cached_property
    def span(self) -> Span:
        """Return the span of the window, nanoseconds; empty for an empty record."""
        known = [*self.recorded, *self.watched]
        first = min((run[0] for run in known), default=0)
        last = max((run[1] for run in known), default=0)
        since = first if self.from_ns is None else max(first, self.from_ns)
        return since, last if self.to_ns is None else min(last, self.to_ns)

    def cut(self, span: Span | None) -> Span:
        """Return the part of a span within the window."""
        first, last = self.span
        return (first, last) if span is None else (max(span[0], first), min(span[1], last))

    def read_time(self, text: str) -> int:
        """Read a time as ``--from`` does."""
        found = self.record.time_ns(text)
        assert found is not None  # a text is always a time, or an error
        return found

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        """Yield the rows that the box itself wrote on a channel, with the time ``received``."""
        item = identifier(topic)
        if not self.record.has_item(item):
            return ()
        return self.record.query(item, ["received", *names], *span).rows()

    def missions(self) -> list[RecordedMission]:
        """Return all missions of the record."""
        return self.record.missions()

    def _runs(self, writers: Collection[str]) -> tuple[Span, ...]:
        return tuple(
            query_catalogue(
                self.record.path,
                lambda catalogue: _spans(catalogue, writers),
                with_segments=can_build(),
            )
        )


def _spans(catalogue: StoreCatalogue, writers: Collection[str]) -> list[Span]:
    """Return when each run of some writers began and ended, in order of time."""
    found: dict[int, Span] = {}
    for run, first, last in _files(catalogue, writers):
        known = found.get(run, (first, last))
        found[run] = min(known[0], first), max(known[1], last)
    return sorted((first, last + 1) for first, last in found.values())


def _files(catalogue: StoreCatalogue, writers: Collection[str]) -> Iterator[tuple[int, int, int]]:
    book = catalogue.book
    for done in catalogue.manifest.journals.values():
        if done.writer in writers:
            first, last = (book.known_now_ns(done.run, t) for t in (done.start_ns, done.end_ns))
            yield done.run, first, last
    for journal in catalogue.journals(skip=catalogue.manifest.journals.keys()):
        if journal.writer in writers and journal.rows:
            logged = np.array([journal.start_ns, journal.end_ns], np.int64)
            first, last = ClockTable(journal.clock).received(logged).tolist()
            yield journal.run, first, last


def event_time_ns(at_ns: int, received_ns: int) -> int:
    """Return when something was that was written down soon after, by clocks as known now."""
    return at_ns if 0 <= received_ns - at_ns < _LATE_NS else received_ns


def join_spans(spans: Iterable[Span]) -> list[Span]:
    """Join spans that touch; they have to be in order."""
    found: list[Span] = []
    for first, last in spans:
        if found and found[-1][1] >= first:
            found[-1] = found[-1][0], max(found[-1][1], last)
        else:
            found.append((first, last))
    return found


def in_words(span: Sequence[int]) -> str:
    """Write a span as people read it."""
    return f"{format_time(span[0])[:23]}Z to {format_time(span[1])[:23]}Z"
