"""Bytes of a batch by the places a walk found: of messages that lie alike, or one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.unroll.walk import Slots
from amberbox.core.types import IntArray

Bytes: TypeAlias = NDArray[np.uint8]
Objects: TypeAlias = NDArray[np.object_]


class Pieces(NamedTuple):
    """Pieces of fixed size in a buffer: ``rows`` of them, from ``offset``, ``stride`` apart."""

    buffer: Any
    offset: int
    stride: int
    rows: int


class Places(Protocol):
    """Where the fields of a batch lie; slots are those of the walk's plan."""

    @property
    def big_endian(self) -> bool:
        """Tell the byte order of the numbers."""

    def pieces(self, slot: int, size: int) -> Pieces:
        """Give the pieces of ``size`` bytes that start at the places in a slot."""

    def offsets(self, slot: int) -> IntArray:
        """Add up the counts recorded in a slot, for the whole batch, from 0."""

    def spans(self, starts: int, counts: int, width: int) -> Bytes:
        """Copy sequences of ``width`` byte items one after the other."""

    def blobs(self, starts: int, counts: int) -> list[bytes]:
        """Cut out byte sequences, each on its own."""

    def texts(self, starts: int, ends: int, wide: bool) -> Objects:
        """Decode strings."""


def decode_text(data: bytes, wide: bool, big_endian: bool) -> str:
    """Decode UTF-8, or UTF-16 units of 4 bytes; what is invalid becomes U+FFFD."""
    if not wide:
        return data.decode("utf-8", "replace")
    units = np.frombuffer(data, ">u4" if big_endian else "<u4").astype("<u2")
    return units.tobytes().decode("utf-16-le", "replace")


def objects(values: Sequence[object]) -> Objects:
    """Make an object array of strings or bytes."""
    array = np.empty(len(values), object)
    array[:] = values
    return array


def _gather(data: bytes, places: IntArray, size: int) -> Bytes:
    """Copy ``size`` bytes from each place, one piece after the other."""
    if not len(places) or not size:
        return np.empty(0, np.uint8)
    pieces = np.ndarray((len(data) - size + 1,), f"V{size}", data, 0, (1,))
    return pieces[places].view(np.uint8)


def _join_spans(data: bytes, starts: IntArray, counts: IntArray, width: int) -> Bytes:
    if len(counts) and (counts == counts[0]).all():
        return _gather(data, starts, int(counts[0]) * width)
    ends = (starts + counts * width).tolist()
    parts = [data[start:end] for start, end in zip(starts.tolist(), ends, strict=True)]
    return np.frombuffer(bytearray().join(parts), np.uint8)


@dataclass(frozen=True, slots=True)
class Scattered:
    """Every field of every message at a place of its own."""

    data: bytes
    slots: Slots
    big_endian: bool

    def pieces(self, slot: int, size: int) -> Pieces:
        places = np.array(self.slots[slot], np.int64)
        return Pieces(_gather(self.data, places, size), 0, size, len(places))

    def offsets(self, slot: int) -> IntArray:
        return _offsets(np.array(self.slots[slot], np.int64))

    def spans(self, starts: int, counts: int, width: int) -> Bytes:
        places = np.array([self.slots[starts], self.slots[counts]], np.int64)
        return _join_spans(self.data, places[0], places[1], width)

    def blobs(self, starts: int, counts: int) -> list[bytes]:
        places = zip(self.slots[starts], self.slots[counts], strict=True)
        return [self.data[start : start + count] for start, count in places]

    def texts(self, starts: int, ends: int, wide: bool) -> Objects:
        places = list(zip(self.slots[starts], self.slots[ends], strict=True))
        if wide or len(self.data) > 256 * len(places):
            data, big = self.data, self.big_endian
            return objects([decode_text(data[start:end], wide, big) for start, end in places])
        # one byte is one character in Latin-1: cutting text is twice as fast as decoding cuts
        text = self.data.decode("latin-1")
        cuts = [text[start:end] for start, end in places]
        if not all(map(str.isascii, cuts)):
            cuts = [cut.encode("latin-1").decode("utf-8", "replace") for cut in cuts]
        return objects(cuts)


def _offsets(counts: IntArray) -> IntArray:
    offsets = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    return offsets


@dataclass(frozen=True, slots=True)
class Evenly:
    """``count`` messages of ``size`` bytes that all lie like the one whose slots these are.

    ``texts_of_all`` are the strings of each slot of starts, when all messages say the same.
    """

    data: bytes
    size: int
    count: int
    slots: Slots
    big_endian: bool
    texts_of_all: Mapping[int, Objects] | None = None

    def pieces(self, slot: int, size: int) -> Pieces:
        places = self.slots[slot]
        if len(places) == 1:
            return Pieces(self.data, places[0], self.size, self.count)
        everywhere = self._spread(slot)
        return Pieces(_gather(self.data, everywhere, size), 0, size, len(everywhere))

    def offsets(self, slot: int) -> IntArray:
        counts = self.slots[slot]
        if len(counts) == 1:
            return np.arange(self.count + 1, dtype=np.int64) * counts[0]
        return _offsets(self._repeat(slot))

    def spans(self, starts: int, counts: int, width: int) -> Bytes:
        if len(self.slots[starts]) != 1:
            return _join_spans(self.data, self._spread(starts), self._repeat(counts), width)
        start, length = self.slots[starts][0], self.slots[counts][0] * width
        return self._block(start, length).copy().reshape(-1)

    def blobs(self, starts: int, counts: int) -> list[bytes]:
        places = zip(self._spread(starts).tolist(), self._repeat(counts).tolist(), strict=True)
        return [self.data[start : start + count] for start, count in places]

    def texts(self, starts: int, ends: int, wide: bool) -> Objects:
        if self.texts_of_all is not None:
            return self._same(self.texts_of_all[starts])
        places = list(zip(self.slots[starts], self.slots[ends], strict=True))
        table = np.empty((self.count, len(places)), object)
        for column, (start, end) in enumerate(places):
            table[:, column] = self._column(start, end, wide)
        return table.reshape(-1)

    def _same(self, once: Objects) -> Objects:
        if len(once) != 1:
            return np.tile(once, self.count)
        texts = np.empty(self.count, object)
        texts.fill(once[0])
        return texts

    def _column(self, start: int, end: int, wide: bool) -> str | list[str]:
        if self._constant(start, end):
            return self._text(0, start, end, wide)
        return [self._text(message, start, end, wide) for message in range(self.count)]

    def _text(self, message: int, start: int, end: int, wide: bool) -> str:
        base = message * self.size
        return decode_text(self.data[base + start : base + end], wide, self.big_endian)

    def _constant(self, start: int, end: int) -> bool:
        block = self._block(start, end - start)
        return bool((block == block[0]).all())

    def _block(self, start: int, length: int) -> Bytes:
        """View the same bytes of all messages, one row each."""
        if not length:
            return np.empty((self.count, 0), np.uint8)
        return np.ndarray((self.count, length), np.uint8, self.data, start, (self.size, 1))

    def _repeat(self, slot: int) -> IntArray:
        """Give the numbers in a slot for all messages."""
        return np.tile(np.array(self.slots[slot], np.int64), self.count)

    def _spread(self, slot: int) -> IntArray:
        """Give the places in a slot for all messages."""
        bases = np.arange(self.count, dtype=np.int64) * self.size
        return np.add.outer(bases, np.array(self.slots[slot], np.int64)).reshape(-1)
