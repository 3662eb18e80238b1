"""The diagnoses of a robot as its watcher writes them, one after the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from amberbox.blackbox.follow.records import OwnRecords
from amberbox.blackbox.store import Store
from amberbox.consult.journal import CHANNELS, findings
from amberbox.core.types import Diagnosis, Symptom
from amberbox.monitoring.messages.board import WRITER

_POLL_S = 0.1

Known = dict[str, Symptom]


def revisions(
    store: Store, wait: Callable[[float], None] = time.sleep
) -> Iterator[tuple[Diagnosis, Known]]:
    """Yield the diagnosis that stands now, if one does, then each revision as it is written.

    Each comes with what is known of the symptoms up to then, by id. Ends only when ``wait``
    raises something.
    """
    records = OwnRecords(store, WRITER, CHANNELS)
    known: Known = {}
    standing: Diagnosis | None = None
    for finding in findings(records.step()):
        standing = _heard(finding, known) or standing
    if standing is not None and standing.state == "open":
        yield standing, dict(known)
    while True:
        for finding in findings(records.step()):
            revised = _heard(finding, known)
            if revised is not None and _tells_more(revised, standing):
                standing = revised
                yield revised, dict(known)
        wait(_POLL_S)


def _heard(finding: Symptom | Diagnosis, known: Known) -> Diagnosis | None:
    if isinstance(finding, Diagnosis):
        return finding
    known[finding.id] = finding
    return None


def _tells_more(revised: Diagnosis, standing: Diagnosis | None) -> bool:
    """Tell whether it is not what was said before: each file begins with what stands."""
    if standing is None:
        return True
    return (revised.id, revised.revision, revised.state) != (
        standing.id,
        standing.revision,
        standing.state,
    )
