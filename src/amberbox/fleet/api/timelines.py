"""Timelines as the API shows them."""

from __future__ import annotations

from amberbox.core.timetext import format_time
from amberbox.fleet.api.windows import FROM, Shown
from amberbox.fleet.state import timeline as states


class Stretch(Shown):
    """From when to when something was so, by the robot's clock.

    ``changes`` counts the changes within it where short stretches were joined: then ``level`` and
    ``state`` are the worst of them.
    """

    from_: str = FROM
    to: str
    level: str
    state: str
    reason: str
    changes: int


class Lane(Shown):
    """What was of a component, or of a mode of it."""

    component: str
    mode: str
    stretches: list[Stretch]


class Timeline(Shown):
    """The lanes of a window; not ``complete`` where there was more than can be shown."""

    from_: str = FROM
    to: str
    complete: bool
    lanes: list[Lane]


def timeline_of(found: states.Timeline, span: tuple[int, int]) -> Timeline:
    """Write the times of a timeline."""
    lanes = [
        Lane(component=component, mode=mode, stretches=[_stretch(one) for one in stretches])
        for (component, mode), stretches in found.lanes.items()
    ]
    return Timeline(
        from_=format_time(span[0]), to=format_time(span[1]), complete=found.complete, lanes=lanes
    )


def _stretch(one: states.Stretch) -> Stretch:
    return Stretch(
        from_=format_time(one.from_ns), to=format_time(one.to_ns), level=one.level,
        state=one.state, reason=one.reason, changes=one.changes,
    )  # fmt: skip
