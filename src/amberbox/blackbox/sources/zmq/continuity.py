"""Messages lost before the box: holes in a sequence number, or in stamps at a fixed rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any

import msgspec

from amberbox.core.clock import NS
from amberbox.core.stamps import stamp_of

_MISFITS = (msgspec.MsgspecError, AttributeError, RecursionError, TypeError, ValueError)

Read = Callable[[bytes], "int | None"]


@dataclass
class Continuity:
    """Counts what is missing among the messages of one publisher on one topic.

    ``sequence`` is the path of a number that goes up by one per message; else ``stamp`` is the
    path of a time stamp, and ``rate_hz`` says how often there is one. A number or stamp that goes
    back begins anew: the publisher has started again.
    """

    sequence: str
    stamp: str
    rate_hz: float
    last_received_ns: int = 0
    _last: int | None = None
    _readers: dict[str, Read] = field(default_factory=dict)

    @property
    def path(self) -> str:
        """What is looked at in each message."""
        return self.sequence or self.stamp

    def missing(self, payload: bytes, encoding: str) -> int | None:
        """Return how many messages are missing before this one; None if it does not tell."""
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
    """Make a function that decodes nothing but the value at a path."""
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
