"""Worker operations on robots' data: rows, items, statistics, gaps, missions, incidents.

Each operation is a function of the server's folder and of its arguments.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.rows import wanted_columns
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.batches import UNDECODABLE
from amberbox.blackbox.store.catalogue import union
from amberbox.blackbox.store.journal_reader import KEPT_RAW, with_columns
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time
from amberbox.core.types import Column, Gap, Ragged, Topic
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.archive.reader import envelope
from amberbox.server.archive.rollups import has_levels, is_plotted
from amberbox.server.data import missions as data_missions
from amberbox.server.data.query import (
    MOST_ROWS,
    THINNED_ROWS,
    RowQuery,
    about_json,
    column_json,
    encoded,
    estimate,
    files_of,
    rows,
)
from amberbox.server.data.recordings import gaps_json
from amberbox.server.data.snapshot import RecordSnapshot, open_catalogue, with_snapshot
from amberbox.server.journals import GapFact, decode, sha256_of


@dataclass(frozen=True, slots=True)
class ItemExtent:
    """Rows and range of receive times of an item in a file, or in a waiting journal."""

    first_ns: int
    last_ns: int
    rows: int


def items_json(look: RecordSnapshot) -> list[dict[str, Any]]:
    """Return the items that have messages, the recorder's own at the end.

    ``no_columns`` is the reason where an item's messages are stored raw only.
    """
    found = [_info(look, name) for name in look.schemas]
    listed = [info for info in found if info["rows"]]
    listed += _without_columns(look, {info["name"] for info in listed})
    listed.sort(key=lambda info: str(info["name"]))
    return sorted(listed, key=lambda info: bool(info["source"] == channels.SOURCE))


def described_json(look: RecordSnapshot) -> list[dict[str, Any]]:
    """Return all items that have columns, with these, the recorder's own at the end."""
    found = (info for info in items_json(look) if not info["no_columns"])
    return [{**info, **_columns(look, info["name"])} for info in found]


def item_json(look: RecordSnapshot, name: str) -> dict[str, Any] | None:
    """Return an item and its columns, none where it has none; None for an unknown name."""
    known = {table.casefold(): table for table in look.schemas}
    table = name if name in look.schemas else known.get(name.casefold())
    if table is None:
        raws = (info for info in _without_columns(look, look.schemas) if info["name"] == name)
        raw = next(raws, None)
        none = {"stamp": "", "parent": "", "chosen": [], "columns": [], "children": []}
        return None if raw is None else {**raw, **none}
    children = [t for t, versions in look.schemas.items() if versions[-1].parent == table]
    return {**_info(look, table), **_columns(look, table), "children": sorted(children)}


def _columns(look: RecordSnapshot, table: str) -> dict[str, Any]:
    schema = union(look.schemas[table])
    return {
        "stamp": schema.stamp, "parent": schema.parent,
        "chosen": list(look.selection.get(table, [])),
        "columns": [column_json(column) for column in schema.columns],
    }  # fmt: skip


def _info(look: RecordSnapshot, table: str) -> dict[str, Any]:
    schema, held = union(look.schemas[table]), list(_held(look, table))
    count = sum(one.rows for one in held)
    first = min((one.first_ns for one in held), default=None)
    last = max((one.last_ns for one in held), default=None)
    return {
        "name": table, "source": schema.source, "topic": schema.topic, "type": schema.type,
        "rows": count, "first": None if first is None else format_time(first),
        "last": None if last is None else format_time(last), "rate_hz": _rate_hz(held),
        "no_columns": "",
    }  # fmt: skip


def _without_columns(look: RecordSnapshot, named: Collection[str]) -> Iterator[dict[str, Any]]:
    """Yield the items of which no message can be unrolled, from the gaps of their journals.

    Topic and type are known only for journals that wait for their columns.
    """
    found: dict[str, list[Gap | GapFact]] = {}
    topics: dict[str, Topic] = {}
    for source in look.reader.sources:
        for row in look.catalogue.journals(source):
            for fact in decode(row.facts).gaps:
                if fact.reason.startswith((KEPT_RAW, UNDECODABLE)):
                    found.setdefault(fact.item, []).append(fact)
    for one in look.readable:
        without: list[Gap] = []
        with_columns(one.journal, without.append)
        for gap in without:
            found.setdefault(gap.item, []).append(gap)
        topics |= {stream.item: stream.topic for stream in one.journal.streams.values()}
    for item in found.keys() - set(named):
        gaps, topic = sorted(found[item], key=lambda gap: gap.from_ns), topics.get(item)
        first, last = gaps[0].from_ns, max(gap.to_ns for gap in gaps) - 1
        yield {
            "name": item, "source": item.partition("_")[0],
            "topic": topic.name if topic else "",
            "type": topic.schema.name if topic and topic.schema else "",
            "rows": sum(gap.count or 0 for gap in gaps), "first": format_time(first),
            "last": format_time(last), "rate_hz": None,
            "no_columns": gaps[-1].reason.partition(": ")[2],
        }  # fmt: skip


def _held(look: RecordSnapshot, table: str) -> Iterator[ItemExtent]:
    for version in look.reader.schemas.get(table, ())[:1]:
        yield from (ItemExtent(*file) for file in files_of(look, version, None))
    for one in look.only_in_journals(table):
        rows = one.journal.items.get(table, 0)
        if rows:
            yield ItemExtent(one.row.start_ns, one.row.end_ns, rows)


def _rate_hz(held: list[ItemExtent]) -> float | None:
    """Return rows per second of recording, without the time between files; None without any."""
    pairs = [(one.rows - 1, one.last_ns - one.first_ns) for one in held if one.rows > 1]
    lasted_s = sum(ns for _, ns in pairs) / NS
    return sum(rows for rows, _ in pairs) / lasted_s if lasted_s > 0 else None


_STEPS = 1000
"""Number of steps from which a long range is summed up: its edges are accurate to a step."""


def statistics_json(look: RecordSnapshot, asked: RowQuery) -> dict[str, Any]:
    """Return statistics of numbers; raises UsageError for variables that are not numeric."""
    schema = look.schema(asked.item)
    columns = [wanted.column for wanted in wanted_columns(look, schema, asked.variables)[1:]]
    texts = [column.name for column in columns if not is_plotted(column)]
    if texts and asked.variables is not None:
        raise UsageError(f"{texts[0]} is no number", "only numbers are summed up")
    numbers = [column for column in columns if is_plotted(column)]
    span = asked.from_ns, asked.to_ns
    long = estimate(look, schema, span) > THINNED_ROWS and has_levels(schema)
    names = [column.name for column in numbers]
    if long and numbers:
        table = envelope(look.reader, schema.item, names, span, _STEPS)
        found = [_of_steps(table, column, asked.bins) for column in numbers]
        return {"exact": False, "complete_to": None, "variables": found}
    every = RowQuery(
        asked.robot, asked.item, names, asked.from_ns, asked.to_ns, "received", MOST_ROWS
    )
    answer = rows(look, every)
    about = about_json(answer.about)
    found = [_of_rows(answer.table, column, asked.bins) for column in numbers]
    return {"exact": True, "complete_to": about["complete_to"], "variables": found}


def _of_rows(table: Table, column: Column, bins: int | None) -> dict[str, Any]:
    line = table.columns[column.name]
    assert not isinstance(line, Ragged)  # see is_plotted
    values = np.ma.getdata(line).astype(np.float64)
    known = values[~(col.null_mask(line) | np.isnan(values))]
    if not len(known):
        return _entry(column, 0, None, None, None)
    bars = counted(known, np.ones(len(known)), bins)
    return _entry(column, len(known), known.min(), known.max(), known.mean(), bars)


def _of_steps(table: Table, column: Column, bins: int | None) -> dict[str, Any]:
    low, high, mean, count = (
        np.asarray(table.columns[f"{column.name}:{state}"])
        for state in ("min", "max", "mean", "count")
    )
    total = int(count.sum())
    if not total:
        return _entry(column, 0, None, None, None)
    middle = float(np.nansum(mean * count)) / total
    known = count > 0
    bars = counted(mean[known], count[known], bins)
    return _entry(column, total, np.nanmin(low), np.nanmax(high), middle, bars)


def counted(
    values: NDArray[np.float64], weights: NDArray[Any], bins: int | None
) -> dict[str, list[Any]] | None:
    """Return the histogram of values: ``edges``, one more than ``counts``; None without bins or
    values.

    Integers, if few enough, get one bin each, centred on the number.
    """
    finite = np.isfinite(values)
    values, weights = values[finite], weights[finite]
    if bins is None or not len(values):
        return None
    edges = _edges(values, bins)
    counts, _ = np.histogram(values, edges, weights=weights)
    return {"edges": edges.tolist(), "counts": np.round(counts).astype(np.int64).tolist()}


def _edges(values: NDArray[np.float64], bins: int) -> NDArray[np.float64]:
    low, high = float(values.min()), float(values.max())
    if high - low < bins and bool(np.all(values == np.round(values))):
        return np.arange(low - 0.5, high + 1)
    if high - low <= 4 * bins * np.spacing(max(abs(low), abs(high))):  # no room for bins
        return np.array([low - 0.5, high + 0.5])
    return np.linspace(low, high, bins + 1)


def _entry(
    column: Column, count: int, low: Any, high: Any, mean: Any, bars: Any = None
) -> dict[str, Any]:
    shown = [None if v is None or not np.isfinite(v) else float(v) for v in (low, high, mean)]
    return {
        "name": column.name, "unit": column.unit, "count": count, "min": shown[0],
        "max": shown[1], "mean": shown[2], "histogram": bars,
    }  # fmt: skip


Arguments = Mapping[str, Any]


def ready(folder: Path, arguments: Arguments) -> bytes:
    """Import slow modules and open the catalogue, before the first query."""
    import pyarrow.parquet  # noqa: F401  # for the next question

    open_catalogue(folder).revision()
    return b""


def query(folder: Path, arguments: Arguments) -> Iterator[bytes]:
    """Yield the metadata as JSON, after its length (4 bytes, little-endian); then the rows."""
    asked = msgspec.convert(arguments, RowQuery)
    answer = with_snapshot(folder, asked.robot, lambda found: rows(found, asked))
    head = msgspec.json.encode(about_json(answer.about))
    yield len(head).to_bytes(4, "little") + head
    yield from encoded(answer, asked.form)


def items(folder: Path, arguments: Arguments) -> bytes:
    """Return the items of a robot, as JSON."""
    return msgspec.json.encode(with_snapshot(folder, arguments["robot"], items_json))


def described(folder: Path, arguments: Arguments) -> bytes:
    """Return all items of a robot with their columns, as JSON."""
    return msgspec.json.encode(with_snapshot(folder, arguments["robot"], described_json))


def item(folder: Path, arguments: Arguments) -> bytes:
    """Return an item and its columns, as JSON; ``null`` for an unknown item."""
    found = with_snapshot(
        folder, arguments["robot"], lambda seen: item_json(seen, arguments["item"])
    )
    return msgspec.json.encode(found)


def statistics(folder: Path, arguments: Arguments) -> bytes:
    """Return statistics of variables over a range, as JSON."""
    asked = msgspec.convert(arguments, RowQuery)
    found = with_snapshot(folder, asked.robot, lambda seen: statistics_json(seen, asked))
    return msgspec.json.encode(found)


def gaps(folder: Path, arguments: Arguments) -> bytes:
    """Return the gaps and their reasons, as JSON."""
    asked = msgspec.convert(arguments, RowQuery)
    return msgspec.json.encode(
        with_snapshot(folder, asked.robot, lambda seen: gaps_json(seen, asked))
    )


def missions(folder: Path, arguments: Arguments) -> bytes:
    """Return the missions of a robot, as msgpack."""
    return msgspec.msgpack.encode(data_missions.missions(folder, arguments["robot"]))


def incidents(folder: Path, arguments: Arguments) -> bytes:
    """Return the last state of each incident of a robot, as JSON."""
    return msgspec.json.encode(data_missions.incidents(folder, arguments["robot"]))


def altered(folder: Path, arguments: Arguments) -> bytes:
    """Return the journals (store, file, SHA-256) whose content has changed, as JSON."""
    layout = ArchiveLayout(folder)
    found = [
        f"{store_id}/{file}"
        for store_id, file, digest in arguments["journals"]
        if (path := layout.journal(arguments["robot"], store_id, file)).exists()
        and sha256_of(path) != digest
    ]
    return msgspec.json.encode(found)
