"""What the keeper of a store is told: how much room there is, for how long, what to look for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import msgspec

GB = 1_000_000_000
DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Lifetime:
    """After how many seconds parts of the record go, even where there is room; None: never."""

    raw_s: float | None = None
    columns_s: float | None = None


@dataclass(frozen=True, slots=True)
class Trigger:
    """What makes an incident: a condition that becomes true, an event, or the silence of an item.

    ``when`` is an expression, ``event`` the kind of an event (``*`` stands for anything); nothing
    was received of item ``silence`` for ``silence_s``. One of the three is given.
    """

    name: str
    when: str = ""
    event: str = ""
    silence: str = ""
    silence_s: float = 0.0
    before_s: float = 60.0
    after_s: float = 20.0
    hold_off_s: float = 60.0
    reason: str = ""


@dataclass(frozen=True, slots=True)
class MissionRule:
    """Expressions that begin and end a mission of a name.

    ``failed``, ``outcome`` are read at its end, ``parameters`` at its start. After ``max_s`` it
    ends by itself.
    """

    name: str
    start: str
    end: str
    failed: str = ""
    outcome: str = ""
    parameters: Mapping[str, str] = field(default_factory=dict)
    max_s: float | None = None


@dataclass(frozen=True, slots=True)
class KeeperOptions:
    """Everything that the keeper of one store goes by. Sizes are bytes, times are seconds.

    ``quota`` is None where only the partition sets the limit (``quota_percent`` of it);
    ``incident_share`` is the part of the quota that incidents may hold. ``headroom`` is the size of
    a journal file, ``reserve`` that of the file that holds room free for the last events.
    """

    robot: str = ""
    software_version: str = ""
    config_hash: str = ""
    ring_s: float = 300.0
    quota: int | None = None
    quota_percent: float = 80.0
    min_free: int = GB
    keep_min_s: float = DAY_S
    when_full: Literal["overwrite", "stop"] = "overwrite"
    lifetime: Lifetime = Lifetime()
    headroom: int = 0
    reserve: int = 0
    incident_share: float = 0.5
    incidents_per_hour: int = 10
    triggers: tuple[Trigger, ...] = ()
    missions: tuple[MissionRule, ...] = ()

    def to_json(self) -> str:
        """Write the options for the keeper's command line."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str) -> KeeperOptions:
        """Read what ``to_json`` wrote."""
        return msgspec.json.decode(text, type=cls)
