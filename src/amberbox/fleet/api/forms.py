"""Forms that many routes share: names in paths and bodies, pages of lists, times, downloads."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import HTTPException, Path, Query
from pydantic import BaseModel, ConfigDict, StringConstraints

from amberbox.core.clock import Clock
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time, parse_time

ID = r"^[a-z0-9_.-]{1,64}$"
Id = Annotated[str, StringConstraints(pattern=ID)]
"""A name of a person, robot or group in a body."""
Named = Annotated[str, Path(pattern=ID)]
"""The same in a path."""
Limit = Annotated[int, Query(ge=1, le=1000, description="at most so many")]
AfterName = Annotated[str, Query(max_length=64, description="the last name of the page before")]
TimeText = Annotated[
    str, Query(max_length=64, description="2026-11-21T14:00:00Z, an epoch, now-10m; empty: any")
]


class Form(BaseModel):
    """A body: keys that nobody knows are mistakes, not ignored."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def time_of(text: str, clock: Clock) -> int | None:
    """Read a time of a query, None for an empty one; raises UsageError."""
    return parse_time(text, clock.wall_ns, clock.wall_ns) if text.strip() else None


def shown(time_ns: int | None) -> str | None:
    """Write a time that may not have come."""
    return None if time_ns is None else format_time(time_ns)


def missing(error: UsageError) -> HTTPException:
    """Say that what a path names is not there, in the words of who looked."""
    return HTTPException(404, error.what)


def download(name: str) -> dict[str, Any]:
    """Return headers of a download; ``name`` is one of ours, nothing of it is foreign."""
    return {
        "Content-Disposition": f'attachment; filename="{name}"',
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
