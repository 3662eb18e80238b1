"""A record in order of time: what live and replay are evaluated from, with the same code.

Journals of different writers come together epoch by epoch, and each block says up to when all of
them are complete. Only as much is read ahead as keeps them side by side.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.journal.head import Head, read_head
from amberbox.blackbox.store import Store, is_locked
from amberbox.core.clock import NS
from amberbox.core.types import Batch, WriterCursor
from amberbox.monitoring.watcher.epoch import Epoch
from amberbox.monitoring.watcher.start import WATCH, comes_later
from amberbox.monitoring.watcher.stream import Piece, WriterStream

_MAIN = "main"
_SPAN_NS = NS
"""While there is more to be read blocks are at least this long: each has its price."""

Positions: TypeAlias = Mapping[str, WriterCursor]


@dataclass(frozen=True, slots=True)
class Block:
    """Rows of one epoch; then everything up to ``until_ns`` (log time) has come.

    ``batches`` may reach further. Times of an item never decrease from batch to batch.
    """

    epoch: Epoch
    start_ns: int
    """When the reading of this epoch began."""
    batches: list[Batch]
    until_ns: int
    is_last: bool = False
    """The epoch ends with it."""


class Reader:
    """Reads items of a store from positions on; ``step`` gives what is there now.

    ``probes`` are the items that the watcher itself has written.
    """

    def __init__(
        self,
        store: Store,
        items: Collection[str],
        probes: Collection[str] = (),
        start: Positions | None = None,
    ) -> None:
        self._store = store
        self._items = {**dict.fromkeys(RECORDED, frozenset(items)), WATCH: frozenset(probes)}
        self._start = start or {}
        self._given: dict[str, WriterCursor] = {}
        self._streams: dict[str, WriterStream] = {}
        self._waiting: dict[str, Piece] = {}
        self._reached: dict[str, int] = {}
        self._counted_ns: int | None = None
        self._start_ns = 0
        self._batches: list[Batch] = []
        self._later: dict[Epoch, bool] = {}
        self._alive: bool | None = None
        self._written: tuple[int, int] | None = None
        self.epoch: Epoch | None = None
        self.until_ns: int | None = None

    @property
    def is_recording(self) -> bool:
        """Tell whether somebody was writing the record when it was read last."""
        return bool(self._alive)

    def positions(self) -> dict[str, WriterCursor]:
        """Where the rows of the present epoch end that were given so far, in each journal."""
        return {**self._start, **self._given}

    def last_ns(self) -> int:
        """Log time of the newest row that was read of the present epoch."""
        return max(self._reached.values(), default=0)

    def step(self) -> Iterator[Block]:
        """Read on to what is written now, block by block."""
        alive = is_locked(self._store, _MAIN)
        head = read_head(self._store.folder(_MAIN))  # before the journals: never too much
        if alive and head is None:
            return
        self._written = _end_of(head) if alive else None
        self._begin(at_once=alive != self._alive)
        self._alive = alive
        self._release()
        yield from self._go_on()
        while (stream := self._behind()) is not None:
            piece = stream.pull()
            if piece is not None:
                self._sort_in(stream.writer, piece)
            yield from self._go_on()
        if self.epoch is not None:
            yield from self._block(self._complete_ns() if alive else self._end_ns())

    def _begin(self, *, at_once: bool) -> None:
        for writer, items in self._items.items():
            known = self._streams.get(writer)
            if known is None and items and self._store.folder(writer).is_dir():
                start = self._start.get(writer, WriterCursor())
                known = self._streams[writer] = WriterStream(self._store, writer, items, start)
                known.begin(at_once=True)
            elif known is not None:
                known.begin(at_once=at_once)

    def _behind(self) -> WriterStream | None:
        """Choose who is to be read next: who is furthest behind, the recorder's main journal last.

        None when all have given what there is, or wait for another epoch.
        """
        free = {
            writer: stream
            for writer, stream in self._streams.items()
            if not stream.drained and writer not in self._waiting
        }
        main = free.pop(_MAIN, None)
        main_ns = None if main is None else self._reached.get(_MAIN, -1)
        for writer, stream in free.items():
            if self.epoch is None and main is not None:
                break
            if main_ns is None or self._reached.get(writer, -1) < main_ns:
                return stream
        return main

    def _go_on(self) -> Iterator[Block]:
        """Give what has become complete, and go over to the next epoch when this one is."""
        while self._waits_for_next():
            yield from self._next_epoch()
        until_ns = self._complete_ns()
        if until_ns is not None and until_ns - (self.until_ns or 0) >= _SPAN_NS:
            yield from self._block(until_ns)

    def _sort_in(self, writer: str, piece: Piece) -> None:
        """Take a piece, or keep it for the epoch that it belongs to."""
        if writer == _MAIN and self.epoch is None and self._is_written(piece):
            self.epoch, self._start_ns = piece.epoch, piece.first_ns
        if self._is_past(piece):
            return
        if piece.epoch != self.epoch or (writer == _MAIN and not self._is_written(piece)):
            self._waiting[writer] = piece
        else:
            self._accept(writer, piece)

    def _is_past(self, piece: Piece) -> bool:
        epoch = self.epoch
        if epoch is None or piece.epoch == epoch:
            return False
        if piece.epoch not in self._later:
            self._later[piece.epoch] = comes_later(self._store, piece.epoch, epoch)
        return not self._later[piece.epoch]

    def _is_written(self, piece: Piece) -> bool:
        """Tell whether all that was written together with a piece can be read."""
        return self._written is None or piece.end <= self._written

    def _accept(self, writer: str, piece: Piece) -> None:
        self._batches += piece.batches
        self._given[writer] = WriterCursor(*piece.end)
        self._reached[writer] = max(piece.last_ns, self._reached.get(writer, piece.last_ns))
        if writer == _MAIN and piece.counted_ns is not None:
            self._counted_ns = piece.counted_ns

    def _complete_ns(self) -> int | None:
        """Return up to when the rows of all writers have come; None if nobody knows."""
        if self._counted_ns is None:
            return None
        others = [
            self._reached.get(writer, -1)
            for writer, stream in self._streams.items()
            if writer != _MAIN and not stream.drained and writer not in self._waiting
        ]
        return min([self._counted_ns, *others]) - 1

    def _end_ns(self) -> int | None:
        last_ns = self._reached.get(_MAIN)
        return None if last_ns is None else last_ns - 1

    def _block(self, until_ns: int | None, *, is_last: bool = False) -> Iterator[Block]:
        assert self.epoch is not None
        ahead = until_ns is not None and (self.until_ns is None or until_ns > self.until_ns)
        if ahead or (is_last and self.until_ns is not None):
            self.until_ns = until_ns if ahead else self.until_ns
            assert self.until_ns is not None
            batches, self._batches = self._batches, []
            yield Block(self.epoch, self._start_ns, batches, self.until_ns, is_last)

    def _waits_for_next(self) -> bool:
        """Tell whether the recorder has gone on to another epoch, and the others as well."""
        piece = self._waiting.get(_MAIN)
        if piece is None or piece.epoch == self.epoch or not self._is_written(piece):
            return False
        return all(
            stream.drained or writer in self._waiting for writer, stream in self._streams.items()
        )

    def _next_epoch(self) -> Iterator[Block]:
        """End the epoch, and go over to the one that the recorder is in."""
        yield from self._block(self._end_ns(), is_last=True)
        self._later.clear()
        first = self._waiting[_MAIN]
        self.epoch, self._start_ns = first.epoch, first.first_ns
        self.until_ns = self._counted_ns = None
        self._batches, self._reached = [], {}
        self._release()

    def _release(self) -> None:
        """Look again at the pieces that were kept, the main journal's first."""
        kept, self._waiting = self._waiting, {}
        for writer in sorted(kept, key=lambda name: name != _MAIN):
            self._sort_in(writer, kept[writer])


def _end_of(head: Head | None) -> tuple[int, int] | None:
    return None if head is None else (head.run, head.next_seq)
