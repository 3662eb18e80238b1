"""A diagnosis that fails must not take the monitors with it: they go on without one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.types import Batch, Diagnosis, Status, Symptom
from amberbox.monitoring.messages.diagnoses import diagnosis_of, diagnosis_values
from amberbox.monitoring.watcher.diagnosing import Diagnoser, MakeDiagnoser
from amberbox.monitoring.watcher.standing import closed


class Surviving:
    """A diagnoser that ends with its trouble when it raises an error, until the next epoch.

    The diagnosis that was open is then over; a replay, which raises the error, does not see that.
    """

    def __init__(self, make: MakeDiagnoser) -> None:
        self._make = make
        self._diagnoser: Diagnoser | None = make()
        self.items = self._diagnoser.items
        self.history_s = self._diagnoser.history_s
        self.facts = self._diagnoser.facts
        self._open: Diagnosis | None = None
        self.trouble = ""
        """Why it has failed; whoever has told it empties it."""

    def begin(self, at_ns: int) -> None:
        """Begin an epoch; what has failed begins anew."""
        if self._diagnoser is None:
            self._diagnoser = self._make()
        self._diagnoser.begin(at_ns)

    def feed(self, batch: Batch) -> None:
        """Take rows."""
        if self._diagnoser is not None:
            try:
                self._diagnoser.feed(batch)
            except Exception as error:  # whatever it is, statuses and alarms matter more
                self._fail(error)

    def advance(
        self, found: Sequence[Status | Symptom], until_ns: int
    ) -> Sequence[Symptom | Diagnosis]:
        """Return what follows; the end of the open diagnosis where it has failed."""
        said: Sequence[Symptom | Diagnosis] = ()
        if self._diagnoser is not None:
            try:
                said = self._diagnoser.advance(found, until_ns)
            except Exception as error:  # as above
                self._fail(error)
        if self._diagnoser is None and self._open is not None:
            said = [closed(self._open, until_ns)]
        for finding in said:
            if isinstance(finding, Diagnosis):
                self._open = finding if finding.state == "open" else None
        return said

    def _fail(self, error: Exception) -> None:
        self._diagnoser = None
        self.trouble = f"{type(error).__name__}: {error}"

    def snapshot(self) -> dict[str, Any]:
        """Return all that is needed to go on."""
        return {
            "of": None if self._diagnoser is None else self._diagnoser.snapshot(),
            "open": None if self._open is None else diagnosis_values(self._open),
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot; what has failed stays so until the next epoch."""
        if snapshot["of"] is None or self._diagnoser is None:
            self._diagnoser = None
        else:
            self._diagnoser.resume(snapshot["of"])
        self._open = None if snapshot["open"] is None else diagnosis_of(snapshot["open"])
