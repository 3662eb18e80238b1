"""What the recorder does when the box's own power changes: hurry, mark an incident, end in time."""

from __future__ import annotations

import threading

from amberbox.blackbox import requests
from amberbox.blackbox.recorder.pipeline import Pipeline
from amberbox.blackbox.recorder.syncer import Syncer
from amberbox.core.source import Power

CAREFUL_SYNC_S = 0.2
"""On battery a power cut may come at any time, and shall not cost more than this."""
LOST = {
    "before_s": 60,
    "after_s": 20,
    "reason": "external power lost",
    "who": "recorder",
    "trigger": "power",
}
"""The incident that is asked for when external power is lost."""


class PowerWatch:
    """Acts on what a source says about the box's power; belongs to the writing thread.

    A run that begins with a low battery records on: the one before has ended because of it, and
    whoever starts a recorder again wants a record.
    """

    def __init__(self, pipeline: Pipeline, syncer: Syncer, sync_s: float) -> None:
        self._pipeline = pipeline
        self._syncer = syncer
        self._sync_s = sync_s
        self._state: Power | None = None
        self._request: threading.Thread | None = None

    def ends_run(self) -> bool:
        """Act on a change of power; True when the run has to end while there is some."""
        before, state = self._state, self._pipeline.power
        if state == before:
            return False
        self._state = state
        if state == "mains":
            self._syncer.every(self._sync_s)
            return False
        self._syncer.at_once(min(self._sync_s, CAREFUL_SYNC_S))
        if before == "mains":
            self._mark_incident()
        return state == "low" and before is not None

    def _mark_incident(self) -> None:
        """Ask the keeper for an incident, in a thread: the disk may be slow, and power short."""
        self._request = threading.Thread(target=self._ask, daemon=True)
        self._request.start()

    def _ask(self) -> None:
        try:
            requests.submit(self._pipeline.store, "incident", LOST)
        except OSError as error:
            text = f"the incident of the lost power is not marked: {error.strerror}"
            self._pipeline.event("disk", text)

    def stop(self) -> None:
        """Wait for the request that is under way."""
        if self._request is not None:
            self._request.join()
