"""Timelines: the states of components over time, from transitions that robots reported."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.blackbox.journal import channels
from amberbox.monitoring.findings import COMPONENT_STATE
from amberbox.server.derived import MOST, DerivedRecord, RecordStores, derived_records
from amberbox.server.live.records import (
    ConditionRecord,
    EventRecord,
    RetainedStatus,
    TransitionRecord,
    convert_record,
    decode_record,
    rank_of,
)

# Number of events after the window in which the first changes of components are searched
_BEHIND = 2000

# Component and mode
Lane = tuple[str, str]


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


@dataclass(frozen=True, slots=True)
class ComponentTimeline:
    """The lanes of a window; ``complete`` is false if there were too many events."""

    complete: bool
    lanes: Mapping[Lane, Sequence[TimelineInterval]]


def timeline(
    stores: RecordStores,
    robot: str,
    span: tuple[int, int],
    standing: Iterable[RetainedStatus],
    component: str = "",
    points: int = 500,
) -> ComponentTimeline:
    """Return the states of components in ``[from, to)``, at most ``points`` intervals a lane."""
    found = derived_records(stores, robot, channels.EVENT, span, MOST)
    inside = _by_lane(_transitions(found), component)
    behind = derived_records(stores, robot, channels.EVENT, (span[1], None), _BEHIND)
    after = _by_lane(_transitions(behind), component)
    now = {(s.said.component, s.said.mode): s for s in standing}
    lanes = sorted(
        lane for lane in {*inside, *after, *now} if not component or lane[0] == component
    )
    shown = {
        lane: shortened(intervals, span, points)
        for lane in lanes
        if (intervals := _intervals(span, inside.get(lane, ()), after.get(lane, ()), now.get(lane)))
    }
    return ComponentTimeline(len(found) < MOST, shown)


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
            said = decode_record(event.details, TransitionRecord)
            if said is not None:
                yield said.at_ns or entry.at_ns, said


def _by_lane(
    transitions: Iterable[tuple[int, TransitionRecord]], component: str
) -> Mapping[Lane, list[tuple[int, TransitionRecord]]]:
    found: dict[Lane, list[tuple[int, TransitionRecord]]] = {}
    for at_ns, said in transitions:
        if not component or said.component == component:
            found.setdefault((said.component, said.mode), []).append((at_ns, said))
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
        if now is None or now.said.since_ns >= to_ns:
            return []
        since_ns, reason = max(from_ns, now.said.since_ns), now.said.reason
        condition = ConditionRecord(now.said.level, now.said.state)
    for at_ns, said in inside:
        cut_ns = min(max(at_ns, since_ns), to_ns)
        if cut_ns > since_ns:
            found.append(
                TimelineInterval(since_ns, cut_ns, condition.level, condition.state, reason)
            )
        since_ns, condition, reason = cut_ns, said.after, said.reason
    if to_ns > since_ns:
        found.append(TimelineInterval(since_ns, to_ns, condition.level, condition.state, reason))
    return found


def _before(
    inside: Sequence[tuple[int, TransitionRecord]], after: Sequence[tuple[int, TransitionRecord]]
) -> ConditionRecord | None:
    return next((said.before for _, said in (*inside[:1], *after[:1])), None)
