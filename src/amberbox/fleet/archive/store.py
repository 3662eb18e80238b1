"""What an archive is told and tells: which journal, what will not come, how long to keep what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

OWN = "own"
"""Keeping class of what the box itself says: statuses, events, gaps, incidents, runs."""

Kind = Literal["lost_at_power_cut", "deleted_before_copy"]
LOST: Kind = "lost_at_power_cut"
DELETED: Kind = "deleted_before_copy"


@dataclass(frozen=True, slots=True)
class JournalKey:
    """Which journal: ``file`` is ``folder/name.mcap`` as on the robot, ``sha256`` its content."""

    robot: str
    store_id: str
    file: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Missing:
    """Rows ``[from_seq, to_seq)`` of a writer's run that will not come, and why.

    ``lost_at_power_cut``: the server had seen them, the robot has lost them.
    ``deleted_before_copy``: the robot deleted them; ``reason`` is that of its tombstone.
    """

    writer: str
    run: int
    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int
    kind: Kind
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Retention:
    """How long data are kept, in seconds since they came; None is for ever.

    ``robot`` and ``keeping`` (``main``, ``bulk``, ``ring``, ``watch``, ``keep``, ``kept``) choose;
    ``*`` is every robot, or the classes ``main``, ``bulk`` and ``ring``. What the box itself says
    goes only by a rule for ``own``, journals of ``watch``, ``keep`` and ``kept`` only by a rule
    that names them. What a pinned incident covers stays.
    """

    robot: str = "*"
    keeping: str = "*"
    journals_s: float | None = None
    columns_s: float | None = None


@dataclass(frozen=True, slots=True)
class Stored:
    """What ``put`` did: whether the journal is new here, and where it lies now."""

    is_new: bool
    path: Path


@dataclass(frozen=True, slots=True)
class Committed:
    """What one commit added, or how long to wait until the next one is due."""

    journals: int = 0
    rows: int = 0
    tables: int = 0
    refused: int = 0
    waiting: int = 0
    next_in_s: float = 0.0
