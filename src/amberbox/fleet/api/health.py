"""Whether the server answers: for whoever watches over it, and says nothing else."""

from __future__ import annotations

from typing import Literal

from fastapi import Response
from sqlalchemy import select

from amberbox.core.errors import AmberboxError
from amberbox.fleet.api.access import Fleet, Open, Routes

routes = Routes("health")

Health = Literal["ok", "poor", "bad"]


@routes.get("/health", Open("for monitors of the server; says only whether it answers"))
def read_health(fleet: Fleet, response: Response) -> dict[Literal["status"], Health]:
    """Return 200 if the server and its database answer, else 503.

    ``poor``: it answers, and needs somebody soon (the disk is nearly full, nothing is committed).
    """
    try:
        with fleet.database.reading() as connection:
            connection.execute(select(1))
    except AmberboxError:
        response.status_code = 503
        return Health("bad")
    return {"status": "poor" if fleet.keeping.troubles() else "ok"}
