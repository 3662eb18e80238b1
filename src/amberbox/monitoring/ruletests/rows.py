"""What comes in during a rule test: batches of rows, as a reader of the record gives them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.names import identifier
from amberbox.core.types import Batch, Column, ColumnData, IntArray, ItemSchema, Ragged
from amberbox.monitoring.configuration.variables import Place, guessed
from amberbox.monitoring.plan import InputPlan, Plan
from amberbox.monitoring.ruletests.files import Loss, RuleTest
from amberbox.monitoring.ruletests.notation import ABSENT, Series, shown

START_NS = 1_790_000_000 * NS
"""When the first value comes."""
_COUNTERS = identifier(reserved.COUNTERS)
_GAPS = identifier(reserved.GAP)
_STAMP = "stamp"


@dataclass(slots=True)
class Incoming:
    """Values by item and variable, one for each interval."""

    interval_ns: int
    items: dict[str, dict[str, list[Any]]] = field(default_factory=lambda: defaultdict(dict))
    received: dict[str, list[Any]] = field(default_factory=dict)
    stamps: dict[str, list[Any]] = field(default_factory=dict)
    losses: list[Loss] = field(default_factory=list)

    @property
    def intervals(self) -> int:
        """How many intervals there are until nothing more comes."""
        series = [s for columns in self.items.values() for s in columns.values()]
        return max(map(len, [*series, *self.received.values()]), default=0)

    def batches(self) -> list[Batch]:
        """Return everything as batches, one for each item."""
        batches = [self._rows(item, columns) for item, columns in self.items.items()]
        batches += [self._counts()] if self.received else []
        batches += [_gaps(self.losses)] if self.losses else []
        return [batch for batch in batches if len(batch)]

    def _rows(self, item: str, columns: Mapping[str, list[Any]]) -> Batch:
        count = max(map(len, columns.values()))
        padded = {name: _padded(values, count) for name, values in columns.items()}
        rows = [n for n in range(count) if any(v[n] is not ABSENT for v in padded.values())]
        log_ns = START_NS + np.array(rows, np.int64) * self.interval_ns
        chosen = {name: [_known(values[n]) for n in rows] for name, values in padded.items()}
        chosen.pop("", None)
        if item not in self.stamps:
            return _batch(item, chosen, log_ns, log_ns)
        stamps = _padded(self.stamps[item], count)
        return _batch(item, chosen, log_ns, _stamps([stamps[n] for n in rows], log_ns), _STAMP)

    def _counts(self) -> Batch:
        """Return the recorder's counters: all items at each interval that has a count."""
        rows: list[tuple[int, str, int, int]] = []
        for item, series in self.received.items():
            total, last_ns = 0, 0
            for number, count in enumerate(series):
                if count is ABSENT:
                    continue
                at_ns = START_NS + number * self.interval_ns
                total, last_ns = total + int(count), at_ns if count else last_ns
                rows.append((at_ns, item, total, last_ns))
        rows.sort()
        names = ("item", "received", "last_received_ns")
        columns = {name: [row[n] for row in rows] for n, name in enumerate(names, 1)}
        log_ns = np.array([row[0] for row in rows], np.int64)
        child = _batch(f"{_COUNTERS}__items", columns, log_ns, log_ns)
        return _batch(_COUNTERS, {}, log_ns, log_ns, children={"items": child})


def incoming(test: RuleTest, interval_s: float, plan: Plan) -> Incoming:
    """Read what a test says that comes in; raise UsageError with what cannot be read."""
    found = Incoming(round(interval_s * NS))
    by_text = {entry.text: entry for entry in plan.inputs()}
    parts: dict[tuple[str, str], dict[int, list[Any]]] = defaultdict(dict)
    for name, series in test.series.items():
        place = _place(name, by_text.get(name))
        if place.number is None:
            found.items[place.item][place.variable] = list(series.values)
        else:
            parts[place.item, place.variable][place.number] = list(series.values)
    for (item, variable), elements in parts.items():
        found.items[item][variable] = _lists(elements)
    for name, columns in test.rows.items():
        for column, series in columns.items():
            found.items[_item(name, by_text)][column] = list(series.values)
    for name, written in test.received.items():
        found.received[_item(name, by_text)] = _counts_of(name, written)
    for name, written in test.stamps.items():
        item = _item(name, by_text)
        found.stamps[item] = list(written.values)
        found.items[item].setdefault("", found.stamps[item])
    found.losses = [
        Loss(_item(loss.item, by_text), loss.at, loss.until, loss.reason) for loss in test.lost
    ]
    return found


def _place(name: str, entry: InputPlan | None) -> Place:
    """Return the item and variable that a name in a test means, and the element of a list."""
    if entry is not None and entry.kind == "probe":
        return Place(entry.item, "ok")
    if entry is not None:
        return Place(entry.item, entry.variable, entry.index)
    item, _, variable = name.partition(".")
    if identifier(item) != item:
        raise UsageError(
            f"'{name}' is no input of these monitors", "write item.variable, an item, or an input"
        )
    return guessed(item, variable) if variable else Place(item, "")


def _lists(elements: Mapping[int, Sequence[Any]]) -> list[Any]:
    """Return a list for each interval, up to its last element that has a value; NaN for others.

    An element of a list, and a row of a list of structures, are read from it alike.
    """
    count = max(map(len, elements.values()))
    padded = {index: _padded(list(values), count) for index, values in elements.items()}
    lists: list[Any] = []
    for number in range(count):
        here = {index: v[number] for index, v in padded.items() if v[number] is not ABSENT}
        known = {index: value for index, value in here.items() if value is not None}
        long = [known.get(index, math.nan) for index in range(max(known, default=-1) + 1)]
        lists.append(long if here else ABSENT)
    return lists


def _item(name: str, by_text: Mapping[str, InputPlan]) -> str:
    return _place(name, by_text.get(name)).item


def _padded(values: list[Any], count: int) -> list[Any]:
    return values + [ABSENT] * (count - len(values))


def _known(value: Any) -> Any:
    return None if value is ABSENT else value


def _counts_of(name: str, written: Series) -> list[Any]:
    counts = list(written.values)
    for count in counts:
        if count is not ABSENT and (not isinstance(count, int) or count < 0):
            raise UsageError(f"{name}: messages are counted, {shown(count)} is no count")
    return counts


def _stamps(seconds: Sequence[Any], log_ns: IntArray) -> IntArray:
    """Return own stamps from seconds after the first value; without one, the time of the row."""
    known = [isinstance(value, int | float) for value in seconds]
    given = [START_NS + round(v * NS) if k else 0 for v, k in zip(seconds, known, strict=True)]
    stamps: IntArray = np.where(known, np.array(given, np.int64), log_ns)
    return stamps


def _gaps(losses: Sequence[Loss]) -> Batch:
    rows: list[tuple[int, str, int, int | None, str]] = []
    for loss in losses:
        from_ns = START_NS + round(loss.at * NS)
        rows.append((from_ns, loss.item, from_ns, None, loss.reason))
        if loss.until is not None:
            to_ns = START_NS + round(loss.until * NS)
            rows.append((to_ns, loss.item, from_ns, to_ns, loss.reason))
    rows.sort(key=lambda row: row[0])
    log_ns = np.array([row[0] for row in rows], np.int64)
    columns = {
        name: [row[place] for row in rows]
        for place, name in ((1, "item"), (2, "from_ns"), (3, "to_ns"), (4, "reason"))
    }
    return _batch(_GAPS, {**columns, "peer": [""] * len(rows)}, log_ns, log_ns)


def _batch(
    item: str,
    columns: Mapping[str, Sequence[Any]],
    log_ns: IntArray,
    stamp_ns: IntArray,
    stamp: str = "",
    children: Mapping[str, Batch] | None = None,
) -> Batch:
    made = {name: column_of(name, values) for name, values in columns.items()}
    schema = ItemSchema(
        "rule test", tuple(Column(n, n, kind) for n, (kind, _) in made.items()), stamp=stamp
    )
    return Batch(
        item, schema, "main", 1, np.arange(len(log_ns), dtype=np.int64), log_ns, log_ns, stamp_ns,
        {name: data for name, (_, data) in made.items()}, dict(children or {}),
    )  # fmt: skip


def column_of(name: str, values: Sequence[Any]) -> tuple[str, ColumnData]:
    """Return the type and data of a column; raise UsageError if its values are of several types."""
    known = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in known):
        return "bool", _masked(values, np.bool_, False)
    if any(isinstance(value, bool) for value in known):
        raise UsageError(f"{name} is both a condition and something else", "true and false only")
    if all(isinstance(value, int) for value in known):
        return "int64", _masked(values, np.int64, 0)
    if all(isinstance(value, int | float) for value in known):
        return "float64", _masked(values, np.float64, 0.0)
    if all(isinstance(value, str) for value in known):
        return "string", _objects(values)
    if all(isinstance(value, list) for value in known):
        return "list<float64>", _ragged(values)
    raise UsageError(f"{name} has values of several types", "numbers, texts or lists only")


def _masked(values: Sequence[Any], dtype: Any, filler: Any) -> Any:
    data = np.array([filler if value is None else value for value in values], dtype)
    null = [value is None for value in values]
    return np.ma.MaskedArray(data, null) if any(null) else data


def _objects(values: Sequence[Any]) -> Any:
    column = np.empty(len(values), object)
    column[:] = values
    return column


def _ragged(values: Sequence[Any]) -> Ragged:
    lengths = [len(value or ()) for value in values]
    flat = [number for value in values for number in value or ()]
    return Ragged(np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64), np.array(flat, float))
