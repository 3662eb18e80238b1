"""Keep a message of tf only when the transform of a frame in it has changed, or now and then.

Each frame is compared with its own last kept transform, whatever message it comes in. When a frame
changes after it was held, the last message in which it was still held is kept as well: readers that
interpolate between kept messages then see it stand still until it moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import UsageError
from amberbox.core.source import TransformOptions
from amberbox.core.types import IntArray, ItemSchema, Ragged, Rows

TABLE = "transforms"
MOST_FRAMES = 10_000  # of a topic; messages with further ones are kept
_PARENT, _CHILD = "header/frame_id", "child_frame_id"
_NUMBERS = (
    *(f"transform/translation/{axis}" for axis in "xyz"),
    *(f"transform/rotation/{axis}" for axis in "xyzw"),
)


@dataclass(slots=True)
class _Frame:
    """A frame as it was kept last, and the message since then in which it was held."""

    parent: str
    pose: Sequence[float]
    kept_ns: int
    held: _HeldMessage | None = None


@dataclass(slots=True, eq=False)
class _HeldMessage:
    """A message that was dropped: its place in the batch, or its bytes after the batch."""

    number: int
    place: int
    data: bytes = b""


@dataclass(slots=True)
class Selection:
    """Which messages of a batch to keep, and messages of earlier batches to keep before some."""

    kept: list[bool]
    earlier: list[tuple[int, bytes]] = field(default_factory=list)


class TransformFilter:
    """The filter of one topic; raises UsageError for messages that hold no transforms."""

    def __init__(self, options: TransformOptions, schema: ItemSchema) -> None:
        table = schema.children.get(TABLE)
        names = {column.path: column.name for column in table.columns} if table else {}
        if not {_PARENT, _CHILD, *_NUMBERS} <= names.keys():
            raise UsageError(
                f"{schema.type} is no message of tf, as 'transforms' expects",
                "leave out 'transforms:' of this topic; 'change:' goes with any type",
            )
        self._names = names
        self._options = options
        self._heartbeat_ns = options.heartbeat_s * 1e9 if options.heartbeat_s else math.inf
        self._frames: dict[str, _Frame] = {}
        self._count = 0

    def select(self, rows: Rows, received_ns: IntArray, messages: Sequence[bytes]) -> Selection:
        """Decide on the messages of a batch, in order of their time of receipt."""
        table = rows.children[TABLE]
        assert table.parent_row is not None
        columns = [self._column(table, path) for path in (_PARENT, _CHILD, *_NUMBERS)]
        parents, children, *numbers = (column.tolist() for column in columns)
        poses = list(zip(*numbers, strict=True))
        ends = np.searchsorted(table.parent_row, np.arange(rows.count), "right").tolist()
        chosen = Selection([False] * rows.count)
        held: list[_HeldMessage] = []
        start = 0
        for place, (end, at_ns) in enumerate(zip(ends, received_ns.tolist(), strict=True)):
            inside = [(children[row], parents[row], poses[row]) for row in range(start, end)]
            start = end
            message = _HeldMessage(self._count + place, place)
            if self._is_kept(inside, at_ns, chosen, place):
                chosen.kept[place] = True
            else:
                held.append(message)
            self._update(inside, at_ns, None if chosen.kept[place] else message)
        for message in held:
            message.data = b"" if chosen.kept[message.place] else messages[message.place]
            message.place = -1
        self._count += rows.count
        return chosen

    def _column(self, table: Rows, path: str) -> NDArray[Any]:
        column = table.columns[self._names[path]]
        assert not isinstance(column, Ragged)
        return column

    def _is_kept(
        self,
        inside: Sequence[tuple[str, str, Sequence[float]]],
        at_ns: int,
        chosen: Selection,
        place: int,
    ) -> bool:
        """Return whether to keep a message; choose also what its changed frames were held in."""
        keeps = not inside
        before: list[_HeldMessage] = []
        for name, parent, pose in inside:
            frame = self._frames.get(name)
            if frame is None:
                keeps = True
            elif frame.parent != parent or self._has_moved(frame.pose, pose):
                keeps = True
                before += [] if frame.held is None else [frame.held]
            elif at_ns - frame.kept_ns >= self._heartbeat_ns:
                keeps = True
        for held in sorted(before, key=attrgetter("number")):
            if held.place >= 0:
                chosen.kept[held.place] = True
            elif held.data:
                chosen.earlier.append((place, held.data))
                held.data = b""  # once, also if it holds several frames
        return keeps

    def _has_moved(self, old: Sequence[float], new: Sequence[float]) -> bool:
        if tuple(old) == tuple(new):
            return False
        if not all(map(math.isfinite, (*old, *new))):
            return not all(a == b or (a != a and b != b) for a, b in zip(old, new, strict=True))
        moved = math.dist(old[:3], new[:3]) > self._options.translation
        return moved or not angle_between(old[3:], new[3:]) <= self._options.rotation

    def _update(
        self,
        inside: Sequence[tuple[str, str, Sequence[float]]],
        at_ns: int,
        held: _HeldMessage | None,
    ) -> None:
        for name, parent, pose in inside:
            frame = self._frames.get(name)
            if held is not None and frame is not None:
                frame.held = held
            elif frame is not None or len(self._frames) < MOST_FRAMES:
                self._frames[name] = _Frame(parent, pose, at_ns)


def angle_between(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the angle between two rotations (quaternions x, y, z, w) in rad; NaN without one."""
    size = math.hypot(*first) * math.hypot(*second)
    if not size:
        return math.nan
    cosine = abs(sum(a * b for a, b in zip(first, second, strict=True))) / size
    x, y, z, w = first
    a, b, c, d = second
    sine = (
        math.hypot(  # of half the angle: exact for small ones, as the cosine is not
            w * a - x * d - y * c + z * b,
            w * b + x * c - y * d - z * a,
            w * c - x * b + y * a - z * d,
        )
        / size
    )
    return 2 * math.atan2(sine, cosine)
