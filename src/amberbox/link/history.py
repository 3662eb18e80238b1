"""What a server holds and its robot has no more: after a power cut, or of another history.

Early rows are sent before the robot's disk has them for good. What a power cut takes from the disk
is not lost for that: the server keeps it, marked, and never joins it with what was written after.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from amberbox.link.positions import Place, Reach

Why = Literal["lost_at_power_cut", "other_history"]
LOST: Why = "lost_at_power_cut"
OTHER: Why = "other_history"


@dataclass(frozen=True, slots=True)
class Held:
    """What a server holds of one run of a writer: the boot that wrote it, and the end of it."""

    run: int
    boot: str
    end_seq: int


@dataclass(frozen=True, slots=True)
class Aside:
    """Rows of a run from ``from_seq`` on are no part of the record any more, and why."""

    writer: str
    run: int
    from_seq: int
    why: Why


def aside(
    writer: str, held: Sequence[Held], cursor: Place, reach: Reach, *, is_hello: bool
) -> Iterator[Aside]:
    """Compare what is held of a writer with what its robot says there is.

    Only with Hello nothing is on its way, and runs that are being written count. A run that came
    from another boot, one that the robot never had, and an end before what it had called durable
    tell of another history: an old image of its disk was restored.
    """
    stated = {run.run: run for run in reach.runs}
    for one in held:
        now = stated.get(one.run)
        if now is None:
            if is_hello and one.run > reach.end.run:
                yield Aside(writer, one.run, 0, _why(Place(one.run, 0), cursor))
        elif one.boot and now.boot and one.boot != now.boot:
            yield Aside(writer, one.run, 0, OTHER)
        elif (now.closed or is_hello) and now.end_seq < one.end_seq:
            yield Aside(writer, one.run, now.end_seq, _why(Place(one.run, now.end_seq), cursor))


def _why(place: Place, cursor: Place) -> Why:
    return OTHER if place < cursor else LOST


def set_back(cursor: Mapping[str, Place], found: Sequence[Aside]) -> dict[str, Place]:
    """Return the cursor with every writer back where its record parts from what was held."""
    back = dict(cursor)
    for one in found:
        if one.writer in back:
            back[one.writer] = min(back[one.writer], Place(one.run, one.from_seq))
    return back
