"""What a team's recorder reads of a member: the member's statuses, as they come to the server."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from amberbox.blackbox.store import FOLDERS, create_store
from amberbox.core.clock import NS, Clock

WRITER = "watch"
CHANNELS = (reserved.STATUS, reserved.ALARM)
KEPT_FILES = 3
"""Files of a member that stay; what is older stands in the archive."""
_ROTATE_BYTES = 4_000_000


@dataclass(frozen=True, slots=True)
class Heard:
    """A record of a member that is about now: when that is by the member's own clock."""

    channel: str
    log_ns: int
    data: bytes


class MemberStore:
    """A store like the member's own, with nothing but what its watcher says now."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self.store = create_store(path)
        folder = path / FOLDERS[WRITER]
        options = JournalOptions(
            folder, self.store.id, WRITER, self.store.next_run(), clock.boot_id(), _ROTATE_BYTES
        )
        self._writer = JournalWriter(options)
        self._numbers = {name: self._channel(name) for name in CHANNELS}
        self._last_ns = 0

    def say(self, heard: Sequence[Heard]) -> None:
        """Write records; their times never go back."""
        if not heard:
            return
        if self._writer.rotation_due(heard[0].log_ns):
            self._rotate()
        times = list(
            itertools.accumulate((one.log_ns for one in heard), max, initial=self._last_ns)
        )
        self._last_ns = times[-1]
        numbers = [self._numbers[one.channel] for one in heard]
        self._writer.write(numbers, times[1:], times[1:], [one.data for one in heard])

    def close(self) -> None:
        """Finish the journal."""
        self._writer.close()

    def _rotate(self) -> None:
        self._writer.rotate()
        self._writer.mark_sync().wait()
        for path in self.store.journal_files(WRITER)[:-KEPT_FILES]:
            path.unlink(missing_ok=True)

    def _channel(self, name: str) -> int:
        marks = {"item": name.replace("/", "_"), "source": reserved.SOURCE}
        return self._writer.channel(reserved.topic_of(name), marks)


FRESH_NS = 10 * NS
"""What is older when it comes is the past: it is in the archive, no team judges by it."""
_SETTLED_NS = 3 * NS
_FEW_ROWS = 200


@dataclass
class Lateness:
    """How long after they were written a robot's records come, by what is known of its clock.

    ``ahead_ns`` is by how much the server's clock was ahead when the robot said hello. Its log
    time may differ from its clock since that was put right; a robot that has nothing left to send
    says what is so now, whatever its log time.
    """

    ahead_ns: int
    since_ns: int
    _of_run: dict[tuple[str, int], int] = field(default_factory=dict)

    def of(self, run: tuple[str, int], log_ns: int, now_ns: int, backlog: int) -> int:
        """Return how late a record of a run of the watcher is, in nanoseconds."""
        lag_ns = now_ns - log_ns
        known = self._of_run.get(run, self.ahead_ns)
        settled = now_ns - self.since_ns > _SETTLED_NS and backlog <= _FEW_ROWS
        if settled and abs(lag_ns - known) > FRESH_NS:
            known = self._of_run[run] = lag_ns
        return max(0, lag_ns - known)
