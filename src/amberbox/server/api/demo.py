"""Routes of a demonstration: break and repair a simulated robot, confirm its motions, sign in by a
one-time link.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, HTTPException, Request, Response
from pydantic import Field

from amberbox.server.accounts.signin import LONGEST, sign_in_by_code
from amberbox.server.api.session import Myself, came_from, from_our_pages, myself, set_cookie
from amberbox.server.http.auth import (
    Fleet,
    InDemo,
    OfRobot,
    Open,
    Routes,
    Who,
    demonstration_of,
    is_here,
)
from amberbox.server.http.forms import Form
from amberbox.server.services.context import Caller, Demonstration, Services

demo_routes = Routes("demo")


@dataclass(frozen=True, slots=True)
class DemoRobot:
    """A simulated robot; ``fault`` is what is broken in it, empty if it is well.

    ``code`` is shown at the robot while a motion waits to be confirmed there, else empty.
    """

    robot: str
    fault: str
    code: str


@dataclass(frozen=True, slots=True)
class DemoView:
    """The robots, and the faults that they can be given."""

    robots: list[DemoRobot]
    faults: list[str]


class Damage(Form):
    """Which fault a robot is to have, instead of what it had."""

    fault: Annotated[str, Field(min_length=1, max_length=100)]


@demo_routes.get("/demo", "status.read", each=True)
def read(demo: InDemo, fleet: Fleet, who: Who) -> DemoView:
    """Return which robots there are, what is broken in them, and what can be."""
    return _view(fleet, who, demo)


@demo_routes.post("/demo/{robot}/fault", "demo.break")
def damage(demo: InDemo, fleet: Fleet, who: Who, robot: OfRobot, wanted: Damage) -> DemoView:
    """Break a robot."""
    demo.damage(robot.id, wanted.fault)
    return _noted(fleet, who, demo, robot.id, ("demo.break", {"fault": wanted.fault}))


@demo_routes.delete("/demo/{robot}/fault", "demo.break")
def repair(demo: InDemo, fleet: Fleet, who: Who, robot: OfRobot) -> DemoView:
    """Repair a robot."""
    fault = demo.broken().get(robot.id, "")
    demo.repair(robot.id)
    return _noted(fleet, who, demo, robot.id, ("demo.repair", {"fault": fault}))


@demo_routes.post("/demo/{robot}/confirm", "commands.confirm")
def confirm(demo: InDemo, fleet: Fleet, who: Who, robot: OfRobot) -> DemoView:
    """Confirm the motion that waits at a robot, as somebody who stands there."""
    demo.confirm(robot.id)
    return _noted(fleet, who, demo, robot.id, ("demo.confirm", {}))


def _noted(
    fleet: Services, who: Caller, demo: Demonstration, robot: str, done: tuple[str, dict[str, str]]
) -> DemoView:
    action, details = done
    with fleet.database.begin() as connection:
        who.note(connection, fleet.clock.wall_ns(), action, robot, details=details)
    return _view(fleet, who, demo)


def _view(fleet: Services, who: Caller, demo: Demonstration) -> DemoView:
    with fleet.database.reading() as connection:
        seen = {robot.id for robot in who.robots(connection)}
    broken, codes = demo.broken(), demo.codes_at_robots()
    robots = [
        DemoRobot(robot, broken.get(robot, ""), codes.get(robot, ""))
        for robot in demo.robots
        if robot in seen
    ]
    return DemoView(robots, list(demo.faults))


code_routes = Routes("session")


class Code(Form):
    """What stands behind the ``#`` of the link."""

    code: Annotated[str, Field(min_length=1, max_length=LONGEST)]


def from_here(request: Request, fleet: Fleet) -> None:
    """Refuse who is not on the machine itself; where no demonstration runs, everybody."""
    demonstration_of(fleet)
    if not is_here(request):
        raise HTTPException(403, "these links are for who is on the machine itself")


@code_routes.post(
    "/session/code",
    Open("to sign in by a one-time link, in a demonstration; 404 anywhere else"),
)
async def begin_by_code(
    _here: Annotated[None, Depends(from_here)],
    _ours: Annotated[None, Depends(from_our_pages)],
    code: Code,
    request: Request,
    response: Response,
    fleet: Fleet,
    demo: InDemo,
) -> Myself:
    """Sign in with a code, which is used up: the session is in a cookie, as after any login."""
    user, session = await asyncio.to_thread(
        sign_in_by_code, fleet.database, fleet.clock, demo.codes, code.code, came_from(request)
    )
    set_cookie(response, fleet, session)
    return myself(user.principal, session.secret)
