"""One document of a ROPOD black box as a message: its time, its content, typed or as it is."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import Any

import msgspec

from amberbox.core.stamps import stamp_of

_TIME = "timestamp"
_ID = "_id"
_MS = 1_000_000
_EPOCH = datetime.datetime(1970, 1, 1)
_MILLISECOND = datetime.timedelta(milliseconds=1)


def log_time_ns(document: Mapping[str, Any]) -> int:
    """Return when the black box logged a document, 0 if it does not say.

    That is its ``timestamp``: seconds as a float (whose own resolution is 0.24 us), or whatever
    else is a time.
    """
    value = document.get(_TIME)
    if isinstance(value, datetime.datetime):
        return (value.replace(tzinfo=None) - _EPOCH) // _MILLISECOND * _MS
    return stamp_of(value)


def time_of_id_ns(document: Mapping[str, Any]) -> int:
    """Return when a document's id was made, in whole seconds; 0 if it is no ObjectId."""
    made = getattr(document.get(_ID), "generation_time", None)
    return int(made.timestamp()) * 1000 * _MS if made is not None else 0


def content_of(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document without what the black box added: its id and its log time.

    Variables that the box had unrolled (``pose/position/x``) are put together again.
    """
    content = {key: value for key, value in document.items() if key not in (_ID, _TIME)}
    if any("/" in key for key in content):
        return _rolled_up(content)
    return content


def _rolled_up(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Nest paths; the document stays as it is when a path is a value and a structure at once."""
    nested: dict[str, Any] = {}
    for path, value in flat.items():
        *parents, name = path.strip("/").split("/")
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                return dict(flat)
        if name in place:
            return dict(flat)
        place[name] = value
    return nested


def as_msgpack(content: Mapping[str, Any]) -> bytes:
    """Encode any document as MessagePack, which keeps NaN, infinities and binary.

    Raises ValueError for what it cannot hold.
    """
    try:
        return _encode(content)
    except (TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"cannot be kept: {error}") from None


def _plain(value: Any) -> Any:
    """Turn what only MongoDB has into something that others understand."""
    match value:
        case int():
            return int(value)
        case bytes():
            return bytes(value)
        case str():
            return str(value)
        case Mapping():
            return dict(value)
    return str(value)


_encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode
