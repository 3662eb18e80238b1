"""The audit log: who did what, when, and whether nobody changed it afterwards."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response

from amberbox.fleet.api.access import Fleet
from amberbox.fleet.api.audit import Filter, list_rows, read_head
from amberbox.fleet.pages.page import Pages, render

routes = Pages()

_SHOWN = 100


@routes.get("/admin/audit", "audit.read")
def show(
    request: Request, fleet: Fleet, wanted: Annotated[Filter, Depends()],
    after: Annotated[int, Query(ge=0, le=2**62)] = 0,
) -> Response:  # fmt: skip
    """Show rows of the log, the newest first."""
    rows = list_rows(fleet, wanted, "newest", after, _SHOWN)
    query = {"from": wanted.from_, "to": wanted.to, "principal": wanted.principal,
             "action": wanted.action, "object": wanted.object, "result": wanted.result}  # fmt: skip
    chosen = urlencode({name: value for name, value in query.items() if value})
    older = f"?{chosen}&after={rows[-1].seq}" if len(rows) == _SHOWN else ""
    return render(
        request, "admin/audit.html", rows=rows, wanted=wanted, chosen=chosen,
        older=older, head=read_head(fleet),
    )  # fmt: skip
