"""The page on which one looks at a robot's data: variables, a window of time, plots.

The address holds what is looked at, and the browser alone reads it (``static/js/data/view.js``):

- ``v=ITEM.VARIABLE``, again for each variable; ``v=2:ITEM.VARIABLE`` in the second plot. A variable
  is its column's name, its path in the message, or the end of one path.
- ``from``, ``to``: RFC 3339, an epoch, ``now-1h``, or ``-10m`` before what came last
- ``mission=ID`` instead of them, ``live=1`` to go along with what comes
- ``mode=time`` (or none), ``xy`` (``x``, ``y`` name its variables), ``hist``
- ``compare=M1,M2``: two missions, each from its beginning on
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from urllib.parse import parse_qs, urlsplit

from fastapi import Request, Response
from starlette.responses import JSONResponse

from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Fleet, OfRobot, Who
from amberbox.fleet.api.robots import read_card
from amberbox.fleet.data import WORKER
from amberbox.fleet.pages.data.coverage import coverage
from amberbox.fleet.pages.diagnosis.look import current_card
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()

_MAY = {
    "download": "data.download", "fetch": "data.fetch", "mark": "incidents.write",
    "note": "missions.write",
}  # fmt: skip


@routes.get("/robots/{robot}/data", "items.read")
def show(request: Request, robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Show the page; what is in it follows, so that nothing here waits for a worker."""
    may = {name: who.may(action, robot) for name, action in _MAY.items()}
    return render(
        request, "data/data.html", strings=("plot",), card=read_card(fleet, robot), may=may,
        named=_named(fleet, robot),
    )  # fmt: skip


@routes.get("/robots/{robot}/data/variables", "items.read")
def list_variables(robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Return all items with their columns, as JSON."""
    answer = fleet.asking.ask_now(f"{WORKER}:described", {"robot": robot.id}, asker=who.asker)
    return Response(answer, media_type="application/json")


@routes.get("/robots/{robot}/data/coverage", "items.read")
def show_coverage(robot: OfRobot, fleet: Fleet, who: Who) -> Response:
    """Return where something is recorded and where it is missing, as JSON."""
    return JSONResponse(asdict(coverage(fleet, who, robot.id)))


def _named(fleet: Services, robot: KnownRobot) -> Sequence[str]:
    """Return the variables to which the reasons of the robot's diagnosis lead."""
    card = current_card(fleet, robot.id)
    queries = (parse_qs(urlsplit(reason.href).query) for reason in card.why)
    return list(dict.fromkeys(name for query in queries for name in query.get("v", ())))
