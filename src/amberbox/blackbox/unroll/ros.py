"""ROS 1 and CDR messages as flat columns: by layout where messages lie alike, else one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from struct import Struct
from typing import Any

import numpy as np

from amberbox.blackbox.unroll.build import build_rows
from amberbox.blackbox.unroll.contract import UnrollError
from amberbox.blackbox.unroll.definition import SIZES, parse_definition
from amberbox.blackbox.unroll.fields import flatten
from amberbox.blackbox.unroll.layout import Group, LayoutCache, TooManyLayoutsError, is_big_endian
from amberbox.blackbox.unroll.places import Scattered
from amberbox.blackbox.unroll.rows import concat_rows, take_rows
from amberbox.blackbox.unroll.stamps import stamps_of_column
from amberbox.blackbox.unroll.walk import compile_walker, walk_all
from amberbox.blackbox.unroll.wire import FixedOp, Plan, plan
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, IntArray, ItemSchema, Rows, Schema

_LARGEST_JOIN = 16 << 20
_STAMP_TYPES = frozenset(SIZES) - {"bool", "duration"} | {"string"}
_NS = 1_000_000_000


class RosUnroller:
    """Unrolls messages of one ROS type.

    ``by_layout`` False never looks for layouts; the rows are the same either way.
    """

    def __init__(
        self, schema: Schema, cdr: bool, stamp: str | None = None, by_layout: bool = True
    ) -> None:
        table = flatten(parse_definition(schema), schema.name, not cdr)
        self._stamp = _stamp_column(table.schema, stamp)
        self.schema = replace(table.schema, stamp=self._stamp.path if self._stamp else "")
        self._plan = plan(table, cdr)
        self._walker = compile_walker(self._plan)
        self._layouts = LayoutCache(self._plan) if by_layout else None
        self._quick_stamp = _stamp_reader(self._plan, self._stamp)

    def rows(self, messages: Sequence[bytes]) -> Rows:
        """Unroll a batch of messages."""
        parts: list[Rows] = []
        bad: list[int] = []
        for first, portion, lengths in _portions(messages):
            rows, misfits = self._portion(portion, lengths)
            parts.append(rows)
            bad += [first + misfit for misfit in misfits]
        if bad:
            raise UnrollError(self.schema.type, bad, len(messages))
        return self._with_stamps(concat_rows(parts))

    def stamp_ns(self, message: bytes) -> int | None:
        """Read the message's own stamp only; None without one, if it is 0, or if damaged."""
        if self._stamp is None:
            return None
        if self._quick_stamp is not None:
            return self._quick_stamp(message)
        try:
            stamps = self.rows([message]).stamp_ns
        except UnrollError:
            return None
        return (int(stamps[0]) or None) if stamps is not None else None

    def no_stamp(self, message: bytes) -> Any:
        """Return what stands where the stamp belongs and is no time; None if nothing does.

        The zero of a ROS time says that there is none.
        """
        if self._stamp is None or self._stamp.type == "time" or self.stamp_ns(message):
            return None
        try:
            found = self.rows([message]).columns[self._stamp.name]
        except UnrollError:
            return None
        return found[0].item() if isinstance(found[0], np.generic) else found[0]

    def _with_stamps(self, rows: Rows) -> Rows:
        if self._stamp is None:
            return rows
        stamps = stamps_of_column(rows.columns[self._stamp.name], self._stamp.type)
        return Rows(rows.count, rows.columns, rows.children, stamps)

    def _portion(self, messages: Sequence[bytes], lengths: list[int]) -> tuple[Rows, list[int]]:
        if self._layouts is not None and messages:
            try:
                return self._by_layout(*self._layouts.group(messages, lengths))
            except TooManyLayoutsError:
                self._layouts = None
        return self._one_by_one(messages)

    def _by_layout(self, groups: Sequence[Group], bad: list[int]) -> tuple[Rows, list[int]]:
        if bad:
            return self._nothing(), bad
        parts = [build_rows(self._plan, group.places(), len(group.members)) for group in groups]
        return _in_order(parts, [group.members for group in groups]), []

    def _one_by_one(self, messages: Sequence[bytes]) -> tuple[Rows, list[int]]:
        members, bad = self._by_byte_order(messages)
        parts = []
        for big_endian, numbers in members.items():
            part = [messages[number] for number in numbers]
            data, sizes = b"".join(part), [len(message) for message in part]
            slots, misfits = walk_all(self._walker, self._plan, data, sizes, big_endian)
            bad += [numbers[misfit] for misfit in misfits]
            if not bad:
                parts.append(build_rows(self._plan, Scattered(data, slots, big_endian), len(part)))
        if bad:
            return self._nothing(), bad
        return _in_order(parts, [np.array(numbers, np.int64) for numbers in members.values()]), []

    def _by_byte_order(self, messages: Sequence[bytes]) -> tuple[dict[bool, list[int]], list[int]]:
        members: dict[bool, list[int]] = {}
        bad = []
        for number, message in enumerate(messages):
            try:
                members.setdefault(is_big_endian(self._plan, message), []).append(number)
            except ValueError:
                bad.append(number)
        return members or {False: []}, bad

    def _nothing(self) -> Rows:
        slots: list[list[int]] = [[] for _ in range(self._plan.slots)]
        return build_rows(self._plan, Scattered(b"", slots, False), 0)


def _portions(
    messages: Sequence[bytes],
) -> Iterator[tuple[int, Sequence[bytes], list[int]]]:
    """Split a batch so that no join is larger than 16 MiB, or only by its last message."""
    lengths = list(map(len, messages))
    if sum(lengths) <= _LARGEST_JOIN:
        yield 0, messages, lengths
        return
    first = size = 0
    for end, length in enumerate(lengths, 1):
        size += length
        if size > _LARGEST_JOIN or end == len(lengths):
            yield first, messages[first:end], lengths[first:end]
            first, size = end, 0


def _in_order(parts: Sequence[Rows], members: Sequence[IntArray]) -> Rows:
    if len(parts) == 1:
        return parts[0]
    return take_rows(concat_rows(parts), np.argsort(np.concatenate(members)))


def _stamp_column(schema: ItemSchema, stamp: str | None) -> Column | None:
    """Find the column of the own stamp: the message's, or the one the configuration names."""
    wanted = schema.stamp if stamp is None else stamp.strip("/").replace(".", "/")
    if not wanted:
        return None
    candidates = [column for column in schema.columns if column.type in _STAMP_TYPES]
    for column in candidates:
        if column.path == wanted:
            return column
    times = [column.path for column in candidates if column.type == "time"]
    raise UsageError(
        f"{schema.type} has no time stamp {wanted!r}",
        f"it has {', '.join(times)}" if times else "leave stamp empty: receipt time is used",
    )


def _stamp_reader(plan: Plan, stamp: Column | None) -> Callable[[bytes], int | None] | None:
    """Make a reader for a stamp that lies at the same place in every message, else None."""
    place = _fixed_place(plan, stamp.name) if stamp and stamp.type == "time" else None
    if place is None:
        return None
    readers = {
        big: Struct((">" if big else "<") + ("iI" if plan.cdr else "II")).unpack_from
        for big in (False, True)
    }

    def read(message: bytes) -> int | None:
        if len(message) < place + 8:
            return None
        seconds, rest = readers[plan.cdr and message[1] == 0](message, place)
        return (seconds * _NS + rest) or None

    return read


def _fixed_place(plan: Plan, name: str) -> int | None:
    """Find a column in the first piece of a message, which starts where the message does."""
    first = plan.table.ops[0]
    if not isinstance(first, FixedOp):
        return None
    for run in first.runs:
        if name in run.names:
            return 4 * plan.cdr + run.offset + SIZES[run.kind] * run.names.index(name)
    return None
