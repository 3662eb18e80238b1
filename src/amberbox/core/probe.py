"""The contract of a probe: what can only be seen on the robot's computer, measured in one file.

A probe is a module in ``monitoring/probes`` whose file name is its kind. It defines

- ``MEASURES``: what it gives beside ``ok``, a mapping of names to ``(type, unit, doc)`` with the
  types ``bool int float string``;
- ``SUBJECT``: one line that says what its subject is, with an example;
- ``measure(subject)``: look once and return ``ok`` and the rest by name.

``measure`` may take a while or raise: each probe runs in a thread of its own, so that one that
hangs disturbs nobody; what was measured last then gets stale. An OSError or AmberboxError means
that it cannot be known (``ok`` is null, ``error`` says why). It may also define

- ``PERIOD_S``: seconds between two looks (1 without it);
- ``TIMEOUT_S``: for how long a look may take before it counts as hanging (5 without it).

A probe only looks: it starts nothing, changes nothing, and leaves nothing behind.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

from amberbox.core.names import identifier

SOURCE = "probe"
"""Probes are recorded as items ``probe_<kind>_<subject>``, and a block of ``black_box.yaml`` that
receives them from elsewhere has this name."""
PERIOD_S = 1.0
TIMEOUT_S = 5.0

Measured: TypeAlias = Mapping[str, Any]
"""``ok`` (bool) and what else the probe gives; null is unknown."""


class ProbeOrder(NamedTuple):
    """What is to be measured: a kind of probe and its subject."""

    kind: str
    subject: str

    @property
    def topic(self) -> str:
        """Topic under which it is published, unique for kind and subject."""
        words = (self.kind, *self.subject.strip("/").split("/"))
        plain = "/".join(identifier_part(word) for word in words if word)
        exact = "/".join([self.kind, self.subject.strip("/")]).rstrip("/")
        if plain == exact:
            return plain
        digest = hashlib.sha256(f"{self.kind} {self.subject}".encode()).hexdigest()
        return f"{plain}_{digest[:4]}"

    @property
    def item(self) -> str:
        """Name of the data item it is recorded as."""
        return identifier(f"{SOURCE}_{self.topic}")


def identifier_part(word: str) -> str:
    """Make a word of a topic fit for a name."""
    return identifier(f"x{word}")[1:]


def in_order(orders: Iterable[ProbeOrder]) -> list[ProbeOrder]:
    """Return orders sorted, each once."""
    return sorted(set(orders))
