"""An incident file: a window of the record that is kept, with reason and originator."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.store import INCIDENTS, Store
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.files import below, replace_file
from amberbox.core.timestamps import format_time

FILE = "incident.json"
RING = "ring"
IncidentState = Literal["open", "complete", "released"]
# Corrected times may differ from log time plus offset by smaller steps of the wall clock
_SLEW_NS = 2 * NS


class LogMoment(NamedTuple):
    """A moment of the record: log time within a run."""

    run: int
    log_ns: int


@dataclass(frozen=True, slots=True)
class LogSpan:
    """A stretch of a run without a step of the clock, in log time, both ends inclusive.

    ``offset_ns`` leads from log time to the time of receipt, as far as was known when it was made.
    """

    run: int
    from_ns: int
    to_ns: int
    offset_ns: int = 0

    def meets(self, run: int, from_ns: int, to_ns: int) -> bool:
        """Return whether rows of ``[from_ns, to_ns]`` (log time) may be in the window."""
        return run == self.run and from_ns <= self.to_ns and to_ns >= self.from_ns

    def received(self) -> tuple[int, int]:
        """Return the range in times of receipt, ``[from, to)``."""
        return self.from_ns + self.offset_ns, self.to_ns + self.offset_ns + 1


@dataclass(frozen=True, slots=True)
class IncidentReason:
    """Why a window is kept; ``at_ns`` is the time of receipt that it is about.

    ``key`` identifies a trigger's firing, so that none counts twice.
    """

    at_ns: int
    text: str
    who: str = ""
    trigger: str = ""
    key: str = ""


@dataclass(frozen=True, slots=True)
class StoredIncident:
    """A window of all items that is not deleted before it is confirmed or released.

    ``spans`` are the pinned ranges; while it is ``open``, all rows from ``since`` on are pinned
    too, and the window ends ``after_ns`` later. ``told`` is the last state written to the
    maintenance journal; ``cut``: the window ended early because incidents may not hold more data.
    """

    id: str
    reasons: tuple[IncidentReason, ...]
    from_ns: int
    to_ns: int
    made_ns: int
    versions: dict[str, str]
    spans: tuple[LogSpan, ...]
    since: LogMoment
    after_ns: int
    state: IncidentState = "open"
    confirmed: bool = False
    told: IncidentState | Literal[""] = ""
    bytes: int = 0
    cut: bool = False

    @property
    def is_pinned(self) -> bool:
        """Return whether it holds anything."""
        return self.state != "released"

    @property
    def text(self) -> str:
        """Return its reasons in one line."""
        return "; ".join(dict.fromkeys(reason.text for reason in self.reasons if reason.text))

    @property
    def who(self) -> str:
        """Return the people and triggers that marked it."""
        return ", ".join(dict.fromkeys(r.who or r.trigger for r in self.reasons))

    @property
    def trigger(self) -> str:
        """Return the trigger that made it; empty for a person."""
        return self.reasons[0].trigger

    def holds(self, run: int, from_log_ns: int, to_log_ns: int) -> bool:
        """Return whether rows that a recorder wrote in ``[from, to]`` of log time are pinned."""
        if not self.is_pinned:
            return False
        if self.state == "open" and (run, to_log_ns) >= self.since:
            return True
        return any(span.meets(run, from_log_ns, to_log_ns) for span in self.spans)

    def holds_received(self, run: int, from_ns: int, to_ns: int) -> bool:
        """Return the same by times of receipt; true in doubt."""
        if not self.is_pinned:
            return False
        if self.state == "open" and run > self.since.run:
            return True
        return any(
            span.run == run
            and span.from_ns + span.offset_ns <= to_ns + _SLEW_NS
            and (span.to_ns + span.offset_ns >= from_ns - _SLEW_NS or self._grows(span))
            for span in self.spans
        )

    def _grows(self, span: LogSpan) -> bool:
        return self.state == "open" and span is self.spans[-1]

    def to_json(self) -> dict[str, Any]:
        """Return the incident for programs: times are RFC 3339 strings."""
        reasons = [
            {"at": format_time(r.at_ns), "text": r.text, "who": r.who, "trigger": r.trigger}
            for r in self.reasons
        ]
        return {
            "id": self.id,
            "state": self.state,
            "confirmed": self.confirmed,
            "from": format_time(self.from_ns),
            "to": format_time(self.to_ns),
            "made": format_time(self.made_ns),
            "reasons": reasons,
            "who": self.who,
            "trigger": self.trigger,
            "versions": self.versions,
        }


def incident_folder(store: Store, incident_id: str) -> Path:
    """Return the folder of an incident; raises AmberboxError for an id that leads elsewhere."""
    return below(store.path / INCIDENTS, incident_id)


def load_all(store: Store) -> list[StoredIncident]:
    """Return the incidents of a store, released ones included, in order of their windows.

    Where a file cannot be read or is gone, the manifest's entry of the incident is returned.
    """
    paths = {path.parent.name: path for path in _files(store)}
    ids = paths.keys() | manifest.read(store.path).incidents.keys()
    read = ((paths.get(i) and _read(paths[i])) or _from_manifest(store, i) for i in sorted(ids))
    found = [i for i in read if i is not None and (i.id in paths or i.is_pinned)]
    return sorted(found, key=lambda incident: (incident.from_ns, incident.id))


def damaged_files(store: Store) -> list[Path]:
    """Return the files of incidents that are damaged, or are gone while they hold a window."""
    pinned = (incident.id for incident in load_all(store))
    paths = {*_files(store), *(incident_folder(store, i) / FILE for i in pinned)}
    return sorted(path for path in paths if _is_damaged(store, path))


def _is_damaged(store: Store, path: Path) -> bool:
    found, registered = _read(path), _from_manifest(store, path.parent.name)
    if found is None or registered is None:
        return found is None
    return found.told == found.state and not same_window(found, registered)


def same_window(found: StoredIncident, registered: StoredIncident) -> bool:
    """Return whether an incident's file agrees with the manifest."""
    return _compared(found) == _compared(registered)


def _compared(incident: StoredIncident) -> dict[str, Any]:
    line = to_line(incident, 0)
    return {key: value for key, value in line.items() if key != "at_ns"}


def rewrite_from_manifest(store: Store, incident_id: str) -> bool:
    """Write the file of an incident from the manifest; return whether that has an entry of it.

    The caller holds the pin lock.
    """
    incident = _from_manifest(store, incident_id)
    if incident is not None:
        incident_folder(store, incident_id).mkdir(parents=True, exist_ok=True)
        save(store, incident)
    return incident is not None


def _files(store: Store) -> list[Path]:
    return sorted((store.path / INCIDENTS).glob(f"[!.]*/{FILE}"))


def _read(path: Path) -> StoredIncident | None:
    with suppress(FileNotFoundError):
        status = path.stat()
        return _decoded(path, status.st_mtime_ns, status.st_ino)
    return None


@lru_cache(maxsize=4096)
def _decoded(path: Path, _mtime_ns: int, _inode: int) -> StoredIncident | None:
    with suppress(msgspec.MsgspecError):
        return msgspec.json.decode(path.read_bytes(), type=StoredIncident)
    return None


def _from_manifest(store: Store, incident_id: str) -> StoredIncident | None:
    """Return an incident as the maintenance process has written it; None if it has not yet."""
    line = manifest.read(store.path).incidents.get(incident_id)
    with suppress(KeyError, TypeError, IndexError, AttributeError, ValueError):
        return None if line is None else from_line(line)
    return None


def to_line(incident: StoredIncident, at_ns: int) -> dict[str, Any]:
    """Return an incident as a line of the manifest."""
    about = {
        "id": incident.id,
        "state": incident.state,
        "reason": incident.text,
        "who": incident.who,
        "trigger": incident.trigger,
        "from_ns": incident.from_ns,
        "to_ns": incident.to_ns,
    }
    return {
        "kind": "incident",
        "incident": about,
        "spans": [[s.run, s.from_ns, s.to_ns, s.offset_ns] for s in incident.spans],
        "reasons": [[r.at_ns, r.text, r.who, r.trigger, r.key] for r in incident.reasons],
        "since": list(incident.since),
        "after_ns": incident.after_ns,
        "versions": incident.versions,
        "made_ns": incident.made_ns,
        "at_ns": at_ns,
    }


def from_line(line: Mapping[str, Any]) -> StoredIncident:
    """Read what ``to_line`` returned."""
    about = line["incident"]
    return StoredIncident(
        id=about["id"],
        reasons=tuple(IncidentReason(*reason) for reason in line["reasons"]),
        from_ns=about["from_ns"],
        to_ns=about["to_ns"],
        made_ns=line["made_ns"],
        versions=dict(line["versions"]),
        spans=tuple(LogSpan(*span) for span in line["spans"]),
        since=LogMoment(*line["since"]),
        after_ns=line["after_ns"],
        state=about["state"],
        told=about["state"],
        bytes=line.get("bytes", 0),
    )


def load(store: Store, incident_id: str) -> StoredIncident:
    """Return one incident; raises UsageError when there is none of this id."""
    known = {incident.id: incident for incident in load_all(store)}
    if incident_id in known:
        return known[incident_id]
    raise UsageError(
        f"there is no incident '{incident_id}'{did_you_mean(incident_id, known)}",
        f"amberbox incident list {store.path}",
    )


def incident_named(store: Store, text: str) -> StoredIncident:
    """Return the incident of an id; ``last`` is the one made last."""
    known = load_all(store) if text == "last" else ()
    return max(known, key=lambda incident: incident.made_ns) if known else load(store, text)


def encoded(incident: StoredIncident) -> str:
    """Write an incident as its file has it."""
    return msgspec.json.format(msgspec.json.encode(incident), indent=2).decode()


def save(store: Store, incident: StoredIncident) -> StoredIncident:
    """Replace the file of an existing incident; the caller holds the pin lock."""
    replace_file(incident_folder(store, incident.id) / FILE, encoded(incident))
    return incident


def remove_leftovers(store: Store) -> None:
    """Remove the files of a process that died while pinning; the caller holds the pin lock."""
    for path in (store.path / INCIDENTS).glob(".*"):
        shutil.rmtree(path, ignore_errors=True)


def incident_of_firing(incidents: Collection[StoredIncident], key: str) -> StoredIncident | None:
    """Return the incident that a firing has been taken into, if it has."""
    return next((i for i in incidents if any(r.key == key for r in i.reasons)), None)
