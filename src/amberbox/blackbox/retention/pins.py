"""Pin a window of the record as an incident: a small file, and hard links of the ring's journals.

Any process may do it at any time, also while recorder or maintenance process are dead. Windows
count in the record's own time: within a run without a step of the clock by log time, from one such
stretch to the next by the time since boot, where the files state it and the computer was not
started anew. ``mark`` pins by hand: from the command line, a program or the robot's agent.
"""

from __future__ import annotations

import getpass
import hashlib
import math
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.retention.usage import DiskUse, bytes_of, pin_lock, quota_bytes, space_budget
from amberbox.blackbox.robot_folder.folder import load_folder, retention_options_of
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.incident import (
    FILE,
    RING,
    IncidentReason,
    LogMoment,
    LogSpan,
    StoredIncident,
    encoded,
    incident_folder,
    incident_of_firing,
    load,
    load_all,
    remove_leftovers,
    save,
)
from amberbox.blackbox.store.journal_reader import Extent, extent
from amberbox.blackbox.store.manifest_entries import SegmentPart
from amberbox.blackbox.store.store import (
    INCIDENTS,
    Store,
    is_locked,
    is_store,
    open_store,
    run_and_number,
    store_path,
    submit,
)
from amberbox.blackbox.store.tail import RECORDED
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, ConfigurationError, UsageError
from amberbox.core.files import replace_file, sync_folder
from amberbox.core.version import __version__

# Without news a recorder writes once a second: files of a run that lie further apart do so
# because the clock was set
_PAUSE_NS = 2 * NS
_MARGIN_NS = NS  # other journals may have rows just before the main one's first and after its last


@dataclass(frozen=True, slots=True)
class RunSection:
    """A section of a run without a step of the clock, and its place in the record's time.

    ``age_ns`` is how long before the end of the record it ended.
    """

    run: int
    start_ns: int
    end_ns: int
    age_ns: int
    offset_ns: int
    first: Extent

    def age_of(self, log_ns: int) -> int:
        """Return how long before the end of the record a log time was."""
        return self.age_ns + self.end_ns - log_ns

    @property
    def start_age_ns(self) -> int:
        """Return how long before the end of the record it began, ns."""
        return self.age_of(self.start_ns)


@dataclass(frozen=True, slots=True)
class RecordTimeline:
    """The newest stretches of a record, newest first."""

    pieces: tuple[RunSection, ...]

    @property
    def end(self) -> LogMoment:
        """Return the last moment of the record."""
        return LogMoment(self.pieces[0].run, self.pieces[0].end_ns)

    @property
    def end_received_ns(self) -> int:
        """Return the last moment as time of receipt, ns."""
        return self.pieces[0].end_ns + self.pieces[0].offset_ns

    def age_ns(self, at: LogMoment) -> int | None:
        """Return how long before the end a moment was; None if it is before all sections."""
        for piece in self.pieces:
            if piece.run == at.run and piece.start_ns - _MARGIN_NS <= at.log_ns:
                return max(piece.age_of(at.log_ns), 0)
            if piece.run < at.run:
                return max(piece.age_ns, 0)
        return None

    def at(self, age_ns: int) -> LogMoment:
        """Return the moment ``age_ns`` before the end, or the oldest known moment."""
        for piece in self.pieces:
            if age_ns <= piece.start_age_ns:
                return LogMoment(
                    piece.run, min(piece.end_ns - (age_ns - piece.age_ns), piece.end_ns)
                )
        return LogMoment(self.pieces[-1].run, self.pieces[-1].start_ns)

    def received_ns(self, at: LogMoment) -> int:
        """Return a moment as time of receipt."""
        for piece in self.pieces:
            if piece.run == at.run and piece.start_ns - _MARGIN_NS <= at.log_ns:
                return at.log_ns + piece.offset_ns
        return at.log_ns

    def spans(self, oldest_age_ns: int, newest_age_ns: int) -> tuple[LogSpan, ...]:
        """Return the spans between two ages (ns), oldest first."""
        found = []
        for piece in self.pieces:
            if piece.age_ns <= oldest_age_ns and piece.start_age_ns >= newest_age_ns:
                found.append(_cut(piece, oldest_age_ns, newest_age_ns))
        return tuple(reversed(found))


def _cut(piece: RunSection, oldest_age_ns: int, newest_age_ns: int) -> LogSpan:
    from_ns = piece.end_ns - (oldest_age_ns - piece.age_ns)
    to_ns = piece.end_ns - (newest_age_ns - piece.age_ns)
    if from_ns < piece.start_ns:
        from_ns = piece.start_ns - _MARGIN_NS
    if to_ns > piece.end_ns:
        to_ns = piece.end_ns + _MARGIN_NS
    return LogSpan(piece.run, from_ns, to_ns, piece.offset_ns)


def window_in(store: Store, from_ns: int, to_ns: int) -> tuple[LogMoment, int, int] | None:
    """Return a window in times of receipt as moment, and how long before and after it (ns).

    The moment is the end of the window, or that of the record, if the window ends later. None if
    nothing of the window was recorded, or it begins after the end of the record.
    """
    newest = look_back(store, 0)
    if newest is None or newest.end_received_ns < from_ns:
        return None
    back_ns = newest.end_received_ns - from_ns
    timeline = look_back(store, back_ns) or newest
    inside = [
        piece
        for piece in timeline.pieces
        if piece.start_ns + piece.offset_ns < to_ns and piece.end_ns + piece.offset_ns >= from_ns
    ]
    if not inside:
        return None
    last, first = inside[0], inside[-1]
    end = LogMoment(last.run, min(to_ns - last.offset_ns, last.end_ns))
    start = LogMoment(first.run, max(from_ns - first.offset_ns, first.start_ns))
    ages_ns = timeline.age_ns(start), timeline.age_ns(end)
    before_ns = (ages_ns[0] or 0) - (ages_ns[1] or 0)
    after_ns = max(to_ns - newest.end_received_ns, 0) if end == newest.end else 0
    return end, max(before_ns, 0), after_ns


def look_back(store: Store, back_ns: int, at: LogMoment | None = None) -> RecordTimeline | None:
    """Return the record's timeline from its end to ``back_ns`` before a moment; None if empty."""
    extents: list[Extent] = []
    for found in _newest_first(store.journal_files("main")):
        extents.append(found)
        timeline = RecordTimeline(_pieces(extents))
        age_ns = 0 if at is None else timeline.age_ns(at)
        if age_ns is not None and timeline.pieces[-1].start_age_ns >= age_ns + back_ns:
            return timeline
    return RecordTimeline(_pieces(extents)) if extents else None


def _newest_first(paths: Sequence[Path]) -> Iterator[Extent]:
    return (found for found in map(extent, reversed(paths)) if found is not None)


def _pieces(newest_first: Sequence[Extent]) -> tuple[RunSection, ...]:
    """Join files that follow each other on one clock."""
    pieces: list[RunSection] = []
    for found in newest_first:
        after = pieces[-1] if pieces else None
        if after is not None and _goes_on(found, after.first):
            pieces[-1] = RunSection(
                found.run, found.start_ns, after.end_ns, after.age_ns, found.offset_ns, found
            )
            continue
        age_ns = 0 if after is None else after.start_age_ns + _pause_ns(found, after.first)
        pieces.append(
            RunSection(found.run, found.start_ns, found.end_ns, age_ns, found.offset_ns, found)
        )
    return tuple(pieces)


def _goes_on(before: Extent, after: Extent) -> bool:
    same_base = None in (before.boot_base_ns, after.boot_base_ns) or (
        before.boot_base_ns == after.boot_base_ns
    )
    apart_ns = after.start_ns - before.end_ns
    return before.run == after.run and same_base and -NS <= apart_ns <= _PAUSE_NS


def _pause_ns(before: Extent, after: Extent) -> int:
    """Return how long the record paused between two stretches; never below 0."""
    bases = before.boot_base_ns, after.boot_base_ns
    if before.boot and before.boot == after.boot and bases[0] is not None and bases[1] is not None:
        return max((after.start_ns - bases[1]) - (before.end_ns - bases[0]), 0)
    return 0 if before.run == after.run else max(after.start_ns - before.end_ns, 0)


_RAW = ("main", "bulk")
# This part of the limit is for files that are never deleted: events, manifest, own journals
_OWN_SHARE = 16
# Bytes of each file, by device and inode: a file of several incidents counts once
Held = dict[tuple[int, int], int]


@dataclass(frozen=True, slots=True)
class PinRefusal:
    """Why a window was not pinned."""

    reason: str


def held_files(store: Store, incidents: Iterable[StoredIncident]) -> list[Path]:
    """Return the files that incidents hold: journals, segments, copies of the ring."""
    pinned = [incident for incident in incidents if incident.is_pinned]
    segments = (path for path, _ in _segments(store, pinned))
    return [*_copies(store, pinned), *_journals(store, pinned), *segments]


def held_bytes(store: Store, incidents: Iterable[StoredIncident]) -> int:
    """Return how much incidents hold, each file once."""
    return sum(_sizes(held_files(store, incidents)).values())


def allowed_bytes(store: Store, options: RetentionOptions) -> int:
    """Return the bytes that incidents may hold: their share, less the room recording needs."""
    now = space_budget(store, options, DiskUse(store.path).measure())
    writers = [w for w in RECORDED if next(store.folder(w).glob("*.mcap"), None) is not None]
    growing = options.headroom * len(writers)
    needed = options.reserve + now.headroom + growing + now.limit // _OWN_SHARE
    share = int(options.incident_share * quota_bytes(store, options))
    return max(0, min(share, now.limit - needed))


def pinned_journals(store: Store) -> frozenset[str]:
    """Return the journals (``folder/file``) whose rows, raw or as columns, are pinned."""
    pinned = [incident for incident in load_all(store) if incident.is_pinned]
    raw = {f"{path.parent.name}/{path.name}" for path in _journals(store, pinned, RECORDED)}
    columns = {p.journal for _, parts in _segments(store, pinned) for p in parts}
    return frozenset(raw | columns)


def refused_by_budget(
    store: Store,
    incident: StoredIncident,
    known: Sequence[StoredIncident],
    options: RetentionOptions,
) -> PinRefusal | None:
    """Return why there is no room for one more incident or a larger one; None if there is."""
    pinned = [i for i in known if i.id != incident.id and i.is_pinned] + [incident]
    allowed = allowed_bytes(store, options)
    held = _lasting_bytes(store, pinned, options) + _still_in_ring(store, incident)
    if held <= allowed:
        return None
    return PinRefusal(f"incidents would hold {held} bytes, {allowed} are allowed; release some")


def _lasting_bytes(
    store: Store, pinned: Sequence[StoredIncident], options: RetentionOptions
) -> int:
    """Return how many bytes cannot be deleted because of incidents, now and when files have grown.

    Columns count only if their journal is gone; otherwise they are duplicates, and can be deleted.
    """
    journals = list(_journals(store, pinned))
    raw = {f"{path.parent.name}/{path.name}" for path in journals}
    columns = [
        path
        for path, parts in _segments(store, pinned)
        if any(part.journal not in raw for part in parts)
    ]
    total = sum(_sizes([*_copies(store, pinned), *journals, *columns]).values())
    return total + sum(_growth(path, options) for path in journals)


def _growth(path: Path, options: RetentionOptions) -> int:
    """Return by how much a file may still grow: the one that its writer's head names."""
    head = read_head(path.parent)
    with suppress(FileNotFoundError):
        if head is not None and head.file == path.name:
            return max(0, options.headroom - bytes_of(path.stat()))
    return 0


def _still_in_ring(store: Store, incident: StoredIncident) -> int:
    """Return the bytes of the ring's journals that are about to be held."""
    here = {path.name for path in (incident_folder(store, incident.id) / RING).glob("*.mcap")}
    files = (path for path in store.folder("ring").glob("*.mcap") if path.name not in here)
    return sum(_sizes(path for path in files if _is_held(path, [incident])).values())


def _copies(store: Store, incidents: Sequence[StoredIncident]) -> Iterator[Path]:
    for incident in incidents:
        yield from (incident_folder(store, incident.id) / RING).glob("*")


def _journals(
    store: Store,
    incidents: Sequence[StoredIncident],
    writers: Sequence[str] = _RAW,
) -> Iterator[Path]:
    """Yield the journals of windows."""
    sealed = manifest.read(store.path).sealed if incidents else {}
    for writer in writers if incidents else ():
        for path in store.folder(writer).glob("*.mcap"):
            entry = sealed.get(f"{path.parent.name}/{path.name}")
            # by the manifest, so that few of thousands have to be opened
            may_be = entry is None or any(
                incident.holds_received(entry.run, entry.start_ns, entry.end_ns)
                for incident in incidents
            )
            if may_be and _is_held(path, incidents):
                yield path


def _is_held(path: Path, incidents: Sequence[StoredIncident]) -> bool:
    found = extent(path) if incidents else None
    return found is not None and any(
        incident.holds(found.run, found.start_ns, found.end_ns) for incident in incidents
    )


def _segments(
    store: Store, incidents: Sequence[StoredIncident]
) -> Iterator[tuple[Path, Sequence[SegmentPart]]]:
    """Yield the segments that incidents hold, and their parts within a window."""
    for segments in manifest.read(store.path).segments.values() if incidents else ():
        for segment in segments:
            inside = [
                part
                for part in segment.parts
                if any(incident.holds(part.run, part.from_ns, part.to_ns) for incident in incidents)
            ]
            if inside:
                yield store.path / segment.path, inside


def _sizes(paths: Iterable[Path]) -> Held:
    found: Held = {}
    for path in paths:
        with suppress(FileNotFoundError):
            status = path.stat()
            found[status.st_dev, status.st_ino] = bytes_of(status)
    return found


_CUTS = 8  # a window that holds too much ends after 7 of 8 parts of it, or 6, and so on


@dataclass(frozen=True, slots=True)
class PinRequest:
    """A requested window: around a moment of the record, its end where none is given.

    Raises UsageError for one that has no length.
    """

    before_s: float
    after_s: float
    reason: str = ""
    who: str = ""
    trigger: str = ""
    at: LogMoment | None = None
    key: str = ""

    def __post_init__(self) -> None:
        if not (0 <= self.before_s < math.inf and 0 <= self.after_s < math.inf):
            raise UsageError("a window cannot be shorter than nothing", "before 60s, after 20s")


def pin(store: Store, wish: PinRequest, options: RetentionOptions) -> StoredIncident | PinRefusal:
    """Pin a window, in an incident of its own or in one that it meets.

    Returns a ``PinRefusal`` where incidents would hold more than they may. Raises UsageError if
    nothing was recorded.
    """
    with pin_lock(store):
        remove_leftovers(store)
        known = load_all(store)
        before = incident_of_firing(known, wish.key) if wish.key else None
        if before is not None:
            return before
        timeline = look_back(store, round(wish.before_s * NS), wish.at)
        if timeline is None:
            raise UsageError(f"nothing has been recorded in {store.path} yet", "record first")
        made = _new(store, wish, timeline, options)
        joined = _to_join(made, known)
        incident = made if joined is None else _join(joined, made, timeline)
        refusal = refused_by_budget(store, incident, known, options)
        if refusal is not None:
            return refusal
        if joined is None:
            return _publish(store, incident)
        hold_ring(store, incident, incident_folder(store, incident.id))
        return save(store, replace(incident, told=""))


def _new(
    store: Store, wish: PinRequest, timeline: RecordTimeline, options: RetentionOptions
) -> StoredIncident:
    since = wish.at or timeline.end
    age_ns = timeline.age_ns(since) or 0
    before_ns, after_ns = round(wish.before_s * NS), round(wish.after_s * NS)
    end_age_ns = max(age_ns - after_ns, 0)
    spans = timeline.spans(age_ns + before_ns, end_age_ns)
    at_ns = timeline.received_ns(since)
    is_over = age_ns >= after_ns or not is_locked(store, "main")
    end_ns = timeline.received_ns(timeline.at(end_age_ns)) + 1
    first = timeline.pieces[0].first
    return StoredIncident(
        id=_id(at_ns, wish.key),
        reasons=(IncidentReason(at_ns, wish.reason, wish.who, wish.trigger, wish.key),),
        from_ns=timeline.received_ns(timeline.at(age_ns + before_ns)),
        to_ns=end_ns if is_over else at_ns + after_ns,
        made_ns=time.time_ns(),
        versions={
            "amberbox": __version__,
            "software_version": options.software_version,
            "config_hash": first.config_hash or options.config_hash,
            "store_id": store.id,
            "run": str(since.run),
        },
        spans=spans,
        since=since,
        after_ns=after_ns,
        state="complete" if is_over else "open",
    )


def _id(at_ns: int, key: str) -> str:
    """Return an incident's id: its time and 4 hex digits, the same ones for the same firing."""
    digits = hashlib.sha256(key.encode()).hexdigest()[:4] if key else uuid.uuid4().hex[:4]
    moment = datetime.fromtimestamp(at_ns // NS, UTC)
    return f"{moment:%Y-%m-%d-%H%M%S}-{digits}"


def _to_join(made: StoredIncident, known: Iterable[StoredIncident]) -> StoredIncident | None:
    """Find the incident that a new window belongs to: an open one, or one of the same trigger."""
    for other in known:
        same = bool(made.trigger) and made.trigger == other.trigger
        takes = other.is_pinned and not other.confirmed and (other.state == "open" or same)
        if takes and any(other.holds(s.run, s.from_ns, s.to_ns) for s in made.spans):
            return other
    return None


def _join(old: StoredIncident, new: StoredIncident, timeline: RecordTimeline) -> StoredIncident:
    """Return an incident extended by the window of another."""
    later = _ends_later(old, new, timeline)
    return replace(
        old,
        reasons=(*old.reasons, *new.reasons),
        from_ns=min(old.from_ns, new.from_ns),
        to_ns=max(old.to_ns, new.to_ns) if later else old.to_ns,
        spans=joined_spans(old.spans, new.spans),
        since=new.since if later else old.since,
        after_ns=new.after_ns if later else old.after_ns,
        state=new.state if later else old.state,
    )


def _ends_later(old: StoredIncident, new: StoredIncident, timeline: RecordTimeline) -> bool:
    ages = timeline.age_ns(old.since), timeline.age_ns(new.since)
    if ages[0] is None or ages[1] is None:
        return ages[0] is None
    return ages[1] - new.after_ns <= ages[0] - old.after_ns


def joined_spans(first: Sequence[LogSpan], second: Sequence[LogSpan]) -> tuple[LogSpan, ...]:
    """Join two windows; spans of a run that meet become one."""
    found: list[LogSpan] = []
    for span in sorted([*first, *second], key=lambda s: (s.run, s.from_ns)):
        last = found[-1] if found else None
        if last is not None and last.meets(span.run, span.from_ns - NS, span.to_ns):
            found[-1] = replace(last, to_ns=max(last.to_ns, span.to_ns))
        else:
            found.append(span)
    return tuple(found)


def _publish(store: Store, incident: StoredIncident) -> StoredIncident:
    """Make an incident appear whole: its folder gets its name last."""
    folder = store.path / INCIDENTS
    folder.mkdir(exist_ok=True)
    while incident_folder(store, incident.id).exists():
        incident = replace(incident, id=f"{incident.id[:18]}{uuid.uuid4().hex[:4]}")
    part = folder / f".{incident.id}"
    part.mkdir()
    hold_ring(store, incident, part)
    replace_file(part / FILE, encoded(incident))
    part.rename(folder / incident.id)
    sync_folder(folder)
    return incident


def hold_ring(
    store: Store, incident: StoredIncident, folder: Path, *, is_over: bool = True
) -> None:
    """Link the ring's journals that overlap a window into a folder.

    Where the ring is on another file system they are copied, a growing one when all ``is_over``.
    """
    paths = sorted(store.folder("ring").glob("*.mcap"), key=run_and_number)
    for path in paths:
        found = extent(path)
        if found is not None and incident.holds(found.run, found.start_ns, found.end_ns):
            (folder / RING).mkdir(exist_ok=True)
            _hold(path, folder / RING / path.name, grows=path == paths[-1] and not is_over)
    if (folder / RING).exists():
        sync_folder(folder / RING)


def _hold(path: Path, target: Path, *, grows: bool) -> None:
    try:
        if not target.exists():
            os.link(path, target)
        elif target.stat().st_size != path.stat().st_size and not grows:  # never so for a link
            _copy(path, target)
    except FileNotFoundError:  # the ring has moved on just now
        return
    except OSError:  # another file system, or one without links
        _copy(path, target)


def _copy(path: Path, target: Path) -> None:
    part = target.with_suffix(".part")
    shutil.copyfile(path, part)
    with part.open("rb") as file:
        os.fsync(file.fileno())
    part.replace(target)


def advance(
    store: Store, incident: StoredIncident, options: RetentionOptions | None = None
) -> StoredIncident:
    """Add the journals since an incident was opened; complete it once its window has passed.

    Without a recorder no more journals will come. With ``options`` a window ends early, ``cut``,
    before incidents hold more than they may.
    """
    with pin_lock(store):
        current = next((i for i in load_all(store) if i.id == incident.id), None)
        if current is None or current.state != "open":
            return current or incident
        alive = is_locked(store, "main")
        timeline = look_back(store, 0, current.since)
        if timeline is None:
            return current
        age_ns = timeline.age_ns(current.since)
        end_age_ns = (timeline.pieces[-1].start_age_ns if age_ns is None else age_ns) - (
            current.after_ns
        )
        is_over = end_age_ns >= 0 or not alive
        hold_ring(store, current, incident_folder(store, current.id), is_over=is_over)
        if is_over:
            return _completed(store, _ended(current, timeline, max(end_age_ns, 0)))
        if options is None or _fits(store, current, options):
            return current
        # complete a window early, with as much of it as incidents may hold
        since_age_ns = timeline.age_ns(current.since) or 0
        ended = (
            _ended(current, timeline, since_age_ns * part // _CUTS) for part in range(_CUTS + 1)
        )
        done = next((one for one in ended if _fits(store, one, options)), None)
        return _completed(store, replace(done or _ended(current, timeline, since_age_ns), cut=True))


def _fits(store: Store, incident: StoredIncident, options: RetentionOptions) -> bool:
    return refused_by_budget(store, incident, load_all(store), options) is None


def _ended(incident: StoredIncident, timeline: RecordTimeline, end_age_ns: int) -> StoredIncident:
    """Return an incident as complete, with a window that ends ``end_age_ns`` before the record's
    end.
    """
    since_age_ns = timeline.age_ns(incident.since) or 0
    spans = joined_spans(incident.spans, timeline.spans(since_age_ns, end_age_ns))
    to_ns = timeline.received_ns(timeline.at(end_age_ns)) + 1
    return replace(incident, spans=spans, to_ns=to_ns, state="complete", told="")


def _completed(store: Store, done: StoredIncident) -> StoredIncident:
    # remove links of journals that were begun after the window had ended
    for path in (incident_folder(store, done.id) / RING).glob("*.mcap"):
        found = extent(path)
        if found is not None and not done.holds(found.run, found.start_ns, found.end_ns):
            path.unlink()
    return save(store, done)


def release(store: Store, incident: StoredIncident) -> StoredIncident:
    """Release an incident: its copies of the ring are removed, its window is no longer pinned."""
    with pin_lock(store):
        released = save(store, replace(incident, state="released", told="", bytes=0))
        shutil.rmtree(incident_folder(store, incident.id) / RING, ignore_errors=True)
    return released


def mark(
    where: str | Path,
    *,
    before_s: float = 60.0,
    after_s: float = 20.0,
    reason: str = "",
    who: str = "",
    trigger: str = "",
) -> StoredIncident:
    """Keep all items from ``before_s`` before the end of the record until ``after_s`` from now.

    It is pinned when this returns, also while neither recorder nor keeper run. Raises UsageError
    if there is no record at ``where``, AmberboxError if incidents hold as much as they may.
    """
    store = open_store(store_path(where))
    wish = PinRequest(before_s, after_s, reason, who or user(), trigger)
    done = pin(store, wish, options_of(where))
    if isinstance(done, PinRefusal):
        submit(store, "incident", {"refused": done.reason, "reason": reason, "who": wish.who})
        raise AmberboxError(
            f"not pinned: {done.reason}",
            f"amberbox incident list {where}; amberbox incident release {where} ID",
        )
    return done


def release_incident(where: str | Path, incident_id: str) -> StoredIncident:
    """Release an incident; raises UsageError when there is none of this id."""
    store = open_store(store_path(where))
    return release(store, load(store, incident_id))


def options_of(where: str | Path) -> RetentionOptions:
    """Return the retention options of a robot folder; the defaults for a store alone."""
    if is_store(Path(where)):
        return RetentionOptions()
    try:
        return retention_options_of(load_folder(where))
    except ConfigurationError:  # an error in the folder must not prevent this
        return RetentionOptions()


def user() -> str:
    """Return the name of the logged-in user, as far as it is known."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no such user, as in a container
        return ""
