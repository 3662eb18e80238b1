"""Rows of a robot's data: as they are, thinned out for plots, summed up; and what is missing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Annotated, Any

import msgspec
from fastapi import Depends, Query, Request
from fastapi.responses import Response, StreamingResponse

from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Limit
from amberbox.fleet.api.items import Variable
from amberbox.fleet.api.windows import FROM, ITEM, From, ItemQuery, Shown, To, span_in
from amberbox.fleet.asking.leaving import while_there
from amberbox.fleet.data import WORKER
from amberbox.fleet.data.asked import (
    MOST_BINS,
    MOST_POINTS,
    MOST_ROWS,
    ROWS,
    Asked,
    By,
    Form,
    arguments,
)
from amberbox.fleet.data.missing import GapKind

routes = Routes("data")

_TYPES: dict[Form, str] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "arrow": "application/vnd.apache.arrow.stream",
    "plot": "application/octet-stream",
}
_ENDINGS: dict[Form, str] = {"json": "json", "csv": "csv", "arrow": "arrows", "plot": "bin"}
_PIECE = 1 << 18
_NAMED = 64
Names = Annotated[
    list[Annotated[str, Query(max_length=300)]] | None,
    Query(max_length=_NAMED, description="columns, paths or their ends; several by commas, too"),
]


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows as JSON has them: times are RFC 3339, NaN and infinities words, binary base64.

    ``next`` is the ``from`` of the next question where there are more rows. ``kind`` is
    ``envelope`` where so many rows were asked for as ``points`` that they were summed up: the
    columns are then ``x:min``, ``x:max``, ``x:mean``, ``x:count``. ``of`` is how many rows a
    thinned answer or an envelope was made of. ``complete_to`` is up to when all that the server
    holds was looked at.
    """

    item: str
    columns: list[Variable]
    rows: int
    of: int | None
    kind: str
    next: str | None
    complete_to: str | None
    notes: list[str]
    data: list[list[Any]]


class Gap(Shown):
    """A range without data, and why; ``count`` is None when nobody can know.

    ``kind``: ``to_come`` (the robot has it), ``waiting`` (the server has it, and has not read it
    in yet), ``refused`` (the server has the file, and set it aside as damaged), ``deleted``,
    ``filtered`` (the value did not change), ``lost``, ``uncovered`` (nothing was recorded).
    ``publisher`` is the one that was not heard; others of the item may have been.
    """

    item: str
    writer: str
    run: int
    from_: str = FROM
    to: str
    kind: GapKind
    reason: str
    count: int | None
    publisher: str = ""


class Gaps(Shown):
    """What is missing, in order of time; ``more`` says that the list was cut."""

    gaps: list[Gap]
    more: bool


@dataclass(frozen=True, slots=True)
class Histogram:
    """How many values lie in each bar; of bar ``n`` the ends are ``edges[n]``, ``edges[n + 1]``."""

    edges: list[float]
    counts: list[int]


@dataclass(frozen=True, slots=True)
class Summary:
    """Numbers of a variable summed up; NaN and missing values do not count.

    If the sums are not ``exact``, the histogram counts the means of short steps.
    """

    name: str
    unit: str
    count: int
    min: float | None
    max: float | None
    mean: float | None
    histogram: Histogram | None


@dataclass(frozen=True, slots=True)
class Summaries:
    """Sums over a range; if not ``exact``, its edges are right to a thousandth of its length."""

    exact: bool
    complete_to: str | None
    variables: list[Summary]


def asked(
    fleet: Fleet, robot: OfRobot, item: ItemQuery, variables: Names = None, from_: From = "",
    to: To = "", by: By = "received",
    limit: Annotated[int, Query(ge=1, le=MOST_ROWS, description="at most so many rows")] = ROWS,
    points: Annotated[
        int | None, Query(ge=1, le=MOST_POINTS, description="thinned to so many, for a plot")
    ] = None,
    format: Form = "json",
) -> Asked:  # fmt: skip
    """Read a question about rows."""
    from_ns, to_ns = span_in(fleet, robot.id, from_, to)
    return Asked(robot.id, item, _names(variables), from_ns, to_ns, by, limit, points, format)


def _names(variables: list[str] | None) -> list[str] | None:
    if variables is None:
        return None
    names = [name.strip() for text in variables for name in text.split(",")]
    return [name for name in names if name][: 4 * _NAMED] or None


@routes.get(
    "/robots/{robot}/query", "data.query", response_class=Response, response_model=None,
    responses={
        200: {"model": Rows, "content": {kind: {} for kind in list(_TYPES.values())[1:]}},
    },
)  # fmt: skip
async def read_rows(
    request: Request, fleet: Fleet, who: Who, about: Annotated[Asked, Depends(asked)]
) -> StreamingResponse:
    """Give rows of an item in order of time: JSON, CSV, an Arrow stream, or numbers for a plot.

    The headers ``X-Amberbox-Next`` and ``X-Amberbox-Complete-To`` say what the fields ``next`` and
    ``complete_to`` say in JSON.
    """
    work = fleet.asking.ask_file(f"{WORKER}:query", arguments(about), asker=who.asker)
    file = await while_there(request, work)
    said = msgspec.json.decode(file.read(int.from_bytes(file.read(4), "little")))
    headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
    for name in ("rows", "kind", "next", "complete_to"):
        if said[name] is not None:
            headers[f"X-Amberbox-{name.replace('_', '-').title()}"] = str(said[name])
    if said["notes"]:  # as much as a header takes
        headers["X-Amberbox-Notes"] = json.dumps([str(n)[:300] for n in said["notes"][:10]])
    if about.form != "json":
        name = f"{about.robot}-{about.item}.{_ENDINGS[about.form]}".replace(":", "_")
        headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return StreamingResponse(_pieces(file), media_type=_TYPES[about.form], headers=headers)


def _pieces(file: IO[bytes]) -> Iterator[bytes]:
    with file:
        while piece := file.read(_PIECE):
            yield piece


@routes.get("/robots/{robot}/gaps", "data.query")
def list_gaps(
    fleet: Fleet, who: Who, robot: OfRobot,
    item: Annotated[str, Query(pattern=rf"{ITEM}|^$", description="empty: of all")] = "",
    from_: From = "", to: To = "", limit: Limit = 1000,
) -> Gaps:  # fmt: skip
    """List what is missing of a robot's record and why, in order of time."""
    span = span_in(fleet, robot.id, from_, to)
    question = Asked(robot.id, item, None, *span, limit=limit)
    answer = fleet.asking.ask_now(f"{WORKER}:gaps", arguments(question), asker=who.asker)
    return Gaps.model_validate_json(answer)


@routes.get("/robots/{robot}/statistics", "data.query")
def read_statistics(
    fleet: Fleet, who: Who, robot: OfRobot, item: ItemQuery, variables: Names = None,
    from_: From = "", to: To = "",
    bins: Annotated[
        int | None, Query(ge=1, le=MOST_BINS, description="count values in so many bars")
    ] = None,
) -> Summaries:  # fmt: skip
    """Sum up variables over a range: number of values, least, greatest, mean, histogram."""
    span = span_in(fleet, robot.id, from_, to)
    question = Asked(robot.id, item, _names(variables), *span, bins=bins)
    answer = fleet.asking.ask_now(f"{WORKER}:statistics", arguments(question), asker=who.asker)
    return msgspec.json.decode(answer, type=Summaries)
