"""Monitors and diagnosis together: what the engine finds is diagnosed, and alarms get their cause.

Monitoring knows no diagnosis: whoever starts a watcher or a replay hands in what makes one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol, TypeAlias

from amberbox.core.types import Batch, Diagnosis, FaultFacts, Status, Symptom
from amberbox.monitoring.engine.findings import TICK_NS, AlarmChange, Finding
from amberbox.monitoring.engine.states import States
from amberbox.monitoring.watcher.causes import Causes
from amberbox.monitoring.watcher.evaluation import Evaluates
from amberbox.monitoring.watcher.instants import instant_of
from amberbox.monitoring.watcher.raising import Raised

PART = "diagnosing"
"""Where the snapshot of an engine has what the diagnosis knew."""


class Diagnoser(Protocol):
    """Makes diagnoses of what is found over time.

    It looks at no clock, and how rows and findings are split into calls does not matter.
    """

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose rows its own conditions read."""

    @property
    def history_s(self) -> float:
        """How far its conditions look back."""

    @property
    def facts(self) -> Mapping[str, FaultFacts]:
        """What is known of failure modes, by id; empty where nothing is."""

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: nothing is known; a diagnosis that is open stays open."""

    def feed(self, batch: Batch) -> None:
        """Take rows of any item; log times do not decrease."""

    def advance(
        self, found: Sequence[Status | Symptom], until_ns: int
    ) -> Sequence[Symptom | Diagnosis]:
        """Return what follows from what the monitors found up to an instant, in order of time."""

    def snapshot(self) -> dict[str, Any]:
        """Return all that is needed to go on, as JSON, beside the rows of ``history_s``."""

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot."""


MakeDiagnoser: TypeAlias = Callable[[], Diagnoser]


class Diagnosing:
    """An engine whose findings are diagnosed; without a diagnoser it is the engine alone."""

    def __init__(self, engine: Evaluates, diagnoser: Diagnoser | None = None) -> None:
        self._engine = engine
        self._diagnoser: Diagnoser = _Nobody() if diagnoser is None else diagnoser
        plan = engine.states.plan
        self._causes = Causes(self._diagnoser.facts, Raised(plan.robot, plan.config_hash))

    @property
    def items(self) -> frozenset[str]:
        """Names of the items that are wanted from the record."""
        return self._engine.items | self._diagnoser.items

    @property
    def history_s(self) -> float:
        """How far monitors and conditions look back."""
        return max(self._engine.history_s, self._diagnoser.history_s)

    @property
    def states(self) -> States:
        """What the engine knows of components and their alarms."""
        return self._engine.states

    @property
    def diagnosis(self) -> Diagnosis | None:
        """The last revision of the diagnosis that is open."""
        return self._causes.diagnosis

    def begin(self, at_ns: int) -> None:
        """Begin an epoch; alarms and an open diagnosis stay."""
        self._causes.know(self.states.alarms())
        self._engine.begin(at_ns)
        self._diagnoser.begin(at_ns // TICK_NS * TICK_NS)

    def feed(self, batch: Batch) -> None:
        """Take rows of any item; log times do not decrease."""
        self._engine.feed(batch)
        self._diagnoser.feed(batch)

    def advance(self, until_ns: int) -> list[Finding]:
        """Return what is found up to an instant, in order of time."""
        until_ns = until_ns // TICK_NS * TICK_NS
        found = self._engine.advance(until_ns)
        wanted = [finding for finding in found if isinstance(finding, Status | Symptom)]
        said = self._diagnoser.advance(wanted, until_ns)
        return list(self._causes.through(_merged(found, said) if said else found, until_ns))

    def statuses(self) -> Sequence[Status]:
        """Return the newest status of each mode and component."""
        return self._engine.statuses()

    def alarms(self) -> list[AlarmChange]:
        """Return the alarms that last, as they stand, with their causes."""
        return self._causes.named(self.states.alarms())

    def command(
        self, action: Any, alarm_id: str, who: str, at_ns: int, until_ns: int | None = None
    ) -> list[AlarmChange]:
        """Do what a person says of an alarm; raises UsageError if that makes no sense."""
        changes = self._causes.command(action, alarm_id, who, at_ns, until_ns)
        if changes is None:
            changes = self.states.command(action, alarm_id, who, at_ns, until_ns)
        return [self._causes.take(change) for change in changes]

    def snapshot(self) -> dict[str, Any]:
        """Return all that is needed to go on, beside the rows of ``history_s``."""
        part = {"diagnoser": self._diagnoser.snapshot(), "causes": self._causes.snapshot()}
        return {**self._engine.snapshot(), PART: part}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a snapshot; one without a diagnosis begins it anew."""
        self._engine.resume(snapshot)
        part = snapshot.get(PART)
        if part is None:
            self._causes.know(self.states.alarms())
            self._diagnoser.begin(int(snapshot["until_ns"]))
            return
        self._diagnoser.resume(part["diagnoser"])
        self._causes.resume(part["causes"])


def _merged(found: Sequence[Finding], said: Sequence[Finding]) -> Iterator[Finding]:
    """Give both in order of time; at the same instant what was found comes first."""
    place = 0
    for finding in said:
        at_ns = instant_of(finding)
        while place < len(found) and instant_of(found[place]) <= at_ns:
            yield found[place]
            place += 1
        yield finding
    yield from found[place:]


class _Nobody:
    """A diagnoser that says nothing: there is no FMEA."""

    items: frozenset[str] = frozenset()
    history_s = 0.0
    facts: Mapping[str, FaultFacts] = MappingProxyType({})

    def begin(self, at_ns: int) -> None:
        """Know nothing."""

    def feed(self, batch: Batch) -> None:
        """Look at no row."""

    def advance(self, found: Sequence[Finding], until_ns: int) -> Sequence[Symptom | Diagnosis]:
        """Find nothing."""
        return ()

    def snapshot(self) -> dict[str, Any]:
        """Know nothing to go on with."""
        return {}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on knowing nothing."""
