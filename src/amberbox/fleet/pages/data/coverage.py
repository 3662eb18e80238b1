"""What there is of a robot over all its time: where it is recorded, where something is missing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from amberbox.core.clock import NS
from amberbox.fleet.api.access import Caller
from amberbox.fleet.data import WORKER
from amberbox.fleet.data.asked import Asked, arguments
from amberbox.fleet.data.journals import Recording, recordings
from amberbox.fleet.services import Services

_GAPS = 20_000
_JOURNALS = 1_000_000
_STEPS = 800
"""Stretches nearer to each other than this share of all time are drawn as one."""
_HELD = ("in_columns", "waiting")


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of time in seconds since 1970; of what is missing its kind, and why."""

    start: float
    end: float
    reason: str = ""
    kind: str = ""


@dataclass(frozen=True, slots=True)
class Coverage:
    """From the first to the last time of a robot: what is recorded, what is missing and why.

    Files of which it is not known what they cover count for nothing; null where all are such.
    """

    start: float | None
    end: float | None
    recorded: Sequence[Stretch]
    missing: Sequence[Stretch]


def coverage(fleet: Services, who: Caller, robot: str) -> Coverage:
    """Return what there is of a robot; asks a worker for what is missing."""
    with fleet.database.reading() as connection:
        journals = recordings(connection, fleet.folder, robot, limit=_JOURNALS)
    every = [*_spans(journals)]
    if not every:
        return Coverage(None, None, (), ())
    held = _spans(o for o in journals if o.state in _HELD and o.integrity != "deleted")
    missing = _missing(fleet, who, robot)
    every += [one for one in missing if one.kind == "refused"]
    start, end = min(one.start for one in every), max(one.end for one in every)
    least = (end - start) / _STEPS
    return Coverage(start, end, joined(held, least), joined(missing, least))


def joined(stretches: Iterable[Stretch], least: float) -> list[Stretch]:
    """Join stretches of one reason that meet, or are nearer to each other than ``least``."""
    found: list[Stretch] = []
    for one in sorted(stretches, key=lambda s: (s.reason, s.start)):
        last = found[-1] if found else None
        if last and last.reason == one.reason and one.start - last.end <= least:
            found[-1] = Stretch(last.start, max(last.end, one.end), one.reason, one.kind)
        else:
            found.append(one)
    return sorted(found, key=lambda s: s.start)


def _missing(fleet: Services, who: Caller, robot: str) -> list[Stretch]:
    question = arguments(Asked(robot, "", limit=_GAPS))
    answer = fleet.asking.ask_now(f"{WORKER}:gaps", question, asker=who.asker)
    gaps: list[dict[str, Any]] = msgspec.json.decode(answer)["gaps"]
    starts, ends = (_seconds([gap[name] for gap in gaps]) for name in ("from", "to"))
    reasons, kinds = ([gap[name] for gap in gaps] for name in ("reason", "kind"))
    return [Stretch(*one) for one in zip(starts, ends, reasons, kinds, strict=True)]


def _seconds(stamps: Sequence[str]) -> list[float]:
    """Read times of answers, all at once."""
    read = np.array([stamp.rstrip("Z") for stamp in stamps], "datetime64[ns]").astype(np.int64)
    return [float(one) for one in read / NS]


def _spans(journals: Iterable[Recording]) -> Iterator[Stretch]:
    """Yield what journals cover, where it is known."""
    for one in journals:
        if one.from_ns is not None and one.to_ns is not None:
            yield Stretch(one.from_ns / NS, one.to_ns / NS)
