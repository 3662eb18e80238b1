"""The log of a Delta table as readers need it: which files are live, and how far batches went.

Reading the log takes neither deltalake nor a process of its own: checkpoints are Parquet, the
commits after them JSON lines. Writing it is left to deltalake (``commit``).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

APP = "amberbox"
"""The application id under which a table states the last batch that is in it."""

_LOG = "_delta_log"


@dataclass(frozen=True, slots=True)
class LiveFile:
    """One file of a table: its partition, and bounds of its keys (both inclusive)."""

    path: str
    robot: str
    day: str
    bytes: int
    rows: int
    low: Mapping[str, Any]
    high: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A table as one version of its log has it; version -1 is no table at all."""

    version: int = -1
    files: Mapping[str, LiveFile] = field(default_factory=dict)
    batch: int = 0


_REMEMBERED: dict[Path, Snapshot] = {}
"""What each table's log said last: a log only grows, nothing in it is read twice."""


def snapshot(table: Path) -> Snapshot:
    """Read a table's log; what was read before is not read again."""
    found = _followed(table, _REMEMBERED.get(table, Snapshot()))
    mark = _checkpoint_version(table)
    if mark > found.version:
        found = _followed(table, _from_checkpoint(table, mark))
    _REMEMBERED[table] = found
    return found


def _followed(table: Path, before: Snapshot) -> Snapshot:
    """Read the commits after what is known, as far as there are any."""
    actions: list[Mapping[str, Any]] = []
    version = before.version
    while True:
        try:
            text = (table / _LOG / f"{version + 1:020}.json").read_text()
        except FileNotFoundError:
            break
        actions += map(json.loads, text.splitlines())
        version += 1
    return _applied(before, version, actions) if version > before.version else before


def _checkpoint_version(table: Path) -> int:
    try:
        return int(json.loads((table / _LOG / "_last_checkpoint").read_text())["version"])
    except FileNotFoundError:
        return -1


def _from_checkpoint(table: Path, version: int) -> Snapshot:
    import pyarrow.parquet as pq

    path = table / _LOG / f"{version:020}.checkpoint.parquet"
    rows = pq.read_table(path, columns=["add", "txn"]).to_pylist()
    return _applied(Snapshot(), version, ({k: v for k, v in r.items() if v} for r in rows))


def _applied(before: Snapshot, version: int, actions: Iterable[Mapping[str, Any]]) -> Snapshot:
    files, batch = dict(before.files), before.batch
    for action in actions:
        if "remove" in action:
            files.pop(unquote(action["remove"]["path"]), None)
        elif "add" in action:
            live = _live(action["add"])
            files[live.path] = live
        elif action.get("txn", {}).get("appId") == APP:
            batch = int(action["txn"]["version"])
    return replace(before, version=version, files=files, batch=batch)


def _live(add: Mapping[str, Any]) -> LiveFile:
    partition, stats = dict(add["partitionValues"]), json.loads(add["stats"])
    return LiveFile(
        unquote(add["path"]), partition["robot"], partition["day"], int(add["size"]),
        int(stats["numRecords"]), stats["minValues"], stats["maxValues"],
    )  # fmt: skip
