"""The watcher's journal: findings, what probes measured, and how far the record is evaluated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from amberbox.blackbox.follow.chain import previous_chain
from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.keeper.ownjournal import OwnJournal, Progress, event
from amberbox.blackbox.keeper.ownstreams import Own, Row
from amberbox.blackbox.store import Store, run_and_number
from amberbox.core.clock import Clock
from amberbox.core.types import Status
from amberbox.monitoring.engine.findings import Finding
from amberbox.monitoring.messages.records import SOURCE, encoded
from amberbox.monitoring.watcher.axis import RecordAxis
from amberbox.monitoring.watcher.epoch import Epoch
from amberbox.monitoring.watcher.memory import Place


class Journal:
    """Writes what the watcher has to say on the time axis of the record that it follows."""

    def __init__(
        self,
        store: Store,
        robot: str,
        config_hash: str,
        clock: Clock,
        standing: Callable[[], Sequence[Finding]] = tuple,
    ) -> None:
        """Prepare to write; each file begins with the alarms that are ``standing`` then."""
        self._store = store
        self._clock = clock
        self._own = OwnJournal(
            store, "watch", robot=robot, config_hash=config_hash, clock=clock,
            chain=lambda: previous_chain(store, "watch"),
            first=lambda: [Own(*encoded(finding)) for finding in standing()],
        )  # fmt: skip
        self._axis: RecordAxis | None = None

    @property
    def epoch(self) -> Epoch | None:
        """The epoch that is followed."""
        return None if self._axis is None else self._axis.epoch

    @property
    def is_live(self) -> bool:
        """Tell whether a record of this boot is followed, so that it is now there, too."""
        return self._axis is not None and self._axis.same_boot

    def now_ns(self) -> int:
        """Log time of what is written now."""
        return self._own.now_ns()

    def follow(self, epoch: Epoch) -> None:
        """Go over to the axis of an epoch; what is written from now on belongs to it."""
        if self.epoch != epoch:
            same_boot = _boot_of(self._store, epoch.run) == self._clock.boot_id()
            self._axis = RecordAxis(self._clock, epoch, same_boot)
            self._own.begin_run(self._axis, str(epoch))

    def passed(self, place: Place) -> None:
        """Write nothing any more at or before a place."""
        self.follow(place.epoch)
        assert self._axis is not None
        self._axis.passed(place.until_ns)

    def measured(self, rows: Sequence[Row]) -> None:
        """Write what probes have measured."""
        self._own.append(rows)

    def found(self, findings: Sequence[Finding], notes: Sequence[Progress]) -> None:
        """Write findings with what is to be remembered beside them."""
        urgent = any(not isinstance(finding, Status) for finding in findings)
        self._own.append([Own(*encoded(finding)) for finding in findings], notes, urgent=urgent)

    def told(self, kind: str, text: str) -> None:
        """Write an event about the watcher itself."""
        topic, values = event(kind, text, SOURCE, live_only=True)
        self._own.append([Own(topic, msgspec.json.encode(values))], urgent=True)

    def close(self) -> None:
        """Finish the journal."""
        self._own.close()


def _boot_of(store: Store, run: int) -> str:
    """Return in which boot a run of the recorder was written; empty if its files are gone."""
    of_run = (path for path in store.journal_files("main") if run_and_number(path)[0] == run)
    return _started(next(of_run, None))


def _started(path: Path | None) -> str:
    try:
        return "" if path is None else str(start_record(path).get("boot_id", ""))
    except OSError:  # deleted meanwhile
        return ""
