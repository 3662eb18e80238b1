"""ULog files of PX4 autopilots: topics, parameters, log lines, and the times it could not write."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path

from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.blackbox.formats.kept import Converted, Kept
from amberbox.blackbox.formats.options import ReadOptions
from amberbox.blackbox.formats.recording import (
    Account,
    Damage,
    Part,
    RecordedGap,
    RecordedMessage,
    Recording,
    Report,
)
from amberbox.blackbox.formats.ulog_records import Reader, State, Topics, next_record
from amberbox.blackbox.formats.ulog_types import Formats
from amberbox.core.errors import AmberboxError
from amberbox.core.timetext import format_time

MAGIC = b"ULog\x01\x12\x35"
_HEADER_BYTES = 16
_BLOCK = 1 << 20
_US = 1000
_FLAG_BITS = b"\x28\x00B"


@dataclass
class _Log:
    """What is gathered while a file is read for the first time."""

    file: FileBytes
    report: Report
    account: Account
    state: State
    topics: Topics = field(default_factory=Topics)
    formats: dict[str, Formats] = field(default_factory=dict)
    kept: Kept = field(default_factory=Kept)
    spans: list[tuple[tuple[int, int, int], Callable[[], Sequence[Converted]]]] = field(
        default_factory=list
    )
    dropouts_us: list[tuple[int, int]] = field(default_factory=list)
    utc_offsets_us: list[int] = field(default_factory=list)


def open_ulog(path: Path, options: ReadOptions) -> Recording:
    """Open a ULog file; it is read once to find its topics and times."""
    file = FileBytes(path)
    try:
        return _open(path, file, options)
    except BaseException:
        file.close()
        raise


def _open(path: Path, file: FileBytes, options: ReadOptions) -> Recording:
    header = file.read(0, _HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        raise AmberboxError(f"{path} ends within its header", "nothing was logged in it")
    start_us = int.from_bytes(header[8:], "little")
    report = Report("ULog file")
    log = _Log(file, report, Account(path.name, "data records"), State({}, start_us))
    report.accounts.append(log.account)
    for start, stop in _regions(file, path):
        _read_region(log, start, stop)
    base_ns = _base_ns(log, start_us, options)
    report.gaps += [
        RecordedGap(_shifted(base_ns, start), _shifted(base_ns, end), "dropout in the log")
        for start, end in log.dropouts_us
    ]
    log.account.topics = tuple(
        n for n, topic in enumerate(log.topics.topics) if topic.message_encoding != "msgpack"
    )
    parts = [_part(span, load, base_ns) for span, load in log.spans]
    topics = log.topics
    return Recording(path, topics.topics, parts, report, file.close, topics.origins)


def _regions(file: FileBytes, path: Path) -> Iterator[tuple[int, int]]:
    """Give the stretches of the file: what was appended after a crash begins at an offset."""
    flags = file.read(_HEADER_BYTES, 3 + 40)
    offsets: list[int] = []
    if flags.startswith(_FLAG_BITS) and len(flags) == 43:
        _refuse_unknown(flags[11:19], path)
        found = [int.from_bytes(flags[at : at + 8], "little") for at in (19, 27, 35)]
        offsets = sorted(offset for offset in found if _HEADER_BYTES < offset < file.size)
    edges = [_HEADER_BYTES, *offsets, file.size]
    yield from pairwise(edges)


def _refuse_unknown(flags: bytes, path: Path) -> None:
    if flags[0] & 0xFE or any(flags[1:]):
        raise AmberboxError(
            f"{path} needs a newer reader: its incompatible flags are {flags.hex()}",
            "a later version of Amberbox may know them",
        )


def _read_region(log: _Log, start: int, stop: int) -> None:
    at = start
    while at < stop:
        used, damaged = _read_block(log, at, stop)
        at += used
        if damaged:
            at = _skip_damage(log, at, stop)
        elif not used:
            _note_rest(log, at, stop)
            return


def _read_block(log: _Log, offset: int, stop: int) -> tuple[int, bool]:
    reader = Reader(log.topics, log.formats, log.state)
    before = log.state
    used, damaged = reader.read(log.file.read(offset, min(_BLOCK, stop - offset)))
    log.state = reader.state
    log.account.total += reader.data_records
    log.account.refused.update(reader.refused)
    log.dropouts_us += reader.dropouts_us
    log.utc_offsets_us += reader.utc_offsets_us
    for note in reader.notes:
        log.report.add_note(note)
    if reader.messages:
        times = [time_us for _, time_us, _ in reader.messages]
        again = partial(_read_again, log, offset, used, before)
        load = log.kept.keep(reader.messages, again)
        log.spans.append(((min(times), max(times), len(times)), load))
    return used, damaged


def _read_again(log: _Log, offset: int, size: int, state: State) -> Sequence[Converted]:
    reader = Reader(log.topics, log.formats, state)
    reader.read(log.file.read(offset, size))
    return reader.messages


def _skip_damage(log: _Log, at: int, stop: int) -> int:
    """Note damage and return where records go on."""
    found = at + 1
    while found < stop:
        block = log.file.read(found, min(_BLOCK, stop - found))
        place = next_record(block, 0, log.state.subscriptions)
        if place < len(block):
            found += place
            break
        found += max(1, len(block) - 16) if found + len(block) < stop else len(block)
    reason = "no record begins here"
    log.report.add_damage(Damage(log.file.path.name, at, found - at, reason))
    return found


def _note_rest(log: _Log, at: int, stop: int) -> None:
    if stop < log.file.size:
        log.report.add_note(f"{stop - at} bytes before appended data are no whole record")
    else:
        reason = "the file is cut short"
        log.report.add_damage(Damage(log.file.path.name, at, stop - at, reason))


# -- time


def _base_ns(log: _Log, start_us: int, options: ReadOptions) -> int:
    """Return when the autopilot's clock was 0, and say how that is known."""
    if options.start_ns is not None:
        base_ns = options.start_ns - start_us * _US
        log.report.add_note(f"the log begins at {format_time(options.start_ns)}, as given")
        return base_ns
    if log.utc_offsets_us:
        base_ns = round(statistics.median(log.utc_offsets_us)) * _US
        log.report.add_note(
            f"times are UTC by GPS: the autopilot started at {format_time(base_ns)}"
        )
        return base_ns
    log.report.add_note(
        "the log does not say what time it was: times count from the start of the autopilot, "
        "as if that was 1970; --start TIME says when the log begins"
    )
    return 0


def _shifted(base_ns: int, time_us: int) -> int:
    return max(0, base_ns + time_us * _US)


def _part(
    span: tuple[int, int, int], load: Callable[[], Sequence[Converted]], base_ns: int
) -> Part:
    first, last, count = span
    return Part(
        _shifted(base_ns, first), _shifted(base_ns, last), count, partial(_load, load, base_ns)
    )


def _load(load: Callable[[], Sequence[Converted]], base_ns: int) -> list[RecordedMessage]:
    return [
        RecordedMessage(topic, _shifted(base_ns, time_us), None, data)
        for topic, time_us, data in load()
    ]
