"""Statuses, timelines and events of robots as API and pages show them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import Connection

from amberbox.blackbox.journal import channels
from amberbox.core.api import Card, Event, Lane, StatusTree, Stretch, Timeline
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.names import component_id, ids_ending_in
from amberbox.core.timestamps import format_time, ordered_span
from amberbox.monitoring.findings import COMPONENT_STATE
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.derived import MOST, DerivedRecord, RecordStores, derived_records
from amberbox.server.ingest.link_state import presences
from amberbox.server.live import links
from amberbox.server.live.facts import FolderFacts
from amberbox.server.live.records import (
    ConditionRecord,
    EventRecord,
    RetainedStatus,
    TransitionRecord,
    convert_record,
    decode_record,
    format_moment,
    rank_of,
    retained_statuses,
)
from amberbox.server.live.status import AssessedRobot
from amberbox.server.live.views import status_tree
from amberbox.server.services.context import Caller, Services, query_time_ns

# Number of events after the window in which the first changes of components are searched
_BEHIND = 2000
_HOUR_NS = 3600 * NS
_SEARCHED = 20_000
"""Events that are looked through for those of one kind."""


@dataclass(frozen=True, slots=True)
class TimelineInterval:
    """An interval with one level and state, by the robot's clock.

    ``changes`` counts the changes within it where short intervals were joined: then ``level`` and
    ``state`` are the worst of them.
    """

    from_ns: int
    to_ns: int
    level: str
    state: str
    reason: str = ""
    changes: int = 0


def timeline(
    stores: RecordStores,
    robot: str,
    span: tuple[int, int],
    standing: Iterable[RetainedStatus],
    component: str,
    points: int,
) -> Timeline:
    """Return the states of components in ``[from, to)``, at most ``points`` intervals a lane.

    It is not ``complete`` where there were too many events.
    """
    found = derived_records(stores, robot, channels.EVENT, span, MOST)
    inside = _by_lane(_transitions(found), component)
    behind = derived_records(stores, robot, channels.EVENT, (span[1], None), _BEHIND)
    after = _by_lane(_transitions(behind), component)
    now = {(s.record.component, s.record.mode): s for s in standing}
    lanes = []
    for key in sorted({*inside, *after, *now}):
        intervals = _intervals(span, inside.get(key, ()), after.get(key, ()), now.get(key))
        if intervals and component in ("", key[0]):
            stretches = [_interval_answer(one) for one in shortened(intervals, span, points)]
            lanes.append(Lane(component=key[0], mode=key[1], stretches=stretches))
    return Timeline(
        from_=format_time(span[0]),
        to=format_time(span[1]),
        complete=len(found) < MOST,
        lanes=lanes,
    )


def shortened(
    intervals: Sequence[TimelineInterval], span: tuple[int, int], points: int
) -> Sequence[TimelineInterval]:
    """Join intervals that are too short to be visible; the worst of them is shown."""
    if len(intervals) <= points:
        return intervals
    step_ns = max((span[1] - span[0]) * 2 // points, 1)
    found: list[TimelineInterval] = []
    for interval in intervals:
        last = found[-1] if found else None
        if last is not None and interval.to_ns - last.from_ns <= step_ns:
            found[-1] = _joined(last, interval)
        else:
            found.append(interval)
    return found


def _joined(one: TimelineInterval, other: TimelineInterval) -> TimelineInterval:
    worst = max(one, other, key=lambda s: rank_of(s.level))
    return replace(
        worst, from_ns=one.from_ns, to_ns=other.to_ns, changes=one.changes + other.changes + 1
    )


def _transitions(found: Iterable[DerivedRecord]) -> Iterable[tuple[int, TransitionRecord]]:
    for entry in found:
        event = convert_record(entry.values, EventRecord)
        if event is not None and event.kind == COMPONENT_STATE:
            transition = decode_record(event.details, TransitionRecord)
            if transition is not None:
                yield transition.at_ns or entry.at_ns, transition


def _by_lane(
    transitions: Iterable[tuple[int, TransitionRecord]], component: str
) -> Mapping[tuple[str, str], list[tuple[int, TransitionRecord]]]:
    found: dict[tuple[str, str], list[tuple[int, TransitionRecord]]] = {}
    for at_ns, transition in transitions:
        if not component or transition.component == component:
            found.setdefault((transition.component, transition.mode), []).append(
                (at_ns, transition)
            )
    return found


def _intervals(
    span: tuple[int, int],
    inside: Sequence[tuple[int, TransitionRecord]],
    after: Sequence[tuple[int, TransitionRecord]],
    now: RetainedStatus | None,
) -> list[TimelineInterval]:
    """Return the intervals between the changes; the first has the state before the first change."""
    from_ns, to_ns = span
    found: list[TimelineInterval] = []
    since_ns, condition, reason = from_ns, _before(inside, after), ""
    if condition is None:
        if now is None or now.record.since_ns >= to_ns:
            return []
        since_ns, reason = max(from_ns, now.record.since_ns), now.record.reason
        condition = ConditionRecord(now.record.level, now.record.state)
    for at_ns, transition in inside:
        cut_ns = min(max(at_ns, since_ns), to_ns)
        if cut_ns > since_ns:
            found.append(
                TimelineInterval(since_ns, cut_ns, condition.level, condition.state, reason)
            )
        since_ns, condition, reason = cut_ns, transition.after, transition.reason
    if to_ns > since_ns:
        found.append(TimelineInterval(since_ns, to_ns, condition.level, condition.state, reason))
    return found


def _before(
    inside: Sequence[tuple[int, TransitionRecord]], after: Sequence[tuple[int, TransitionRecord]]
) -> ConditionRecord | None:
    return next((transition.before for _, transition in (*inside[:1], *after[:1])), None)


def _interval_answer(one: TimelineInterval) -> Stretch:
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
    known = {one.record.component for one in standing}
    if component and ids_ending_in(component, known):
        component = component_id(component, known)
    span = (from_ns, to_ns)
    return timeline(fleet, robot.id, span, standing, component, points)


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
    event = convert_record(entry.values, EventRecord)
    if event is None:
        return None
    return Event(
        format_moment(entry.at_ns),
        format_moment(entry.server_ns),
        event.kind,
        event.text,
        event.source,
        event.details,
        entry.store_id,
        entry.writer,
        entry.run,
        entry.seq,
        entry.aside,
    )
