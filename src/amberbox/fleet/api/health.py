"""Whether the server answers: for whoever watches over it, and says nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from fastapi import Response
from sqlalchemy import select

from amberbox.core.errors import AmberboxError
from amberbox.fleet.api.access import Fleet, Open, Routes
from amberbox.fleet.metrics.troubles import troubles

routes = Routes("health")


@dataclass(frozen=True, slots=True)
class Health:
    """Whether the server answers; ``poor``: it does, and needs somebody soon."""

    status: Literal["ok", "poor", "bad"]


_BAD: dict[int | str, dict[str, Any]] = {503: {"model": Health, "description": "it does not"}}


@routes.get("/health", Open("for monitors of the server; says no more"), responses=_BAD)
def read_health(fleet: Fleet, response: Response) -> Health:
    """Return 200 if the server and its database answer, else 503.

    ``poor``: it answers, and needs somebody soon (the disk is nearly full, nothing is committed,
    files that robots copied are damaged, a jump of the clock is held).
    """
    try:
        with fleet.database.reading() as connection:
            connection.execute(select(1))
    except AmberboxError:
        response.status_code = 503
        return Health("bad")
    return Health("poor" if troubles(fleet) else "ok")
