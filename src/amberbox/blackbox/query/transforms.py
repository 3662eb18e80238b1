"""Coordinate frames of a record (tf): which there are, and the transform between two at a time.

Frames are read from ``tf2_msgs/TFMessage`` of ROS 1 and 2 and from ``FrameTransform(s)`` of
Foxglove. The transform of a frame is that into its parent; between two samples the translation is
interpolated linearly, the rotation on the shortest arc (slerp, Shoemake 1985).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.query.overview import ItemInfo
from amberbox.blackbox.query.table import Table
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.timestamps import format_time
from amberbox.core.types import Column, IntArray, ItemSchema

Vector: TypeAlias = NDArray[np.float64]

LOOKBACK_NS = 30 * NS
LOOKAHEAD_NS = 5 * NS
_SHOWN = 8
_KIND = "Transform"  # in the names of the types of all tables of transforms

# paths in a table of transforms: parent, child, stamp, what is before x y z of both parts
_PATHS = (
    ("header/frame_id", "child_frame_id", "header/stamp", "transform/"),
    ("parent_frame_id", "child_frame_id", "timestamp", ""),
)
_PARTS = (*(f"translation/{axis}" for axis in "xyz"), *(f"rotation/{axis}" for axis in "xyzw"))


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """A rotation, then a translation: of points in ``source`` to points in ``target``.

    ``translation`` is x, y, z in m, ``rotation`` a unit quaternion x, y, z, w.
    """

    target: str
    source: str
    at_ns: int
    translation: Vector
    rotation: Vector

    @property
    def matrix(self) -> Vector:
        """Return the homogeneous 4 x 4 matrix."""
        x, y, z, w = self.rotation
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, 3] = self.translation
        return matrix

    def after(self, first: Transform) -> Transform:
        """Return the transform that applies ``first``, then this one."""
        translation = rotated(first.translation, self.rotation) + self.translation
        rotation = product(self.rotation, first.rotation)
        return Transform(self.target, first.source, self.at_ns, translation, rotation)

    def inverse(self) -> Transform:
        """Return the transform back."""
        back = self.rotation * (-1, -1, -1, 1)
        translation = -rotated(self.translation, back)
        return Transform(self.source, self.target, self.at_ns, translation, back)


def product(first: Vector, second: Vector) -> Vector:
    """Multiply two quaternions x, y, z, w: the rotation ``second``, then ``first``."""
    vector = first[3] * second[:3] + second[3] * first[:3] + np.cross(first[:3], second[:3])
    return np.append(vector, first[3] * second[3] - first[:3] @ second[:3])


def rotated(point: Vector, rotation: Vector) -> Vector:
    """Rotate a point by a unit quaternion x, y, z, w."""
    cross = 2 * np.cross(rotation[:3], point)
    turned: Vector = point + rotation[3] * cross + np.cross(rotation[:3], cross)
    return turned


def slerp(first: Vector, second: Vector, part: float) -> Vector:
    """Interpolate between two unit quaternions, on the shortest arc (Shoemake 1985)."""
    cosine = float(first @ second)
    if cosine < 0:
        second, cosine = -second, -cosine
    if cosine > 1 - 1e-12:
        mixed = first + part * (second - first)
    else:
        angle = np.arccos(min(cosine, 1.0))
        mixed = np.sin((1 - part) * angle) * first + np.sin(part * angle) * second
    normal: Vector = mixed / np.linalg.norm(mixed)
    return normal


@dataclass(frozen=True, slots=True, eq=False)
class FrameHistory:
    """The transforms of one frame into its parent, in order of their stamps.

    A ``static`` one holds at any time. ``parents`` has the parent at each stamp, ``poses`` one row
    for each: x, y, z, then the unit quaternion x, y, z, w.
    """

    frame: str
    static: bool
    stamps_ns: IntArray
    parents: Sequence[str]
    poses: Vector

    @property
    def parent(self) -> str:
        """Return the parent at the last stamp."""
        return self.parents[-1]

    @property
    def rate_hz(self) -> float | None:
        """Return how often it was sent, None for a static frame or a single transform."""
        seconds = (self.stamps_ns[-1] - self.stamps_ns[0]) / NS
        return None if self.static or seconds <= 0 else float((len(self.stamps_ns) - 1) / seconds)

    def place(self, at_ns: int) -> int:
        """Return the number of the last transform at or before a time; -1 before the first."""
        place = int(np.searchsorted(self.stamps_ns, at_ns, "right")) - 1
        return max(place, 0) if self.static else place

    def covers(self, at_ns: int) -> bool:
        """Return whether the transform is known at a time."""
        return self.static or bool(self.stamps_ns[0] <= at_ns <= self.stamps_ns[-1])

    def transform(self, at_ns: int) -> Transform:
        """Return the transform into the parent; raises UsageError outside of what was recorded."""
        if not self.covers(at_ns):
            first, last = (format_time(int(self.stamps_ns[end])) for end in (0, -1))
            raise UsageError(
                f"the transform of {self.frame!r} is not known at {format_time(at_ns)}",
                f"it was recorded from {first} to {last}: ask for a time within that",
            )
        place = self.place(at_ns)
        pose, parent = self.poses[place], self.parents[place]
        before_ns = int(self.stamps_ns[place])
        later = place + 1
        goes_on = later < len(self.stamps_ns) and self.parents[later] == parent
        if not self.static and goes_on and at_ns > before_ns:
            part = (at_ns - before_ns) / (int(self.stamps_ns[later]) - before_ns)
            then = self.poses[later]
            translation = pose[:3] + part * (then[:3] - pose[:3])
            pose = np.append(translation, slerp(pose[3:], then[3:], part))
        return Transform(parent, self.frame, at_ns, pose[:3], pose[3:])


@dataclass(frozen=True, slots=True, eq=False)
class FrameTree:
    """All frames with a parent, by name."""

    histories: Mapping[str, FrameHistory]

    def frames(self) -> list[str]:
        """Return the names of all frames, parents included."""
        parents = {parent for history in self.histories.values() for parent in history.parents}
        return sorted(parents | self.histories.keys())

    def lookup(self, target: str, source: str, at_ns: int | None = None) -> Transform:
        """Return the transform of points in ``source`` to points in ``target``.

        Without a time it is the newest for which all frames on the way are known. Raises UsageError
        for an unknown frame, for frames that are not connected, and for a time at which a frame on
        the way is not known.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        for frame in (target, source):
            self._check(frame)
        if at_ns is None:
            at_ns = self._newest_ns(target, source)
        up, down = self._path(source, at_ns), self._path(target, at_ns)
        below = {frame: place for place, frame in enumerate(down)}
        meeting = next((frame for frame in up if frame in below), None)
        if meeting is None:
            raise UsageError(
                f"there is no path from {source!r} to {target!r} at {format_time(at_ns)}",
                f"{source!r} is below {up[-1]!r}, {target!r} below {down[-1]!r}: "
                "no transform between the two was recorded",
            )
        there = self._chain(up[: up.index(meeting) + 1], at_ns)
        back = self._chain(down[: below[meeting] + 1], at_ns)
        return back.inverse().after(there)

    def _check(self, frame: str) -> None:
        known = self.frames()
        if frame not in known:
            shown = ", ".join(known[:_SHOWN]) + (", ..." if len(known) > _SHOWN else "")
            hint = f"frames: {shown}" if known else "no transforms were recorded in this range"
            raise UsageError(f"there is no frame {frame!r}{did_you_mean(frame, known)}", hint)

    def _newest_ns(self, target: str, source: str) -> int:
        """Return the newest time at which all moving frames between two frames are known."""
        newest = max((int(h.stamps_ns[-1]) for h in self.histories.values()), default=0)
        paths = [self._path(frame, newest) for frame in (source, target)]
        shared = set(paths[0]) & set(paths[1])
        moving = [
            history
            for frame in (frame for path in paths for frame in path if frame not in shared)
            if (history := self.histories.get(frame)) is not None and not history.static
        ]
        return min((int(history.stamps_ns[-1]) for history in moving), default=newest)

    def _path(self, frame: str, at_ns: int) -> list[str]:
        """Return a frame and those above it at a time, up to the root or a cycle."""
        path = [frame]
        while (history := self.histories.get(path[-1])) is not None:
            parent = history.parents[max(history.place(at_ns), 0)]
            if parent in path:
                raise UsageError(
                    f"the frames {', '.join(path[path.index(parent) :])} are their own parents",
                    "two publishers state different parents: record them apart, or fix one",
                )
            path.append(parent)
        return path

    def _chain(self, path: Sequence[str], at_ns: int) -> Transform:
        """Return the transform from the first frame of a path to its last."""
        whole = Transform(path[0], path[0], at_ns, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        for frame in path[:-1]:
            whole = self.histories[frame].transform(at_ns).after(whole)
        return whole


class TransformRecord(Protocol):
    """The part of a record that holds transforms."""

    def items(self) -> list[ItemInfo]:
        """Return its items and child tables."""

    def variables(self, item: str) -> ItemSchema:
        """Return the columns of an item."""

    def query(
        self, item: str, variables: Sequence[str], from_: int | None, to: int | None
    ) -> Table:
        """Return rows of a range of time of receipt."""

    def last_ns(self) -> int | None:
        """Return when the last record was received."""


def find_transform(
    record: TransformRecord, target: str, source: str, at_ns: int | None
) -> Transform:
    """Return a transform at a time (see ``FrameTree.lookup``).

    Only the record around the time is read, or all of it where that is not enough.
    """
    end_ns = record.last_ns() if at_ns is None else at_ns
    if end_ns is not None:
        near = read_frames(record, end_ns - LOOKBACK_NS, end_ns + LOOKAHEAD_NS)
        with suppress(UsageError):  # a frame that is sent rarely, or stamps of another clock
            return near.lookup(target, source, at_ns)
    return read_frames(record).lookup(target, source, at_ns)


def read_frames(
    record: TransformRecord, from_ns: int | None = None, to_ns: int | None = None
) -> FrameTree:
    """Read all transforms that were received in a range; static ones from the whole record."""
    found: dict[tuple[str, bool], list[_Samples]] = {}
    for info in record.items():
        if _KIND not in info.type:
            continue
        static = "static" in info.topic.rpartition("/")[2]
        span = (None, None) if static else (from_ns, to_ns)
        for samples in _samples(record, info.name, span):
            found.setdefault((samples.frame, static), []).append(samples)
    histories: dict[str, FrameHistory] = {}
    for (frame, static), parts in sorted(found.items(), key=lambda entry: entry[0][1]):
        histories.setdefault(frame, _history(frame, static, parts))  # a frame that moves counts
    return FrameTree(histories)


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    frame: str
    stamps_ns: IntArray
    parents: Sequence[str]
    poses: Vector


def _samples(
    record: TransformRecord, item: str, span: tuple[int | None, int | None]
) -> Iterator[_Samples]:
    columns = {column.path: column for column in record.variables(item).columns}
    paths = next((paths for paths in _PATHS if _is_of_transforms(columns, paths)), None)
    if paths is None:
        return
    parent, child, stamp, before = paths
    names = [columns[path].name for path in (parent, child, stamp)]
    numbers = [columns[before + part].name for part in _PARTS]
    table = record.query(item, [*names, *numbers], *span)
    if not len(table):
        return
    parents = np.array([text.lstrip("/") for text in _texts(table, names[0])], object)
    children = np.array([text.lstrip("/") for text in _texts(table, names[1])], object)
    received_ns = np.asarray(table["timestamp"])
    stamps_ns = np.ma.filled(np.asarray(table[names[2]]), 0)
    stamps_ns = np.where(stamps_ns, stamps_ns, received_ns)
    poses = np.stack([np.asarray(table[name], np.float64) for name in numbers], axis=1)
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    sound = np.isfinite(poses).all(axis=1) & (norms > 1e-6)
    poses[sound, 3:] /= norms[sound, None]
    for frame in sorted(set(children[sound].tolist())):
        rows = np.flatnonzero(sound & (children == frame))
        yield _Samples(frame, stamps_ns[rows], parents[rows].tolist(), poses[rows])


def _texts(table: Table, name: str) -> Iterable[str]:
    return ("" if text is None else str(text) for text in table.values(name))


def _is_of_transforms(columns: Mapping[str, Column], paths: tuple[str, str, str, str]) -> bool:
    parent, child, stamp, before = paths
    texts = [columns.get(path) for path in (parent, child)]
    time = columns.get(stamp)
    return (
        all(column is not None and column.type == "string" for column in texts)
        and time is not None
        and time.type == "time"
        and all(before + part in columns for part in _PARTS)
    )


def _history(frame: str, static: bool, parts: Sequence[_Samples]) -> FrameHistory:
    """Join the samples of a frame; of several with one stamp the last one counts."""
    stamps_ns = np.concatenate([part.stamps_ns for part in parts])
    order = np.argsort(stamps_ns, kind="stable")
    ordered = stamps_ns[order]
    order = order[np.append(ordered[1:] != ordered[:-1], True)]
    parents = [parent for part in parts for parent in part.parents]
    poses = np.concatenate([part.poses for part in parts])
    return FrameHistory(
        frame, static, stamps_ns[order], [parents[row] for row in order.tolist()], poses[order]
    )
