"""Routes of recorded data: items, rows, gaps and statistics."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Coroutine, Iterator
from dataclasses import dataclass
from typing import IO, Annotated, Any, TypeVar

import msgspec
from fastapi import Depends, HTTPException, Query, Request
from fastapi.responses import Response, StreamingResponse

from amberbox.core.api import Gaps, Item, ItemDetail, Summaries, Variable
from amberbox.server.data.query import (
    MOST_BINS,
    MOST_POINTS,
    MOST_ROWS,
    ROWS,
    WORKER,
    By,
    Form,
    RowQuery,
    arguments,
)
from amberbox.server.http.auth import Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import ITEM, From, ItemName, ItemQuery, Limit, To
from amberbox.server.services import recordings
from amberbox.server.services.context import robot_span_ns
from amberbox.server.workers.protocol import CancelledError

_LOOK_S = 0.25

Answer = TypeVar("Answer")


async def cancel_on_disconnect(request: Request, work: Coroutine[Any, Any, Answer]) -> Answer:
    """Run some work as long as the client of a request is connected.

    Raises CancelledError when the client has disconnected: the work is cancelled.
    """
    task = asyncio.ensure_future(work)
    try:
        while not (await asyncio.wait({task}, timeout=_LOOK_S))[0]:
            if await request.is_disconnected():
                raise CancelledError("nobody waits for this answer any more")
        return task.result()
    finally:
        task.cancel()


routes = Routes("data")
query_routes = Routes("data")


@routes.get("/robots/{robot}/items", "items.read")
def list_items(fleet: Fleet, who: Who, robot: OfRobot) -> list[Item]:
    """List the data items of a robot that the server has messages of, the box's own at the end."""
    answer = fleet.worker_pool.ask_now(f"{WORKER}:items", {"robot": robot.id}, origin=who.person)
    return msgspec.json.decode(answer, type=list[Item])


@routes.get("/robots/{robot}/items/{item}", "items.read")
def read_item(fleet: Fleet, who: Who, robot: OfRobot, item: ItemName) -> ItemDetail:
    """Describe a data item: columns with types, units and labels, over all its versions."""
    answer = fleet.worker_pool.ask_now(
        f"{WORKER}:item", {"robot": robot.id, "item": item}, origin=who.person
    )
    found = msgspec.json.decode(answer, type=ItemDetail | None)
    if found is None:
        raise HTTPException(404, f"there is no data item {item!r} of {robot.id}")
    return found


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


def asked(
    fleet: Fleet, robot: OfRobot, item: ItemQuery, variables: Names = None, from_: From = "",
    to: To = "", by: By = "received",
    limit: Annotated[int, Query(ge=1, le=MOST_ROWS, description="at most so many rows")] = ROWS,
    points: Annotated[
        int | None, Query(ge=1, le=MOST_POINTS, description="thinned to so many, for a plot")
    ] = None,
    format: Form = "json",
) -> RowQuery:  # fmt: skip
    """Read a question about rows."""
    from_ns, to_ns = robot_span_ns(fleet, robot.id, from_, to)
    return RowQuery(robot.id, item, _names(variables), from_ns, to_ns, by, limit, points, format)


def _names(variables: list[str] | None) -> list[str] | None:
    if variables is None:
        return None
    names = [name.strip() for text in variables for name in text.split(",")]
    return [name for name in names if name][: 4 * _NAMED] or None


@query_routes.get(
    "/robots/{robot}/query", "data.query", response_class=Response, response_model=None,
    responses={
        200: {"model": Rows, "content": {kind: {} for kind in list(_TYPES.values())[1:]}},
    },
)  # fmt: skip
async def read_rows(
    request: Request, fleet: Fleet, who: Who, about: Annotated[RowQuery, Depends(asked)]
) -> StreamingResponse:
    """Give rows of an item in order of time: JSON, CSV, an Arrow stream, or numbers for a plot.

    The headers ``X-Amberbox-Next`` and ``X-Amberbox-Complete-To`` say what the fields ``next`` and
    ``complete_to`` say in JSON.
    """
    work = fleet.worker_pool.ask_file(f"{WORKER}:query", arguments(about), origin=who.person)
    file = await cancel_on_disconnect(request, work)
    about_rows = msgspec.json.decode(file.read(int.from_bytes(file.read(4), "little")))
    headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
    for name in ("rows", "kind", "next", "complete_to"):
        if about_rows[name] is not None:
            headers[f"X-Amberbox-{name.replace('_', '-').title()}"] = str(about_rows[name])
    if about_rows["notes"]:  # as much as a header takes
        headers["X-Amberbox-Notes"] = json.dumps([str(n)[:300] for n in about_rows["notes"][:10]])
    if about.form != "json":
        name = f"{about.robot}-{about.item}.{_ENDINGS[about.form]}".replace(":", "_")
        headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return StreamingResponse(_pieces(file), media_type=_TYPES[about.form], headers=headers)


def _pieces(file: IO[bytes]) -> Iterator[bytes]:
    with file:
        while piece := file.read(_PIECE):
            yield piece


@query_routes.get("/robots/{robot}/gaps", "data.query")
def list_gaps(
    fleet: Fleet, who: Who, robot: OfRobot,
    item: Annotated[str, Query(pattern=rf"{ITEM}|^$", description="empty: of all")] = "",
    from_: From = "", to: To = "", limit: Limit = 1000,
) -> Gaps:  # fmt: skip
    """List what is missing of a robot's record and why, in order of time."""
    return recordings.list_gaps(fleet, who, robot, item, from_, to, limit)


@query_routes.get("/robots/{robot}/statistics", "data.query")
def read_statistics(
    fleet: Fleet, who: Who, robot: OfRobot, item: ItemQuery, variables: Names = None,
    from_: From = "", to: To = "",
    bins: Annotated[
        int | None, Query(ge=1, le=MOST_BINS, description="count values in so many bars")
    ] = None,
) -> Summaries:  # fmt: skip
    """Sum up variables over a range: number of values, least, greatest, mean, histogram."""
    span = robot_span_ns(fleet, robot.id, from_, to)
    question = RowQuery(robot.id, item, _names(variables), *span, bins=bins)
    answer = fleet.worker_pool.ask_now(
        f"{WORKER}:statistics", arguments(question), origin=who.person
    )
    return msgspec.json.decode(answer, type=Summaries)
