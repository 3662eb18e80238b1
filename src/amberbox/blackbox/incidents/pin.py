"""Pin a window of the record: a small file that says so, and hard links of the ring's journals.

Any process may do it at any time, also while recorder or keeper are dead.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from amberbox import __version__
from amberbox.blackbox.deletion.pinlock import pin_lock
from amberbox.blackbox.incidents.budget import Refusal, refused_by_budget
from amberbox.blackbox.incidents.extent import extent
from amberbox.blackbox.incidents.incident import (
    FILE,
    RING,
    At,
    Incident,
    Reason,
    Span,
    encoded,
    folder_of,
    load_all,
    remove_leftovers,
    save,
    triggered,
)
from amberbox.blackbox.incidents.timeline import Timeline, look_back
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.store import INCIDENTS, Store, is_locked, run_and_number
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.files import replace_file, sync_folder

_CUTS = 8
"""A window that holds too much ends after this many parts of it less one, or two, and so on."""


@dataclass(frozen=True, slots=True)
class Wish:
    """A window somebody wants: around a moment of the record, its end where none is given.

    Raises UsageError for one that has no length.
    """

    before_s: float
    after_s: float
    reason: str = ""
    who: str = ""
    trigger: str = ""
    at: At | None = None
    key: str = ""

    def __post_init__(self) -> None:
        if not (0 <= self.before_s < math.inf and 0 <= self.after_s < math.inf):
            raise UsageError("a window cannot be shorter than nothing", "before 60s, after 20s")


def pin(store: Store, wish: Wish, options: KeeperOptions) -> Incident | Refusal:
    """Pin a window, in an incident of its own or in one that it meets.

    Returns a Refusal where incidents would hold more than they may. Raises UsageError if nothing
    was recorded.
    """
    with pin_lock(store):
        remove_leftovers(store)
        known = load_all(store)
        before = triggered(known, wish.key) if wish.key else None
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
        return _publish(store, incident) if joined is None else _extend(store, incident)


def _new(store: Store, wish: Wish, timeline: Timeline, options: KeeperOptions) -> Incident:
    since = wish.at or timeline.end
    age_ns = timeline.age_ns(since) or 0
    before_ns, after_ns = round(wish.before_s * NS), round(wish.after_s * NS)
    end_age_ns = max(age_ns - after_ns, 0)
    spans = timeline.spans(age_ns + before_ns, end_age_ns)
    at_ns = timeline.received_ns(since)
    is_over = age_ns >= after_ns or not is_locked(store, "main")
    end_ns = timeline.received_ns(timeline.at(end_age_ns)) + 1
    first = timeline.pieces[0].first
    return Incident(
        id=_id(at_ns, wish.key),
        reasons=(Reason(at_ns, wish.reason, wish.who, wish.trigger, wish.key),),
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
    """Name an incident by its time and 4 hex digits, the same ones for the same firing."""
    digits = hashlib.sha256(key.encode()).hexdigest()[:4] if key else uuid.uuid4().hex[:4]
    moment = datetime.fromtimestamp(at_ns // NS, UTC)
    return f"{moment:%Y-%m-%d-%H%M%S}-{digits}"


def _to_join(made: Incident, known: Iterable[Incident]) -> Incident | None:
    """Find the incident that a new window belongs to: an open one, or one of the same trigger."""
    for other in known:
        same = bool(made.trigger) and made.trigger == other.trigger
        takes = other.is_pinned and not other.confirmed and (other.state == "open" or same)
        if takes and any(other.holds(s.run, s.from_ns, s.to_ns) for s in made.spans):
            return other
    return None


def _join(old: Incident, new: Incident, timeline: Timeline) -> Incident:
    """Widen an incident by the window of another."""
    later = _ends_later(old, new, timeline)
    return replace(
        old,
        reasons=(*old.reasons, *new.reasons),
        from_ns=min(old.from_ns, new.from_ns),
        to_ns=max(old.to_ns, new.to_ns) if later else old.to_ns,
        spans=joined(old.spans, new.spans),
        since=new.since if later else old.since,
        after_ns=new.after_ns if later else old.after_ns,
        state=new.state if later else old.state,
    )


def _ends_later(old: Incident, new: Incident, timeline: Timeline) -> bool:
    ages = timeline.age_ns(old.since), timeline.age_ns(new.since)
    if ages[0] is None or ages[1] is None:
        return ages[0] is None
    return ages[1] - new.after_ns <= ages[0] - old.after_ns


def joined(first: Sequence[Span], second: Sequence[Span]) -> tuple[Span, ...]:
    """Join two windows; spans of a run that meet become one."""
    found: list[Span] = []
    for span in sorted([*first, *second], key=lambda s: (s.run, s.from_ns)):
        last = found[-1] if found else None
        if last is not None and last.meets(span.run, span.from_ns - NS, span.to_ns):
            found[-1] = replace(last, to_ns=max(last.to_ns, span.to_ns))
        else:
            found.append(span)
    return tuple(found)


def _publish(store: Store, incident: Incident) -> Incident:
    """Make an incident appear whole: its folder gets its name last."""
    folder = store.path / INCIDENTS
    folder.mkdir(exist_ok=True)
    incident = _with_free_id(store, incident)
    part = folder / f".{incident.id}"
    part.mkdir()
    hold_ring(store, incident, part)
    replace_file(part / FILE, encoded(incident))
    part.rename(folder / incident.id)
    sync_folder(folder)
    return incident


def _with_free_id(store: Store, incident: Incident) -> Incident:
    while folder_of(store, incident.id).exists():
        incident = replace(incident, id=f"{incident.id[:18]}{uuid.uuid4().hex[:4]}")
    return incident


def _extend(store: Store, incident: Incident) -> Incident:
    hold_ring(store, incident, folder_of(store, incident.id))
    return save(store, replace(incident, told=""))


def hold_ring(store: Store, incident: Incident, folder: Path, *, is_over: bool = True) -> None:
    """Link the ring's journals that meet a window into a folder.

    Where the ring lies on another file system they are copied, a growing one when all ``is_over``.
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


def advance(store: Store, incident: Incident, options: KeeperOptions | None = None) -> Incident:
    """Take in what came since an incident was opened; complete it once its window has passed.

    Where nobody records any more, what is there is all there will be. With ``options`` a window
    ends early, ``cut``, before incidents hold more than they may.
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
        hold_ring(store, current, folder_of(store, current.id), is_over=is_over)
        if is_over:
            return _complete(store, current, timeline, max(end_age_ns, 0))
        if options is None or _fits(store, current, options):
            return current
        return _cut(store, current, timeline, options)


def _fits(store: Store, incident: Incident, options: KeeperOptions) -> bool:
    return refused_by_budget(store, incident, load_all(store), options) is None


def _cut(store: Store, incident: Incident, timeline: Timeline, options: KeeperOptions) -> Incident:
    """Complete a window early, with as much of it as incidents may hold."""
    since_age_ns = timeline.age_ns(incident.since) or 0
    ended = (_ended(incident, timeline, since_age_ns * part // _CUTS) for part in range(_CUTS + 1))
    done = next((one for one in ended if _fits(store, one, options)), None)
    return _completed(store, replace(done or _ended(incident, timeline, since_age_ns), cut=True))


def _complete(store: Store, incident: Incident, timeline: Timeline, end_age_ns: int) -> Incident:
    return _completed(store, _ended(incident, timeline, end_age_ns))


def _ended(incident: Incident, timeline: Timeline, end_age_ns: int) -> Incident:
    """Return an incident as it is complete when its window ends so long before the record's end."""
    since_age_ns = timeline.age_ns(incident.since) or 0
    spans = joined(incident.spans, timeline.spans(since_age_ns, end_age_ns))
    to_ns = timeline.received_ns(timeline.at(end_age_ns)) + 1
    return replace(incident, spans=spans, to_ns=to_ns, state="complete", told="")


def _completed(store: Store, done: Incident) -> Incident:
    _let_go_beyond(store, done)
    return save(store, done)


def _let_go_beyond(store: Store, incident: Incident) -> None:
    """Remove links of journals that were begun after the window had ended."""
    for path in (folder_of(store, incident.id) / RING).glob("*.mcap"):
        found = extent(path)
        if found is not None and not incident.holds(found.run, found.start_ns, found.end_ns):
            path.unlink()


def release(store: Store, incident: Incident) -> Incident:
    """Let go of a window: its copies of the ring are removed, and nothing is pinned any more."""
    with pin_lock(store):
        released = save(store, replace(incident, state="released", told="", bytes=0))
        shutil.rmtree(folder_of(store, incident.id) / RING, ignore_errors=True)
    return released
