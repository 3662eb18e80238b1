"""Recordings as a source: ROS 1 and ROS 2 bags and MCAP files, replayed as if they were live."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import RecordingReader
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import TopicSelection, pattern_problem, wrong_types

SAMPLE = """\
- recording:
    path: recordings/*.bag
    speed: 2
    topics:
      - topic: {name: /odom, max_frequency: 10}
"""
PASSIVE = "reads recordings only; the originals are never written to"
_NOT_WORTH_WAITING_NS = 500_000


@dataclass(frozen=True)
class RecordingOptions:
    """The ``recording`` block."""

    path: str | Sequence[str] = option(
        doc="file or bag folder, * and ** allowed; several play one after the other",
        aliases=("paths",),
    )
    speed: float | Literal["max"] = option(1.0, "times the original speed, or max for no waiting")
    topics: Sequence[TopicOptions] = option(
        (), "topics to replay, with * or ** those that match; all when absent"
    )
    exclude: Sequence[str] = option((), "names and patterns of topics to leave out")
    types: Sequence[str] = option((), "types and patterns of types; others are left out")
    exclude_types: Sequence[str] = option((), "types and patterns of types to leave out")
    loop: bool = option(False, "start again at the end")
    start_s: float = option(0.0, "leave out this much at the start of each recording", unit="s")
    duration_s: float | None = option(None, "play this much of each recording", unit="s")

    @property
    def patterns(self) -> Sequence[str]:
        """Return the paths as a list."""
        return [self.path] if isinstance(self.path, str) else self.path

    def in_folder(self, folder: Path) -> RecordingOptions:
        """Return the same with relative paths seen from a folder."""
        paths = [str(folder / Path(pattern).expanduser()) for pattern in self.patterns]
        return replace(self, path=paths)

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not all(self.patterns) or not self.patterns:
            yield "path", "names no file"
        if self.speed != "max" and not 0 < self.speed < float("inf"):
            yield "speed", "must be above 0, or max"
        if self.start_s < 0:
            yield "start_s", "must not be negative"
        if self.duration_s is not None and self.duration_s <= 0:
            yield "duration_s", "must be above 0"
        patterns = {"topics": [topic.name for topic in self.topics], "exclude": self.exclude}
        for key, names in patterns.items():
            yield from ((key, pattern_problem(name)) for name in names if pattern_problem(name))
        for key in ("types", "exclude_types"):
            yield from ((key, what) for what in wrong_types(getattr(self, key)))

    def selection(self) -> TopicSelection:
        """Return what chooses among the topics of a recording."""
        return TopicSelection(
            self.topics,
            all_topics=not self.topics,
            exclude=self.exclude,
            types=self.types,
            exclude_types=self.exclude_types,
        )

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield paths without a recording so far; when it is to play, that is an error."""
        for pattern in self.patterns:
            if not _matches(Path(pattern).expanduser()):
                yield "path", f"there is no recording at {pattern} yet"


Config = RecordingOptions


class RecordingSource:
    """Replays recordings; messages are stamped on receipt like those of a robot."""

    lossless = True

    def __init__(self, config: RecordingOptions, name: str) -> None:
        self.config = config
        self.name = name
        # fraction of all recordings that has been replayed (of this round, if it loops)
        self.progress = 0.0

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Replay until the end, or until ``stop`` is set if the recordings loop.

        Raises AmberboxError if there is no recording at the path or one cannot be read.
        """
        paths = find_paths(self.config.patterns)
        while not stop.is_set():
            for number, path in enumerate(paths):
                self._play(path, number / len(paths), 1 / len(paths), sink, stop)
            if not self.config.loop:
                break

    def _play(
        self, path: Path, before: float, share: float, sink: Sink, stop: threading.Event
    ) -> None:
        with open_recording(path) as recording:
            selection = self.config.selection()
            names = {topic.name for topic in recording.topics}
            missing = selection.named.keys() - names
            missing |= {p.text for p, _ in selection.patterns if not any(map(p.fits, names))}
            for name in sorted(missing):
                sink.event("topic_missing", f"{path.name} has no topic {name}", topic=name)
            chosen = [
                topic if selection.chooses(topic.name, topic.schema.name if topic.schema else "")
                else None
                for topic in recording.topics
            ]  # fmt: skip
            for name in dict.fromkeys(topic.name for topic in chosen if topic is not None):
                sink.link_up(name, path.name)
            streams = [None if topic is None else sink.topic(topic) for topic in chosen]
            messages = _chosen(recording, self.config)
            pace = _Pace(self.config.speed, stop)
            for topic_index, log_time_ns, _, data in messages:
                if not pace.wait_for(log_time_ns):
                    break
                stream = streams[topic_index]
                if stream is not None:
                    sink.message(stream, data, sink.now_ns())
                    self.progress = before + share * recording.progress
            _report_end(recording, path, streams, sink, stop)
        if not stop.is_set():
            self.progress = before + share


Source = RecordingSource


def find_paths(patterns: Sequence[str]) -> list[Path]:
    """Return the paths that match, sorted within each pattern; raises AmberboxError."""
    paths = []
    for pattern in patterns:
        matches = _matches(Path(pattern).expanduser())
        if not matches:
            raise AmberboxError(
                f"there is no recording at {pattern}",
                "relative paths in black_box.yaml are seen from its folder",
            )
        paths += matches
    return paths


def _matches(pattern: Path) -> list[Path]:
    if pattern.exists():  # also when its name has brackets in it
        return [pattern]
    parts = pattern.relative_to(pattern.anchor)
    try:
        return sorted(Path(pattern.anchor).glob(str(parts)))
    except ValueError:  # a**b, up to Python 3.12
        return []


def _chosen(
    recording: RecordingReader, config: RecordingOptions
) -> Iterator[tuple[int, int, int | None, bytes]]:
    if not config.start_s and config.duration_s is None:
        return recording.messages()
    from_ns = (recording.report.start_ns or 0) + round(config.start_s * NS)
    to_ns = None if config.duration_s is None else from_ns + round(config.duration_s * NS)
    return recording.messages(from_ns, to_ns)


class _Pace:
    """Waits until a message is due, by the monotonic clock."""

    def __init__(self, speed: float | Literal["max"], stop: threading.Event) -> None:
        self._speed = speed
        self._stop = stop
        self._start: tuple[int, int] | None = None

    def wait_for(self, log_time_ns: int) -> bool:
        """Wait until a message is due; False when stopped."""
        if self._speed == "max":
            return not self._stop.is_set()
        now_ns = time.monotonic_ns()
        if self._start is None:
            self._start = log_time_ns, now_ns
        first_ns, began_ns = self._start
        due_ns = began_ns + (log_time_ns - first_ns) / self._speed
        if due_ns - now_ns < _NOT_WORTH_WAITING_NS:
            return not self._stop.is_set()
        return not self._stop.wait((due_ns - now_ns) / NS)


def _report_end(
    recording: RecordingReader,
    path: Path,
    streams: Sequence[int | None],
    sink: Sink,
    stop: threading.Event,
) -> None:
    reason = "stopped" if stop.is_set() else "end of recording"
    replayed = [t.name for t, s in zip(recording.topics, streams, strict=True) if s is not None]
    for name in dict.fromkeys(replayed):
        sink.link_down(name, path.name, reason)
    for note in recording.report.notes:
        sink.event("recording_note", f"{path.name}: {note}", path=str(path))
    for damage in recording.report.damage:
        details = {"path": str(path), "offset": damage.offset, "length": damage.length}
        sink.event("recording_damaged", str(damage), **details)
