"""What may not be deleted: the windows of incidents, and the ring's journals they still need."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.blackbox.deletion.rule import Window
from amberbox.blackbox.store import INCIDENTS, Store

if TYPE_CHECKING:
    from amberbox.blackbox.incidents import Incident


def pinning(store: Store) -> list[Incident]:
    """Return the incidents that hold a window; for what is to be deleted, under the pin lock."""
    from amberbox.blackbox.incidents import load_all  # which import the keeper's options

    return [incident for incident in load_all(store) if incident.is_pinned]


def release_confirmed(store: Store) -> str | None:
    """Let go of the oldest incident that a server holds; return its id, None if there is none."""
    from amberbox.blackbox.incidents import release

    confirmed = [incident for incident in pinning(store) if incident.confirmed]
    if not confirmed:
        return None
    release(store, confirmed[0])
    return confirmed[0].id


def is_needed(store: Store, window: Window, path: Path) -> bool:
    """Tell whether an incident holds this journal of the ring and has no copy or link of it yet."""
    for incident in pinning(store):
        if incident.holds_received(window.run, window.start_ns, window.end_ns):
            copy = store.path / INCIDENTS / incident.id / path.parent.name / path.name
            if not copy.exists() or copy.stat().st_size < path.stat().st_size:
                return True
    return False
