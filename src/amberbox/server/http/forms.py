"""Parameters that many routes share: names in paths and bodies, pages of lists, ranges of time."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, HTTPException, Path, Query
from pydantic import BaseModel, ConfigDict, StringConstraints

from amberbox.core.errors import UsageError
from amberbox.server.services.audit import AuditQuery, Result

AlarmNumber = Annotated[int, Path(ge=1, le=2**62, description="the id of an alarm")]

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
    """A request body; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def not_found(error: UsageError) -> HTTPException:
    """Return a 404 error with the text of a failed lookup."""
    return HTTPException(404, error.what)


def download_headers(name: str) -> dict[str, Any]:
    """Return the headers of a download; ``name`` is inserted unchanged and must be trusted."""
    return {
        "Content-Disposition": f'attachment; filename="{name}"',
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }


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


def audit_filter(
    from_: Annotated[TimeText, Query(alias="from")] = "",
    to: TimeText = "",
    principal: Annotated[str, Query(max_length=140)] = "",
    action: Annotated[str, Query(max_length=64)] = "",
    object: Annotated[str, Query(max_length=300)] = "",
    result: Result = "",
) -> AuditQuery:
    """Return the filter for rows of the audit log, from the query."""
    return AuditQuery(from_, to, principal, action, object, result)


AuditFilter = Annotated[AuditQuery, Depends(audit_filter)]
