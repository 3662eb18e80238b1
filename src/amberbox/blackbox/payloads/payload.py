"""Payloads that come without a definition: their encoding, and the numbers that count them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import msgspec

from amberbox.blackbox.columns.frame_layout import MESSAGE_ENCODING, FrameField, FrameLayout
from amberbox.core.clock import NS
from amberbox.core.timestamps import stamp_of
from amberbox.core.types import Topic

KINDS = ("json", "msgpack", "raw")
RAW = FrameLayout((FrameField("data", 0, 0, "bytes"),)).to_schema("amberbox/Bytes")
"""Any bytes, as one column."""

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_JSON = msgspec.json.Decoder(msgspec.Raw)
_MISFITS = (msgspec.MsgspecError, AttributeError, RecursionError, TypeError, ValueError)
Read = Callable[[bytes], "int | None"]


@dataclass
class Continuity:
    """Counts missing messages of one publisher on one topic.

    ``sequence`` is the path of a number that goes up by one per message; else ``stamp`` is the path
    of a time stamp, and ``rate_hz`` is their rate. A number or stamp that goes back restarts the
    count: the publisher has started again.
    """

    sequence: str
    stamp: str
    rate_hz: float
    last_received_ns: int = 0
    _last: int | None = None
    _readers: dict[str, Read] = field(default_factory=dict)

    @property
    def path(self) -> str:
        """Return the path that is read in each message."""
        return self.sequence or self.stamp

    def missing(self, payload: bytes, encoding: str) -> int | None:
        """Return how many messages are missing before this one; None if unknown."""
        if encoding not in self._readers:
            meaning = _whole if self.sequence else stamp_of
            self._readers[encoding] = _reader(self.path, encoding, meaning)
        value = self._readers[encoding](payload)
        if value is None:
            return None
        last, self._last = self._last, value
        if last is None or value <= last:
            return 0
        steps = value - last if self.sequence else round((value - last) * self.rate_hz / NS)
        return max(0, steps - 1)


def _whole(value: Any) -> int | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return int(value) if value == int(value) else None


def _reader(path: str, encoding: str, meaning: Callable[[Any], int | None]) -> Read:
    """Return a function that decodes only the value at a path."""
    target: Any = Any
    parts = path.strip("/").replace(".", "/").split("/")
    for part in reversed(parts):
        target = msgspec.defstruct("Place", [("value", target)], rename={"value": part})
    module: Any = msgspec.json if encoding == "json" else msgspec.msgpack
    decode, get = module.Decoder(target).decode, attrgetter(".".join(["value"] * len(parts)))

    def read(payload: bytes) -> int | None:
        try:
            found = meaning(get(decode(payload)))
        except (*_MISFITS, OverflowError):
            return None
        return None if found is None or (meaning is stamp_of and not found) else found

    return read


def detect_encoding(payload: bytes) -> str:
    """Return ``json`` or ``msgpack``: only msgpack maps and arrays start with a non-ASCII byte."""
    is_text = payload[:1] < b"\x80" or payload.startswith(_BYTE_ORDER_MARK)
    return "json" if is_text else "msgpack"


def is_json(payload: bytes) -> bool:
    """Return whether bytes are a JSON text."""
    try:
        _JSON.decode(payload.removeprefix(_BYTE_ORDER_MARK))
    except _MISFITS:
        return False
    return True


def payload_topic(name: str, kind: str, latched: bool = False) -> Topic:
    """Return the topic of payloads of a kind: ``json``, ``msgpack`` or ``raw``."""
    if kind == "raw":
        return Topic(name, MESSAGE_ENCODING, RAW, latched)
    return Topic(name, kind, latched=latched)
