"""Findings of detectors and other programs, as rows of the record that are read as evidence.

A program writes them with ``amberbox.log("finding", id=..., state=...)``; one that writes to the
store leaves a request for the watcher, which records it as an event.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from msgspec import Meta, Struct

from amberbox.core.given_answers import ITEM as EVENTS
from amberbox.core.types import Batch, Ragged, SymptomState

KIND: Final = "finding"
"""Kind of these events, and of the requests for them."""
ROWS: Final = "event_finding"
"""The item of what programs log."""
ITEMS: Final = frozenset({EVENTS, ROWS})

_Name = Annotated[str, Meta(min_length=1, max_length=300)]


class RecordedFinding(Struct, frozen=True):
    """What a detector has found: ``id`` is ``detector.finding.item[.variable]``.

    ``onset_ns`` is when it began (log time), ``size`` how large it is, ``measured`` are the
    addresses of the data that it was found in. ``leak`` is how probable it is in a minute of
    nominal operation, ``detects`` how probable the detector finds a fault, by its calibration; both
    None if it has none. At least one of the components that have measured the addresses in
    ``conflict`` is faulty.
    """

    id: _Name
    state: SymptomState = "present"
    onset_ns: int | None = None
    strength: Annotated[float, Meta(gt=0, le=1)] = 1.0
    size: float | None = None
    reason: Annotated[str, Meta(max_length=1000)] = ""
    measured: Annotated[tuple[_Name, ...], Meta(max_length=64)] = ()
    leak: Annotated[float, Meta(gt=0, le=1)] | None = None
    detects: Annotated[float, Meta(ge=0, le=1)] | None = None
    conflict: Annotated[tuple[_Name, ...], Meta(max_length=64)] = ()

    @property
    def trust(self) -> float:
        """Return the strength of the evidence, 0 to 1, where only its calibration states it.

        With the likelihood ratio ``r = detects / leak`` it is ``(r - 1) / (r + 1)``: what is as
        frequent without a fault as with one is no evidence at all.
        """
        if self.leak is None or self.detects is None:
            return self.strength
        known = (self.detects - self.leak) / (self.detects + self.leak)
        return min(self.strength, max(known, 0.0))


_FIELDS = tuple(field.name for field in msgspec.structs.fields(RecordedFinding))
_DECODER: msgspec.json.Decoder[RecordedFinding] = msgspec.json.Decoder(RecordedFinding)


def finding_event(given: RecordedFinding, source: str) -> Mapping[str, Any]:
    """Return the values of the event that a finding is recorded as."""
    text = f"{given.id}: {given.state}" + (f": {given.reason}" if given.reason else "")
    details = msgspec.json.encode(given).decode()
    return {"kind": KIND, "text": text, "source": source, "details": details}


def findings_in(batch: Batch) -> Iterator[tuple[int, RecordedFinding | None]]:
    """Yield the findings among rows, each with its log time (ns); None for an unreadable one."""
    if batch.item == EVENTS:
        kinds, details = batch.columns.get("kind"), batch.columns.get("details")
        if kinds is None or details is None:
            return
        for row, at_ns in enumerate(batch.log_time_ns.tolist()):
            if kinds[row] == KIND:
                yield at_ns, _decoded(details[row])
    elif batch.item == ROWS:
        for row, at_ns in enumerate(batch.log_time_ns.tolist()):
            yield at_ns, _of_row(batch, row)


def _decoded(details: object) -> RecordedFinding | None:
    try:
        return _DECODER.decode(str(details))
    except msgspec.MsgspecError:
        return None


def _of_row(batch: Batch, row: int) -> RecordedFinding | None:
    held = {name: _plain(batch.columns[name], row) for name in _FIELDS if name in batch.columns}
    values = {name: value for name, value in held.items() if value is not None}
    for name in ("measured", "conflict"):
        if isinstance(values.get(name), str):
            values[name] = values[name].split()
    try:
        return msgspec.convert(values, RecordedFinding)
    except msgspec.MsgspecError:
        return None


def _plain(column: Any, row: int) -> Any:
    """Return one value of a column as plain Python; None where there is none."""
    value = column[row]
    if isinstance(column, Ragged):
        return value.tolist()
    if value is np.ma.masked:
        return None
    return value.item() if isinstance(value, np.generic) else value
