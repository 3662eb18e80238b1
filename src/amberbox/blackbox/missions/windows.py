"""Ask a record about missions: the rows of each, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from amberbox.blackbox.missions.mission import Mission
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments import columns as col
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, ColumnData

MISSION = "mission"

Ask = Callable[[int, "int | None"], Table]
"""Answers for ``[from, to)``."""


def query_missions(missions: Sequence[Mission], ask: Ask) -> Table:
    """Join what is said of each mission; of several, a column ``mission`` holds their ids.

    Raises UsageError when there is none.
    """
    if not missions:
        raise UsageError("no mission was chosen", "record.missions() lists them")
    tables = [ask(mission.from_ns, mission.to_ns) for mission in missions]
    if len(tables) == 1:
        return tables[0]
    first, *others = tables[0].fields
    name = MISSION if MISSION not in tables[0].names else f"{MISSION}_id"
    ids = [np.full(len(t), m.id, object) for t, m in zip(tables, missions, strict=True)]
    columns: dict[str, ColumnData] = {first.name: _joined(tables, first.name)}
    columns[name] = np.concatenate(ids)
    columns |= {field.name: _joined(tables, field.name) for field in others}
    notes = dict.fromkeys(note for table in tables for note in table.notes)
    fields = (first, Column(name, name, "string"), *others)
    return replace(tables[0], fields=fields, columns=columns, notes=tuple(notes))


def _joined(tables: Sequence[Table], name: str) -> ColumnData:
    return col.concatenate([table.columns[name] for table in tables])
