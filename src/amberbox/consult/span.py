"""Which part of a record rules may look into, and when something was written at all."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.missions import Mission
from amberbox.blackbox.query.catalogue import Catalogue, ask
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.segments.build import can_build
from amberbox.core.clock import NS
from amberbox.core.names import identifier
from amberbox.core.timetext import format_time
from amberbox.diagnosis.rules.intervals import Span

DAY_NS = 86_400 * NS
WATCH = ("watch",)
_LATE_NS = 10 * NS


@dataclass(frozen=True)
class Window:
    """A record and the part of it that is looked at.

    ``is_given``: somebody asked for this part, so that it may be long.
    """

    record: Record
    from_ns: int | None = None
    to_ns: int | None = None

    @property
    def is_given(self) -> bool:
        """Tell whether somebody has said where it begins."""
        return self.from_ns is not None

    @cached_property
    def recorded(self) -> tuple[Span, ...]:
        """From when to when the recorder ran, run by run."""
        return self._runs(RECORDED)

    @cached_property
    def watched(self) -> tuple[Span, ...]:
        """From when to when the watcher ran, run by run."""
        return self._runs(WATCH)

    @cached_property
    def span(self) -> Span:
        """All of it; nothing of an empty record."""
        known = [*self.recorded, *self.watched]
        first = min((run[0] for run in known), default=0)
        last = max((run[1] for run in known), default=0)
        since = first if self.from_ns is None else max(first, self.from_ns)
        return since, last if self.to_ns is None else min(last, self.to_ns)

    def cut(self, span: Span | None) -> Span:
        """Return the part of a span that is looked at."""
        first, last = self.span
        return (first, last) if span is None else (max(span[0], first), min(span[1], last))

    def read_time(self, text: str) -> int:
        """Read a time as ``--from`` does."""
        found = self.record.time_ns(text)
        assert found is not None  # a text is always a time, or an error
        return found

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        """Yield what the box itself wrote on a channel, with when it was ``received``."""
        item = identifier(topic)
        if not has_item(self.record, item):
            return ()
        return self.record.query(item, ["received", *names], *span).rows()

    def missions(self) -> list[Mission]:
        """Return all missions of the record."""
        return self.record.missions()

    def _runs(self, writers: Collection[str]) -> tuple[Span, ...]:
        return tuple(ask(self.record.path, _of(writers), with_segments=can_build()))


def has_item(record: Record, item: str) -> bool:
    """Tell whether a record has rows of an item."""
    return ask(record.path, lambda c: item in c.schemas, with_segments=can_build())


def _of(writers: Collection[str]) -> Callable[[Catalogue], list[Span]]:
    return lambda catalogue: _spans(catalogue, writers)


def _spans(catalogue: Catalogue, writers: Collection[str]) -> list[Span]:
    """Return when each run of some writers began and ended, in order of time."""
    found: dict[int, Span] = {}
    for run, first, last in _files(catalogue, writers):
        known = found.get(run, (first, last))
        found[run] = min(known[0], first), max(known[1], last)
    return sorted((first, last + 1) for first, last in found.values())


def _files(catalogue: Catalogue, writers: Collection[str]) -> Iterator[tuple[int, int, int]]:
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


def happened_ns(at_ns: int, received_ns: int) -> int:
    """Return when something was that was written down soon after, by clocks as known now."""
    return at_ns if 0 <= received_ns - at_ns < _LATE_NS else received_ns


def joined(spans: Iterable[Span]) -> list[Span]:
    """Join spans that touch; they come in order."""
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
