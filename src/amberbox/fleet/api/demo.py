"""Break a simulated robot and repair it: for everybody in a demonstration, nowhere else.

On a server that is no demonstration these routes answer 404, whoever asks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, HTTPException
from pydantic import Field
from sqlalchemy import Connection

from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form
from amberbox.fleet.demonstration import Demonstration
from amberbox.fleet.services import Services

routes = Routes("demo")


@dataclass(frozen=True, slots=True)
class DemoRobot:
    """A simulated robot; ``fault`` is what is broken in it, empty if it is well."""

    robot: str
    fault: str


@dataclass(frozen=True, slots=True)
class DemoView:
    """The robots, and the faults that they can be given."""

    robots: list[DemoRobot]
    faults: list[str]


class Damage(Form):
    """Which fault a robot is to have, instead of what it had."""

    fault: Annotated[str, Field(min_length=1, max_length=100)]


def demonstration_of(fleet: Fleet) -> Demonstration:
    """Return the demonstration that the server is a part of; raises 404 if it is of none."""
    if fleet.demo is None:
        raise HTTPException(404, "this server is no demonstration")
    return fleet.demo


InDemo = Annotated[Demonstration, Depends(demonstration_of)]


@routes.get("/demo", "status.read", each=True)
def read(demo: InDemo, fleet: Fleet, who: Who) -> DemoView:
    """Return which robots there are, what is broken in them, and what can be."""
    return _view(fleet, who, demo)


@routes.post("/demo/{robot}/fault", "demo.break")
def damage(demo: InDemo, fleet: Fleet, who: Who, robot: OfRobot, wanted: Damage) -> DemoView:
    """Break a robot."""
    demo.damage(robot.id, wanted.fault)
    return _noted(fleet, who, demo, robot.id, ("demo.break", {"fault": wanted.fault}))


@routes.delete("/demo/{robot}/fault", "demo.break")
def repair(demo: InDemo, fleet: Fleet, who: Who, robot: OfRobot) -> DemoView:
    """Repair a robot."""
    fault = demo.broken().get(robot.id, "")
    demo.repair(robot.id)
    return _noted(fleet, who, demo, robot.id, ("demo.repair", {"fault": fault}))


def _noted(
    fleet: Services, who: Caller, demo: Demonstration, robot: str, done: tuple[str, dict[str, str]]
) -> DemoView:
    action, told = done
    with fleet.database.begin() as connection:
        who.note(connection, fleet.clock.wall_ns(), action, robot, details=told)
    return _view(fleet, who, demo)


def _view(fleet: Services, who: Caller, demo: Demonstration) -> DemoView:
    with fleet.database.reading() as connection:
        seen = _seen(connection, who)
    broken = demo.broken()
    robots = [DemoRobot(robot, broken.get(robot, "")) for robot in demo.robots if robot in seen]
    return DemoView(robots, list(demo.faults))


def _seen(connection: Connection, who: Caller) -> set[str]:
    return {robot.id for robot in who.robots(connection)}
