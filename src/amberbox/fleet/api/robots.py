"""Robots as they are: cards, one card, the tree of components, what changed, the link."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException, Query
from sqlalchemy import Connection

from amberbox.blackbox.journal import reserved
from amberbox.core.clock import NS
from amberbox.core.naming import component_named, endings
from amberbox.core.timetext import in_order
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import ID, AfterName, Limit, TimeText, time_of
from amberbox.fleet.api.timelines import Timeline, timeline_of
from amberbox.fleet.conclusions.entry import Entry
from amberbox.fleet.conclusions.reading import entries
from amberbox.fleet.linkend.presence import Presence, presences
from amberbox.fleet.services import Services
from amberbox.fleet.services.status import Known
from amberbox.fleet.state import links
from amberbox.fleet.state.facts import Facts
from amberbox.fleet.state.said import SaidEvent, moment, taken
from amberbox.fleet.state.standing import standings
from amberbox.fleet.state.timeline import timeline
from amberbox.fleet.state.tree import status_tree
from amberbox.fleet.state.views import Card, StatusTree

routes = Routes("robots")

_HOUR_NS = 3600 * NS
_SEARCHED = 20_000
"""Events that are looked through for those of one kind."""

Group = Annotated[str, Query(pattern=f"^$|{ID}", description="only robots of this group")]
Name = Annotated[str, Query(max_length=128)]
Points = Annotated[int, Query(ge=10, le=5000, description="at most so many stretches a lane")]
AfterNumber = Annotated[int, Query(ge=0, le=2**62, description="behind this number; 0: the newest")]


@dataclass(frozen=True, slots=True)
class Event:
    """An event; ``at`` by the robot's clock, ``server_at`` by the server's where it is known.

    Store, writer, run and number are its place; ``aside`` says why it is not in the robot's record
    any more.
    """

    at: str | None
    server_at: str | None
    kind: str
    text: str
    source: str
    details: str
    store_id: str
    writer: str
    run: int
    seq: int
    aside: str


@routes.get("/robots", "status.read", each=True)
def list_cards(
    fleet: Fleet, who: Who, group: Group = "", after: AfterName = "", limit: Limit = 1000
) -> Sequence[Card]:
    """Return the robots that one may see, by id; also those that never connected."""
    with fleet.database.reading() as connection:
        chosen = [
            robot
            for robot in who.robots(connection)
            if robot.id > after and (not group or group in robot.groups)
        ]
        return _cards(fleet, connection, chosen[:limit])


@routes.get("/robots/{robot}", "status.read")
def read_card(fleet: Fleet, robot: OfRobot) -> Card:
    """Return a robot at a glance."""
    with fleet.database.reading() as connection:
        return _cards(fleet, connection, [robot])[0]


@routes.get("/robots/{robot}/status", "status.read")
def read_status(fleet: Fleet, robot: OfRobot) -> StatusTree:
    """Return the components of a robot as a tree, with modes, outputs and what they need."""
    return _status(fleet, robot, fleet.feed.state.facts.read)


def status_now(fleet: Services, robot: KnownRobot) -> StatusTree | None:
    """Return the tree of a robot; None where its folder has to be read first."""
    facts = fleet.feed.state.facts
    is_known = facts.at_once(robot.id, fleet.folders.current(robot.id)) is not None
    return read_status(fleet, robot) if is_known else None


def status_without_folder(fleet: Services, robot: KnownRobot) -> StatusTree:
    """Return the tree of a robot as it is known without its folder."""
    return _status(fleet, robot, lambda *_: Facts())


def known_now(fleet: Services, robot: KnownRobot) -> Known:
    """Return the one status of a robot with what it is made of."""
    with fleet.database.reading() as connection:
        statuses = fleet.feed.state.statuses
        return statuses.of(connection, [robot], fleet.clock.wall_ns())[0]


def _status(fleet: Services, robot: KnownRobot, read: Callable[[str, str], Facts]) -> StatusTree:
    known = known_now(fleet, robot)
    return status_tree(known, read(robot.id, known.presence.config_hash if known.presence else ""))


@routes.get("/robots/{robot}/timeline", "status.read")
def read_timeline(
    fleet: Fleet,
    robot: OfRobot,
    from_: Annotated[TimeText, Query(alias="from")] = "now-1h",
    to: TimeText = "now",
    component: Name = "",
    points: Points = 500,
) -> Timeline:
    """Return which component was in what state when."""
    from_ns, to_ns = time_of(from_, fleet.clock), time_of(to, fleet.clock)
    to_ns = fleet.clock.wall_ns() if to_ns is None else to_ns
    from_ns = to_ns - _HOUR_NS if from_ns is None else from_ns
    if from_ns >= to_ns:
        raise HTTPException(400, "the window ends before it begins")
    with fleet.database.reading() as connection:
        standing = standings(connection, [robot.id]).get(robot.id, [])
    known = {one.said.component for one in standing}
    if component and endings(component, known):
        component = component_named(component, known)
    span = (from_ns, to_ns)
    return timeline_of(timeline(fleet, robot.id, span, standing, component, points), span)


@routes.get("/robots/{robot}/events", "items.read")
def list_events(
    fleet: Fleet,
    robot: OfRobot,
    from_: Annotated[TimeText, Query(alias="from")] = "",
    to: TimeText = "",
    kind: Name = "",
    newest: bool = True,
    aside: bool = False,
    limit: Limit = 100,
) -> Sequence[Event]:
    """Return events of a robot in order of time: the newest of a range, or the first ones."""
    span = in_order(time_of(from_, fleet.clock), time_of(to, fleet.clock))
    searched = _SEARCHED if kind else limit
    found = entries(fleet, robot.id, reserved.EVENT, span, searched, newest=newest, aside=aside)
    views = [view for entry in found if (view := _event(entry)) and kind in ("", view.kind)]
    return views[-limit:] if newest else views[:limit]


@routes.get("/robots/{robot}/link", "status.read")
def read_link(
    fleet: Fleet, robot: OfRobot, after: AfterNumber = 0, limit: Limit = 100
) -> links.Link:
    """Return what is known of a robot's link, and what was noticed of it."""
    one = fleet.links.robots.get(robot.id)
    with fleet.database.reading() as connection:
        seen = _presence(connection, robot.id)
        last_ns = one.last_seen_ns if one else seen.last_seen_ns if seen else None
        return links.Link(
            robot.id, one is not None, moment(seen.connected_ns) if seen and one else None,
            moment(last_ns), seen.store_id if seen else "", seen.boot_id if seen else "",
            seen.config_hash if seen else "", seen.version if seen else "",
            one.backlog if one else seen.backlog if seen else 0,
            seen.backlog_bytes if seen else 0, links.stores(connection, robot.id),
            links.clocks(connection, robot.id), links.heads(connection, robot.id),
            links.aside(connection, robot.id), links.events(connection, robot.id, after, limit),
        )  # fmt: skip


def _cards(fleet: Services, connection: Connection, robots: Sequence[KnownRobot]) -> list[Card]:
    state = fleet.feed.state
    return state.cards.of(connection, robots, fleet.clock.wall_ns())


def _presence(connection: Connection, robot: str) -> Presence | None:
    known: Mapping[str, Presence] = {seen.robot: seen for seen in presences(connection)}
    return known.get(robot)


def _event(entry: Entry) -> Event | None:
    said = taken(entry.values, SaidEvent)
    if said is None:
        return None
    return Event(
        moment(entry.at_ns), moment(entry.server_ns), said.kind, said.text, said.source,
        said.details, entry.store_id, entry.writer, entry.run, entry.seq, entry.aside,
    )  # fmt: skip
