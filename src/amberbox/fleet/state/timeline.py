"""Which component was in what state when: stretches of time, from what robots said of changes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.blackbox.journal import reserved
from amberbox.fleet.conclusions.entry import Entry
from amberbox.fleet.conclusions.reading import MOST, Stores, entries
from amberbox.fleet.state.said import (
    SaidCondition,
    SaidEvent,
    SaidTransition,
    heard,
    rank_of,
    taken,
)
from amberbox.fleet.state.standing import Standing
from amberbox.monitoring.messages.records import COMPONENT_STATE

_BEHIND = 2000
"""Events behind the window in which the first changes of components are looked for."""

Lane = tuple[str, str]
"""Component and mode."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """From when to when something was so, by the robot's clock.

    ``changes`` counts the changes within it where short stretches were joined: then ``level`` and
    ``state`` are the worst of them.
    """

    from_ns: int
    to_ns: int
    level: str
    state: str
    reason: str = ""
    changes: int = 0


@dataclass(frozen=True, slots=True)
class Timeline:
    """The lanes of a window. ``complete`` is false where there was more than can be shown."""

    complete: bool
    lanes: Mapping[Lane, Sequence[Stretch]]


def timeline(
    stores: Stores,
    robot: str,
    span: tuple[int, int],
    standing: Iterable[Standing],
    component: str = "",
    points: int = 500,
) -> Timeline:
    """Return the states of components in ``[from, to)``, at most ``points`` stretches a lane."""
    found = entries(stores, robot, reserved.EVENT, span, MOST)
    inside = _by_lane(_transitions(found), component)
    behind = entries(stores, robot, reserved.EVENT, (span[1], None), _BEHIND)
    after = _by_lane(_transitions(behind), component)
    now = {(s.said.component, s.said.mode): s for s in standing}
    lanes = sorted(
        lane for lane in {*inside, *after, *now} if not component or lane[0] == component
    )
    shown = {
        lane: shortened(stretches, span, points)
        for lane in lanes
        if (stretches := _stretches(span, inside.get(lane, ()), after.get(lane, ()), now.get(lane)))
    }
    return Timeline(len(found) < MOST, shown)


def shortened(
    stretches: Sequence[Stretch], span: tuple[int, int], points: int
) -> Sequence[Stretch]:
    """Join stretches that are too short to be seen; the worst of them is what is shown."""
    if len(stretches) <= points:
        return stretches
    step_ns = max((span[1] - span[0]) * 2 // points, 1)
    found: list[Stretch] = []
    for stretch in stretches:
        last = found[-1] if found else None
        if last is not None and stretch.to_ns - last.from_ns <= step_ns:
            found[-1] = _joined(last, stretch)
        else:
            found.append(stretch)
    return found


def _joined(one: Stretch, other: Stretch) -> Stretch:
    worst = max(one, other, key=lambda s: rank_of(s.level))
    return replace(
        worst, from_ns=one.from_ns, to_ns=other.to_ns, changes=one.changes + other.changes + 1
    )


def _transitions(found: Iterable[Entry]) -> Iterable[tuple[int, SaidTransition]]:
    for entry in found:
        event = taken(entry.values, SaidEvent)
        if event is not None and event.kind == COMPONENT_STATE:
            said = heard(event.details, SaidTransition)
            if said is not None:
                yield said.at_ns or entry.at_ns, said


def _by_lane(
    transitions: Iterable[tuple[int, SaidTransition]], component: str
) -> Mapping[Lane, list[tuple[int, SaidTransition]]]:
    found: dict[Lane, list[tuple[int, SaidTransition]]] = {}
    for at_ns, said in transitions:
        if not component or said.component == component:
            found.setdefault((said.component, said.mode), []).append((at_ns, said))
    return found


def _stretches(
    span: tuple[int, int],
    inside: Sequence[tuple[int, SaidTransition]],
    after: Sequence[tuple[int, SaidTransition]],
    now: Standing | None,
) -> list[Stretch]:
    """Cut the window at the changes; what was before the first one, that one says."""
    from_ns, to_ns = span
    found: list[Stretch] = []
    since_ns, condition, reason = from_ns, _before(inside, after), ""
    if condition is None:
        if now is None or now.said.since_ns >= to_ns:
            return []
        since_ns, reason = max(from_ns, now.said.since_ns), now.said.reason
        condition = SaidCondition(now.said.level, now.said.state)
    for at_ns, said in inside:
        cut_ns = min(max(at_ns, since_ns), to_ns)
        if cut_ns > since_ns:
            found.append(Stretch(since_ns, cut_ns, condition.level, condition.state, reason))
        since_ns, condition, reason = cut_ns, said.after, said.reason
    if to_ns > since_ns:
        found.append(Stretch(since_ns, to_ns, condition.level, condition.state, reason))
    return found


def _before(
    inside: Sequence[tuple[int, SaidTransition]], after: Sequence[tuple[int, SaidTransition]]
) -> SaidCondition | None:
    return next((said.before for _, said in (*inside[:1], *after[:1])), None)
