"""What somebody wants to download, and how much of that the server keeps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import msgspec

FOLDER = "downloads"
"""Below the server's data folder: one folder per download."""

Format = Literal["csv", "parquet", "mcap", "journals"]


class Wanted(msgspec.Struct, frozen=True):
    """Items of robots (all without a name), in missions or in ``[from_ns, to_ns)``.

    ``variables`` names columns per item, for csv and parquet. ``missions`` are ids, or ``last:3``,
    ``failed:3``, ``transport:3``: of each robot.
    """

    robots: list[str]
    format: Format
    items: list[str] = []
    variables: dict[str, list[str]] = {}
    missions: list[str] = []
    from_ns: int | None = None
    to_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Downloads:
    """How long finished downloads are kept, how much room they have, how many one may ask for."""

    kept_h: float = 24.0
    quota_gb: float = 20.0
    each_gb: float = 5.0
    each_waiting: int = 20
    limit_h: float = 2.0

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense; raises ValueError."""
        for name in ("kept_h", "quota_gb", "each_gb", "limit_h"):
            if not (math.isfinite(getattr(self, name)) and 0 < getattr(self, name) <= 1e6):
                raise ValueError(f"{name} is above 0, and 1000000 at most")
        if not 1 <= self.each_waiting <= 1000:
            raise ValueError("each_waiting is 1 to 1000")
