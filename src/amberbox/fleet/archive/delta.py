"""Commits to Delta tables: files in, files out, and the number of the batch, all or nothing.

Only the worker imports this module: ``deltalake`` stays out of the server's own process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

from deltalake import CommitProperties, DeltaTable, Schema
from deltalake.transaction import AddAction, RemoveAction, Transaction

from amberbox.blackbox.segments.flat import TableSchema
from amberbox.fleet.archive.layout import PARTITIONS, arrow_schema
from amberbox.fleet.archive.log import APP, LiveFile

_STATISTICS = "log_time,received,timestamp,store_id,writer,run"


def open_table(folder: Path, schema: TableSchema) -> DeltaTable:
    """Open a table, or make it."""
    if DeltaTable.is_deltatable(str(folder)):
        return DeltaTable(str(folder))
    folder.mkdir(parents=True, exist_ok=True)
    return DeltaTable.create(
        str(folder),
        Schema.from_arrow(arrow_schema(schema)),
        name=schema.item,
        description=json.dumps(schema.to_json()),
        partition_by=list(PARTITIONS),
        configuration={
            "delta.dataSkippingStatsColumns": _STATISTICS,
            "delta.checkpointInterval": "20",
            "delta.logRetentionDuration": "interval 1 days",
        },
    )


def change(
    folder: Path,
    schema: TableSchema,
    add: Sequence[LiveFile],
    remove: Sequence[LiveFile] = (),
    *,
    batch: int | None = None,
    same_rows: bool = False,
    about: str,
) -> None:
    """Add files and take others out in one commit.

    ``batch`` says that its rows are in now; with ``same_rows`` files were only joined.
    """
    table = open_table(folder, schema)
    actions: list[AddAction | RemoveAction] = [_add(file, not same_rows) for file in add]
    now_ms = time.time_ns() // 1_000_000
    actions += [
        RemoveAction(file.path, not same_rows, now_ms, file.bytes, _partition(file))
        for file in remove
    ]
    marks = [] if batch is None else [Transaction(APP, batch)]
    table.create_write_transaction(
        actions,
        "append",
        table.schema(),
        list(PARTITIONS),
        commit_properties=CommitProperties({"amberbox": about}, app_transactions=marks),
    )


def _add(file: LiveFile, changes: bool) -> AddAction:
    stats = {"numRecords": file.rows, "minValues": file.low, "maxValues": file.high}
    now_ms = time.time_ns() // 1_000_000
    text = json.dumps({**stats, "nullCount": {}})
    return AddAction(file.path, file.bytes, _partition(file), now_ms, changes, text)


def _partition(file: LiveFile) -> dict[str, str | None]:
    return {"robot": file.robot, "day": file.day}
