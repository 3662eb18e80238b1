"""Events and timelines of robots as API and pages show them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sqlalchemy import Connection

from amberbox.blackbox.journal import channels
from amberbox.core.api import Card, Event, Lane, StatusTree, Stretch, Timeline
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.names import component_id, ids_ending_in
from amberbox.core.timestamps import format_time, ordered_span
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.derived import DerivedRecord, derived_records
from amberbox.server.ingest.link_state import presences
from amberbox.server.live import links
from amberbox.server.live import timeline as states
from amberbox.server.live.facts import FolderFacts
from amberbox.server.live.records import (
    EventRecord,
    convert_record,
    format_moment,
    retained_statuses,
)
from amberbox.server.live.status import AssessedRobot
from amberbox.server.live.timeline import timeline
from amberbox.server.live.views import status_tree
from amberbox.server.services.context import Caller, Services, query_time_ns

_HOUR_NS = 3600 * NS
_SEARCHED = 20_000
"""Events that are looked through for those of one kind."""


def timeline_of(found: states.ComponentTimeline, span: tuple[int, int]) -> Timeline:
    """Write the times of a timeline."""
    lanes = [
        Lane(component=component, mode=mode, stretches=[_stretch(one) for one in stretches])
        for (component, mode), stretches in found.lanes.items()
    ]
    return Timeline(
        from_=format_time(span[0]), to=format_time(span[1]), complete=found.complete, lanes=lanes
    )


def _stretch(one: states.TimelineInterval) -> Stretch:
    return Stretch(
        from_=format_time(one.from_ns), to=format_time(one.to_ns), level=one.level,
        state=one.state, reason=one.reason, changes=one.changes,
    )  # fmt: skip


def current_status(fleet: Services, robot: KnownRobot) -> AssessedRobot:
    """Return the one status of a robot with its inputs."""
    with fleet.database.reading() as connection:
        statuses = fleet.feed.state.statuses
        return statuses.of(connection, [robot], fleet.clock.wall_ns())[0]


def list_cards(
    fleet: Services, who: Caller, group: str = "", after: str = "", limit: int = 1000
) -> list[Card]:
    """Return the robots that the caller may see, by id; also those that never connected."""
    with fleet.database.reading() as connection:
        chosen = [
            robot
            for robot in who.robots(connection)
            if robot.id > after and (not group or group in robot.groups)
        ]
        return _cards(fleet, connection, chosen[:limit])


def read_card(fleet: Services, robot: KnownRobot) -> Card:
    """Return a robot at a glance."""
    with fleet.database.reading() as connection:
        return _cards(fleet, connection, [robot])[0]


def read_status(fleet: Services, robot: KnownRobot) -> StatusTree:
    """Return the components of a robot as a tree, with modes, outputs and dependencies."""
    return _status(fleet, robot, fleet.feed.state.facts.read)


def status_now(fleet: Services, robot: KnownRobot) -> StatusTree | None:
    """Return the tree of a robot; None where its folder has to be read first."""
    facts = fleet.feed.state.facts
    is_known = facts.at_once(robot.id, fleet.folders.current(robot.id)) is not None
    return read_status(fleet, robot) if is_known else None


def status_without_folder(fleet: Services, robot: KnownRobot) -> StatusTree:
    """Return the tree of a robot as far as it is known without its folder."""
    return _status(fleet, robot, lambda *_: FolderFacts())


def _status(
    fleet: Services, robot: KnownRobot, read: Callable[[str, str], FolderFacts]
) -> StatusTree:
    known = current_status(fleet, robot)
    return status_tree(known, read(robot.id, known.presence.config_hash if known.presence else ""))


def read_timeline(
    fleet: Services, robot: KnownRobot, from_: str = "now-1h", to: str = "now",
    component: str = "", points: int = 500,
) -> Timeline:  # fmt: skip
    """Return which component was in what state when."""
    from_ns, to_ns = query_time_ns(from_, fleet.clock), query_time_ns(to, fleet.clock)
    to_ns = fleet.clock.wall_ns() if to_ns is None else to_ns
    from_ns = to_ns - _HOUR_NS if from_ns is None else from_ns
    if from_ns >= to_ns:
        raise UsageError("the window ends before it begins")
    with fleet.database.reading() as connection:
        standing = retained_statuses(connection, [robot.id]).get(robot.id, [])
    known = {one.said.component for one in standing}
    if component and ids_ending_in(component, known):
        component = component_id(component, known)
    span = (from_ns, to_ns)
    return timeline_of(timeline(fleet, robot.id, span, standing, component, points), span)


def list_events(
    fleet: Services, robot: KnownRobot, from_: str = "", to: str = "", kind: str = "", *,
    newest: bool = True, aside: bool = False, limit: int = 100,
) -> Sequence[Event]:  # fmt: skip
    """Return events of a robot in order of time: the newest of a range, or the first ones."""
    span = ordered_span(query_time_ns(from_, fleet.clock), query_time_ns(to, fleet.clock))
    searched = _SEARCHED if kind else limit
    found = derived_records(
        fleet, robot.id, channels.EVENT, span, searched, newest=newest, aside=aside
    )
    views = [view for entry in found if (view := _event(entry)) and kind in ("", view.kind)]
    return views[-limit:] if newest else views[:limit]


def read_link(fleet: Services, robot: KnownRobot, after: int = 0, limit: int = 100) -> links.Link:
    """Return the state of a robot's link, and its events."""
    one = fleet.links.robots.get(robot.id)
    with fleet.database.reading() as connection:
        seen = next((each for each in presences(connection) if each.robot == robot.id), None)
        last_ns = one.last_seen_ns if one else seen.last_seen_ns if seen else None
        return links.Link(
            robot.id, one is not None, format_moment(seen.connected_ns) if seen and one else None,
            format_moment(last_ns), seen.store_id if seen else "", seen.boot_id if seen else "",
            seen.config_hash if seen else "", seen.version if seen else "",
            one.backlog if one else seen.backlog if seen else 0,
            seen.backlog_bytes if seen else 0, links.stores(connection, robot.id),
            links.clocks(connection, robot.id), links.heads(connection, robot.id),
            links.aside(connection, robot.id), links.events(connection, robot.id, after, limit),
        )  # fmt: skip


def _cards(fleet: Services, connection: Connection, robots: Sequence[KnownRobot]) -> list[Card]:
    state = fleet.feed.state
    return state.cards.of(connection, robots, fleet.clock.wall_ns())


def _event(entry: DerivedRecord) -> Event | None:
    said = convert_record(entry.values, EventRecord)
    if said is None:
        return None
    return Event(
        format_moment(entry.at_ns),
        format_moment(entry.server_ns),
        said.kind,
        said.text,
        said.source,
        said.details,
        entry.store_id,
        entry.writer,
        entry.run,
        entry.seq,
        entry.aside,
    )
