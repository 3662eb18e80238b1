"""The engine over a record: blocks in, findings out; the same live and in replay."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from amberbox.core.types import Batch, Status
from amberbox.monitoring.engine.findings import Finding, is_live_only
from amberbox.monitoring.engine.states import States
from amberbox.monitoring.watcher.epoch import Epoch
from amberbox.monitoring.watcher.memory import Memory, Place
from amberbox.monitoring.watcher.reader import Block


class Evaluates(Protocol):
    """What is asked of the engine."""

    @property
    def items(self) -> frozenset[str]:
        """Names of the items that are wanted from the record."""

    @property
    def history_s(self) -> float:
        """How far it looks back."""

    def begin(self, at_ns: int) -> None:
        """Begin an epoch."""

    def feed(self, batch: Batch) -> None:
        """Take rows."""

    def advance(self, until_ns: int) -> Sequence[Finding]:
        """Evaluate up to an instant."""

    def statuses(self) -> Sequence[Status]:
        """Return the newest status of each mode and component."""

    @property
    def states(self) -> States:
        """What it knows of components and their alarms."""

    def snapshot(self) -> dict[str, Any]:
        """Return all that is needed to go on, beside the rows of the last time."""

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot."""


@dataclass(slots=True)
class Evaluation:
    """Feeds an engine block by block, and knows up to which instant it has come.

    With a memory it goes on there: what was found before is not given again.
    """

    engine: Evaluates
    memory: Memory = field(default_factory=Memory)
    place: Place | None = None
    trouble: str = ""
    """Why what was remembered could not be used; empty if it could."""
    anew: bool = False
    """It did not go on with what was remembered, but for the alarms."""
    _epoch: Epoch | None = None
    _known: Place | None = None
    _more: int = 0

    def __post_init__(self) -> None:
        self._known, self._more = self.memory.place, self.memory.more

    def take(self, block: Block) -> Iterator[list[Finding]]:
        """Evaluate a block; give what is new in it, once ``place`` has been moved on."""
        if block.epoch != self._epoch and not self._enter(block.epoch, block.start_ns):
            return
        for batch in block.batches:
            self.engine.feed(batch)
        if self.place is not None and block.until_ns <= self.place.until_ns:
            return
        if self._known is not None:
            self._repeat(self._known, block)
        if self._known is None and (self.place is None or block.until_ns > self.place.until_ns):
            found = list(self.engine.advance(block.until_ns))
            self.place = Place(block.epoch, block.until_ns)
            yield self._new(found)

    def _new(self, found: list[Finding]) -> list[Finding]:
        """Leave out what was written before; a replay's findings alone were counted there."""
        for place, finding in enumerate(found):
            if not self._more:
                return found[place:]
            self._more -= not is_live_only(finding)
        return []

    def _enter(self, epoch: Epoch, start_ns: int) -> bool:
        """Go over to an epoch; False for one that lies before what is remembered."""
        if self._known is not None and self._epoch == self._known.epoch:
            self._known = None
        left = self.memory.checkpoint
        if self._epoch is None and left is not None:
            if epoch != left.place.epoch and epoch.run <= left.place.epoch.run:
                return False
            is_there = epoch == left.place.epoch
            if is_there and left.engine and self.memory.is_ours and self._resumed(left.engine):
                self._epoch, self.place = epoch, left.place
                return True
            self._take_alarms(left.engine)
        self.anew = self.anew or self._epoch is None
        self.engine.begin(start_ns)
        self._epoch, self.place = epoch, None
        return True

    def _resumed(self, engine: Mapping[str, Any]) -> bool:
        """Go on with what the engine knew; False, with the trouble, if it makes no sense of it."""
        try:
            self.engine.resume(engine)
        except Exception as error:  # it is of another version, or damaged: begin anew
            self.trouble = f"{type(error).__name__}: {error}"
            return False
        return True

    def _take_alarms(self, engine: Mapping[str, Any]) -> None:
        """Take the alarms alone from what was known: they and their ids outlast the monitors."""
        if "states" not in engine:
            return
        try:
            self.engine.states.resume({**engine["states"], "config_hash": None})
        except Exception as error:  # as above
            self.trouble = f"{type(error).__name__}: {error}"

    @property
    def has_caught_up(self) -> bool:
        """Tell whether all that was written before is found again."""
        return self.place is not None and self._known is None and self._more == 0

    @property
    def is_behind(self) -> bool:
        """Tell whether what was evaluated before is not reached again yet."""
        return self._known is not None

    def _repeat(self, known: Place, block: Block) -> None:
        """Evaluate silently what has been evaluated, and written down, before."""
        if block.epoch.run > known.epoch.run:
            self._known, self._more = None, 0
            return
        is_there = block.epoch == known.epoch
        until_ns = min(block.until_ns, known.until_ns) if is_there else block.until_ns
        if self.place is None or until_ns > self.place.until_ns:
            self.engine.advance(until_ns)
            self.place = Place(block.epoch, until_ns)
        if is_there and block.until_ns >= known.until_ns:
            self._known = None
