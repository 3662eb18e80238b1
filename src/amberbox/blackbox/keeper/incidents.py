"""The keeper's work on incidents: what was asked for, what triggers say, what is due."""

from __future__ import annotations

import sys

from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.keeper.ownjournal import OwnJournal
from amberbox.blackbox.keeper.pins import Pins
from amberbox.blackbox.keeper.triggers import Triggers
from amberbox.blackbox.store import Store


class IncidentKeeping:
    """Makes and follows the incidents of a store; costs next to nothing without any."""

    def __init__(self, store: Store, options: KeeperOptions, journal: OwnJournal) -> None:
        self._store, self._options, self._journal = store, options, journal
        self._pins = Pins(store, options, journal)
        self._triggers: Triggers | None = None
        self._trouble = ""

    def step(self) -> None:
        """Do what there is to do now; what a disk refuses is tried again next time."""
        try:
            self._pins.step()
            self._step_triggers()
        except OSError as error:
            self._say(error.strerror or str(error))
        else:
            self._trouble = ""

    def close(self) -> None:
        """Take what the end of the record brings, and tell what is left to tell."""
        self.step()
        try:
            if self._triggers is not None:
                self._triggers.close()
            self._pins.close()
        except OSError as error:
            self._say(error.strerror or str(error))

    def _step_triggers(self) -> None:
        if self._triggers is None and self._options.triggers:
            self._triggers = Triggers(self._store, self._options, self._journal, self._pins)
        if self._triggers is not None:
            self._triggers.step()

    def _say(self, trouble: str) -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            print(f"amberbox keeper: incidents: {trouble}", file=sys.stderr)
