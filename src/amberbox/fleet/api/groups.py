"""Groups of robots: what people and tokens are restricted to."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.fleet.accounts import groups, robots, users
from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.forms import AfterName, Form, Id, Limit, Named, missing
from amberbox.fleet.bus import Change
from amberbox.fleet.services import Services

routes = Routes("groups")


@dataclass(frozen=True, slots=True)
class Group:
    """A group, the robots in it, and the people who are restricted to it."""

    name: str
    robots: list[str]
    people: list[str]


class NewGroup(Form):
    """The name of a group that is to be."""

    name: Id


@routes.get("/groups", "users.read")
def list_groups(fleet: Fleet, after: AfterName = "", limit: Limit = 100) -> list[Group]:
    """List the groups, with their robots and people."""
    with fleet.database.reading() as connection:
        names = [name for name in groups.list_groups(connection) if name > after]
        return _described(connection, names[:limit])


@routes.post("/groups", "users.write", status_code=201)
def add_group(fleet: Fleet, who: Who, new: NewGroup) -> Group:
    """Add a group; nobody and nothing is in it yet."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        groups.add_group(connection, now_ns, new.name)
        who.note(connection, now_ns, "groups.add", new.name)
    return Group(new.name, [], [])


@routes.delete("/groups/{name}", "users.write")
def remove_group(fleet: Fleet, who: Who, name: Named) -> Group:
    """Remove a group; return who and what was in it. Those restricted to it alone see no robot."""
    with fleet.database.begin() as connection:
        before = _described(connection, [name])[0]
        try:
            groups.remove_group(connection, name)
        except UsageError as error:
            raise missing(error) from error
        details = {"robots": before.robots, "people": before.people}
        who.note(connection, fleet.clock.wall_ns(), "groups.remove", name, details=details)
    _tell(fleet, before)
    return before


def _described(connection: Connection, names: list[str]) -> list[Group]:
    known, people = robots.list_robots(connection), users.list_users(connection)
    return [
        Group(
            name,
            [robot.id for robot in known if name in robot.groups],
            [user.name for user in people if name in (user.groups or ())],
        )
        for name in names
    ]


def _tell(fleet: Services, group: Group) -> None:
    for robot in group.robots:
        fleet.bus.publish(Change("robot", robot))
    for name in group.people:
        fleet.bus.publish(Change("account", data={"name": name}))
