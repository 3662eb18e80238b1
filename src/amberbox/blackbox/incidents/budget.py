"""How much incidents hold of the record, and how much they may."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.deletion.limit import quota_bytes, room
from amberbox.blackbox.deletion.usage import DiskUse, bytes_of
from amberbox.blackbox.follow.follow import RECORDED
from amberbox.blackbox.incidents.extent import extent
from amberbox.blackbox.incidents.incident import RING, Incident, folder_of, load_all
from amberbox.blackbox.journal.head import read_head
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.segments.manifest import Part
from amberbox.blackbox.store import Store

_RAW = ("main", "bulk")
_OWN_SHARE = 16
"""This part of the limit is for what is never deleted: events, the manifest, own journals."""
Held = dict[tuple[int, int], int]
"""Bytes of each file, by device and inode: what several incidents hold counts once."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a window was not pinned."""

    reason: str


def held_files(store: Store, incidents: Iterable[Incident]) -> list[Path]:
    """Return the files that incidents hold: journals, segments, copies of the ring."""
    pinned = [incident for incident in incidents if incident.is_pinned]
    segments = (path for path, _ in _segments(store, pinned))
    return [*_copies(store, pinned), *_journals(store, pinned), *segments]


def held_bytes(store: Store, incidents: Iterable[Incident]) -> int:
    """Return how much incidents hold, each file once."""
    return sum(_sizes(held_files(store, incidents)).values())


def allowed_bytes(store: Store, options: KeeperOptions) -> int:
    """Return how much incidents may hold: their share, but never what recording needs to go on."""
    now = room(store, options, DiskUse(store.path).measure())
    writers = [w for w in RECORDED if next(store.folder(w).glob("*.mcap"), None) is not None]
    growing = options.headroom * len(writers)
    needed = options.reserve + now.headroom + growing + now.limit // _OWN_SHARE
    share = int(options.incident_share * quota_bytes(store, options))
    return max(0, min(share, now.limit - needed))


def pinned_journals(store: Store) -> frozenset[str]:
    """Name the journals (``folder/file``) whose rows, raw or as columns, are pinned."""
    pinned = [incident for incident in load_all(store) if incident.is_pinned]
    raw = {f"{path.parent.name}/{path.name}" for path in _journals(store, pinned, RECORDED)}
    columns = {p.journal for _, parts in _segments(store, pinned) for p in parts}
    return frozenset(raw | columns)


def refused_by_budget(
    store: Store, incident: Incident, known: Sequence[Incident], options: KeeperOptions
) -> Refusal | None:
    """Say why there is no room for one more incident, or for one that grows; None if there is."""
    pinned = [i for i in known if i.id != incident.id and i.is_pinned] + [incident]
    allowed = allowed_bytes(store, options)
    held = _lasting_bytes(store, pinned, options) + _still_in_ring(store, incident)
    if held <= allowed:
        return None
    return Refusal(f"incidents would hold {held} bytes, {allowed} are allowed; release some")


def _lasting_bytes(store: Store, pinned: Sequence[Incident], options: KeeperOptions) -> int:
    """Return how much cannot be deleted because of incidents, now and when files have grown.

    Columns count where their journal is gone; else they are there twice, and go when there is need.
    """
    journals = list(_journals(store, pinned, wide=True))
    raw = {f"{path.parent.name}/{path.name}" for path in journals}
    columns = [
        path
        for path, parts in _segments(store, pinned)
        if any(part.journal not in raw for part in parts)
    ]
    total = sum(_sizes([*_copies(store, pinned), *journals, *columns]).values())
    return total + sum(_growth(path, options) for path in journals)


def _growth(path: Path, options: KeeperOptions) -> int:
    """Return by how much a file may still grow: the one that its writer's head names."""
    head = read_head(path.parent)
    with suppress(FileNotFoundError):
        if head is not None and head.file == path.name:
            return max(0, options.headroom - bytes_of(path.stat()))
    return 0


def _still_in_ring(store: Store, incident: Incident) -> int:
    """Bytes of the ring's journals that are about to be held."""
    here = {path.name for path in (folder_of(store, incident.id) / RING).glob("*.mcap")}
    files = (path for path in store.folder("ring").glob("*.mcap") if path.name not in here)
    return sum(_sizes(path for path in files if _is_held(path, [incident])).values())


def _copies(store: Store, incidents: Sequence[Incident]) -> Iterator[Path]:
    for incident in incidents:
        yield from (folder_of(store, incident.id) / RING).glob("*")


def _journals(
    store: Store,
    incidents: Sequence[Incident],
    writers: Sequence[str] = _RAW,
    *,
    wide: bool = False,
) -> Iterator[Path]:
    """Give the journals of windows; ``wide``: all that are not deleted because of them."""
    sealed = manifest.read(store.path).sealed if incidents else {}
    for writer in writers if incidents else ():
        for path in store.folder(writer).glob("*.mcap"):
            entry = sealed.get(f"{path.parent.name}/{path.name}")
            may_be = entry is None or _may_be_held(entry, incidents)
            if may_be and ((wide and entry is not None) or _is_held(path, incidents, wide=wide)):
                yield path


def _may_be_held(entry: Sealed, incidents: Sequence[Incident]) -> bool:
    """Judge a journal by what the manifest says, so that few of thousands have to be opened."""
    run, start_ns, end_ns = entry.run, entry.start_ns, entry.end_ns
    return any(incident.holds_received(run, start_ns, end_ns) for incident in incidents)


def _is_held(path: Path, incidents: Sequence[Incident], *, wide: bool = False) -> bool:
    found = extent(path) if incidents else None
    if found is None:
        return False
    start_ns, end_ns = found.start_ns + found.offset_ns, found.end_ns + found.offset_ns
    return any(
        incident.holds(found.run, found.start_ns, found.end_ns)
        or (wide and incident.holds_received(found.run, start_ns, end_ns))
        for incident in incidents
    )


def _segments(store: Store, incidents: Sequence[Incident]) -> Iterator[tuple[Path, Sequence[Part]]]:
    """Give the segments that are held, and their parts that lie in a window."""
    for segments in manifest.read(store.path).segments.values() if incidents else ():
        for segment in segments:
            inside = [part for part in segment.parts if _meets(part, incidents)]
            if inside:
                yield store.path / segment.path, inside


def _meets(part: Part, incidents: Sequence[Incident]) -> bool:
    return any(incident.holds(part.run, part.from_ns, part.to_ns) for incident in incidents)


def _sizes(paths: Iterable[Path]) -> Held:
    found: Held = {}
    for path in paths:
        with suppress(FileNotFoundError):
            status = path.stat()
            found[status.st_dev, status.st_ino] = bytes_of(status)
    return found
