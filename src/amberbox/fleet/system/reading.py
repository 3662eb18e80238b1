"""What the watchers of the system level say, read from the stores that they write."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from amberbox.blackbox.follow.newest import newest_records
from amberbox.blackbox.journal import reserved
from amberbox.blackbox.store import is_store, open_store
from amberbox.consult.journal import said_until
from amberbox.core.types import Diagnosis, Status
from amberbox.fleet.knowledge.listing import Known
from amberbox.monitoring.messages.board import WRITER
from amberbox.monitoring.messages.records import status_of

_LOOKBACK_S = 3.0
_FOREVER_NS = (1 << 63) - 1


def statuses(store: Path | None) -> list[Status]:
    """Return the newest status of each component and mode; empty while nothing was said."""
    if store is None or not is_store(store):
        return []
    found = newest_records(open_store(store), WRITER, {reserved.STATUS}, _LOOKBACK_S)
    told = (status_of(record.values) for record in found)
    newest = {(status.component, status.mode): status for status in told}
    return [newest[key] for key in sorted(newest)]


def diagnoses(store: Path | None) -> list[Known]:
    """Return the diagnoses of what is kept of the watcher's journal, the newest first."""
    if store is None or not is_store(store):
        return []
    found = _by_id(said_until(open_store(store), _FOREVER_NS).diagnoses)
    return sorted(found, key=lambda one: (-one.last.at_ns, one.id))


def _by_id(said: Iterable[Diagnosis]) -> list[Known]:
    by_id: dict[str, dict[tuple[int, str], Diagnosis]] = {}
    for diagnosis in said:
        revisions = by_id.setdefault(diagnosis.id, {})
        revisions.setdefault((diagnosis.revision, diagnosis.state), diagnosis)
    return [Known(name, tuple(revisions.values())) for name, revisions in by_id.items()]
