"""Flat columns that were exported as JSON into an MCAP file, turned back into the same columns."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import msgspec

from amberbox.blackbox.journal.mcap import Channel
from amberbox.core.clock import NS
from amberbox.core.types import Schema

KIND = "flat columns of an export"
MALFORMED = "malformed"
_TIMESTAMP, _RECEIVED, _STAMP = "timestamp", "received", "stamp"
_PARENT = "parent_seq"
_STAMPS = ("header_stamp", _STAMP)
"""Variables that are the own stamp of most messages; a child table has that of its parent."""

Rewrite = Callable[[bytes, int, int], bytes]
"""From a message, its log time and its stamp to MessagePack."""


def flat_columns(channel: Channel, schema: Schema | None) -> Mapping[str, Any] | None:
    """Return the columns in the schema of a channel that our export wrote, None for any other."""
    if channel.message_encoding != "json" or schema is None or "item" not in channel.metadata:
        return None
    try:
        columns = msgspec.json.decode(schema.data)["properties"]
        is_ours = columns[_TIMESTAMP]["title"] == "time"
    except (msgspec.DecodeError, KeyError, TypeError):
        return None
    return columns if is_ours and isinstance(columns, dict) else None


def own_stamp(columns: Mapping[str, Any]) -> str:
    """Name the variable that holds the own stamps."""
    if _PARENT in columns:
        return _STAMP
    return next((name for name in _STAMPS if name in columns), _STAMP)


def rewriter(columns: Mapping[str, Any]) -> Rewrite:
    """Make a function that turns the rows of a table into documents.

    What JSON does not have is put back: null is NaN among numbers, Base64 is binary. The function
    raises ValueError for what is no such row.
    """
    repairs = {name: repair for name, kind in columns.items() if (repair := _repair(kind))}
    return partial(_rewritten, repairs, own_stamp(columns) not in columns)


def _repair(kind: Mapping[str, Any]) -> Callable[[Any], Any] | None:
    if kind.get("type") == "number":
        return _number
    if kind.get("contentEncoding") == "base64":
        return b64decode
    if kind.get("type") == "array" and kind.get("items") == {"type": "number"}:
        return lambda values: [_number(value) for value in values]
    return None


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _rewritten(
    repairs: Mapping[str, Callable[[Any], Any]],
    adds_stamp: bool,
    message: bytes,
    log_ns: int,
    stamp_ns: int,
) -> bytes:
    try:
        row = msgspec.json.decode(message)
        at = row.pop(_TIMESTAMP)
        for name in repairs.keys() & row.keys():
            row[name] = repairs[name](row[name])
        if row.get(_RECEIVED) == log_ns:
            del row[_RECEIVED]
        if adds_stamp and stamp_ns != log_ns:
            row[_STAMP] = at["sec"] * NS + at["nsec"]
        return msgspec.msgpack.encode(row)
    except (msgspec.DecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no row of an export: {error}") from None


def malformed(message: bytes) -> bytes:
    """Keep what is no row as the only variable of a document."""
    return msgspec.msgpack.encode({MALFORMED: message})
