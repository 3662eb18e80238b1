"""The contract of a probe: a measurement on the robot's own computer, in one file.

A probe is a module in ``monitoring/probes`` whose file name is its kind. It defines

- ``MEASURES``: what it gives beside ``ok``, a mapping of names to ``(type, unit, doc)`` with the
  types ``bool int float string``;
- ``SUBJECT``: one line that describes its subject, with an example;
- ``measure(subject)``: look once and return ``ok`` and the rest by name.

``measure`` may take a while or raise: each probe runs in a thread of its own, so one that hangs
delays no other; its last value then becomes stale. An OSError or AmberboxError means that it cannot
be measured (``ok`` is null, ``error`` is the reason). It may also define

- ``PERIOD_S``: seconds between two looks (1 without it);
- ``TIMEOUT_S``: for how long a look may take before it counts as hanging (5 without it).

A probe only looks: it starts nothing, changes nothing, and leaves nothing behind.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

from amberbox.core.names import identifier

# Prefix of the items ``probe_<kind>_<subject>``, and name of the block of ``black_box.yaml`` that
# receives probes from elsewhere.
SOURCE = "probe"
PERIOD_S = 1.0
TIMEOUT_S = 5.0

# ``ok`` (bool) and what else the probe gives; null is unknown
Measured: TypeAlias = Mapping[str, Any]


class ProbeOrder(NamedTuple):
    """An order to measure: a kind of probe and its subject."""

    kind: str
    subject: str

    @property
    def topic(self) -> str:
        """Return the topic under which it is published, unique for kind and subject."""
        words = (self.kind, *self.subject.strip("/").split("/"))
        plain = "/".join(identifier_part(word) for word in words if word)
        exact = "/".join([self.kind, self.subject.strip("/")]).rstrip("/")
        if plain == exact:
            return plain
        digest = hashlib.sha256(f"{self.kind} {self.subject}".encode()).hexdigest()
        return f"{plain}_{digest[:4]}"

    @property
    def item(self) -> str:
        """Return the name of the data item as which it is recorded."""
        return identifier(f"{SOURCE}_{self.topic}")


def identifier_part(word: str) -> str:
    """Return a word of a topic as a part of a name."""
    return identifier(f"x{word}")[1:]


def sorted_orders(orders: Iterable[ProbeOrder]) -> list[ProbeOrder]:
    """Return orders sorted, each once."""
    return sorted(set(orders))
