"""Find missions in existing records, such as imported recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from amberbox.blackbox.query.record import LocalRecord, Record
from amberbox.blackbox.retention.missions import (
    RULE,
    MissionInstant,
    MissionTracker,
    RecordedMission,
    conditions_of,
    load,
    write,
)
from amberbox.blackbox.robot_folder.robot_yaml import MissionRule
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.conditions import ConditionWatcher
from amberbox.core.errors import UsageError
from amberbox.core.types import Batch, IntArray, ItemSchema

_SAME_NS = NS


def detect(store: Path, rules: Sequence[MissionRule]) -> tuple[list[RecordedMission], list[str]]:
    """Evaluate rules over a whole record and write the missions that were not known.

    Returns them, and notes on rules that could not be evaluated. A repeated call finds no more.
    """
    found, notes = find(LocalRecord(store), rules)
    known = load(store)
    new = [mission for mission in found if not any(_same(mission, other) for other in known)]
    write(open_store(store), new)
    return new, notes


def find(record: Record, rules: Sequence[MissionRule]) -> tuple[list[RecordedMission], list[str]]:
    """Return the missions that rules find in a record, and notes."""
    conditions = conditions_of(rules)
    notes = [note for item in sorted(conditions.tables) for note in _add(conditions, record, item)]
    last_ns = record.last_ns()
    if last_ns is None:
        return [], notes
    tracker = MissionTracker(rules)
    changed = tracker.take(conditions.edges(last_ns), MissionInstant)
    changed += tracker.expire(MissionInstant(last_ns))
    missions = {mission.id: mission for mission in changed}
    return list(missions.values()), [*notes, *conditions.problems.values()]


def _add(conditions: ConditionWatcher, record: Record, item: str) -> list[str]:
    """Add all rows of an item to the conditions."""
    try:
        table = record.query(item, ["received", *conditions.variables(item)])
    except UsageError as error:
        return [error.what]
    times = table.columns["received"]
    assert isinstance(times, np.ndarray)
    received: IntArray = np.maximum.accumulate(times)
    rows = np.arange(len(received))
    columns = {name: table.columns[name] for name in conditions.variables(item)}
    schema = ItemSchema("", ())
    batch = Batch(item, schema, "main", 0, rows, received, received, received, columns)
    conditions.add(batch)
    return []


def _same(found: RecordedMission, known: RecordedMission) -> bool:
    """Return whether two missions of one name found by rules are one: they began together."""
    began_together = abs(found.from_ns - known.from_ns) <= _SAME_NS
    return found.id == known.id or (
        known.who == RULE and found.name == known.name and began_together
    )
