"""Ranges of time and names of data in queries, shared by the rooms about data."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Query
from pydantic import BaseModel, ConfigDict, Field

from amberbox.core.errors import UsageError
from amberbox.core.timetext import parse_time
from amberbox.fleet.services import Services

ITEM = r"^[A-Za-z0-9_.:-]{1,200}$"
ItemName = Annotated[str, Path(pattern=ITEM, description="a data item or child table")]
ItemQuery = Annotated[str, Query(pattern=ITEM, description="a data item or child table")]
From = Annotated[
    str,
    Query(
        alias="from", max_length=64,
        description="2026-11-21T14:00:00Z, an epoch, now-10m, or -10m: before the last record",
    ),
]  # fmt: skip
To = Annotated[str, Query(max_length=64, description="as from; not itself part of it")]

FROM: Any = Field(alias="from")
"""A field of an answer that is called ``from``."""


class Shown(BaseModel):
    """An answer with fields whose names Python keeps for itself."""

    model_config = ConfigDict(frozen=True, populate_by_name=True)


def time_in(services: Services, robot: str, text: str) -> int | None:
    """Read a time, None for an empty one; ``-10m`` counts from what came last of a robot."""
    if not text.strip():
        return None
    return parse_time(
        text, services.clock.wall_ns, lambda: services.archive.catalogue.last_ns([robot])
    )


def span_in(services: Services, robot: str, from_: str, to: str) -> tuple[int | None, int | None]:
    """Read a range; raises UsageError for one that ends before it begins."""
    from_ns, to_ns = (time_in(services, robot, text) for text in (from_, to))
    if from_ns is not None and to_ns is not None and from_ns >= to_ns:
        raise UsageError("the range ends before it begins", "exchange from and to")
    return from_ns, to_ns
