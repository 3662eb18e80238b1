"""Windows of data that are still on a robot: asked for, delivered when it is reachable."""

from __future__ import annotations

from typing import Annotated

from fastapi import HTTPException, Path, Query
from pydantic import Field
from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form, Limit, shown
from amberbox.fleet.api.windows import FROM, ITEM, Shown, span_in
from amberbox.fleet.bus import Change
from amberbox.fleet.fetches import ledger
from amberbox.fleet.fetches.ledger import Fetched, State
from amberbox.fleet.services import Services

routes = Routes("fetches")

FetchId = Annotated[str, Path(pattern=r"^f-[0-9a-f]{24}$")]
TimeField = Annotated[str, Field(min_length=1, max_length=64)]


class NewFetch(Form):
    """A window of an item, of all items without a name."""

    item: Annotated[str, Field(pattern=rf"{ITEM}|^$")] = ""
    from_: Annotated[TimeField, Field(alias="from")]
    to: TimeField


class FetchedJournal(Shown):
    """A journal of the window; ``state`` is empty until it has come, ``late`` when it did not."""

    store_id: str
    journal: str
    bytes: int
    state: str


class Fetch(Shown):
    """What was asked of a robot.

    ``state``: ``waiting`` for the robot, ``asked``, ``copying`` (``copied`` of ``journals``),
    ``ready``, ``gone`` when nothing of it comes (any more), ``cancelled``. ``reason`` says why
    journals did not come that the robot had named.
    """

    id: str
    robot: str
    item: str
    from_: str = FROM
    to: str
    who: str
    state: State
    reason: str
    copied: int
    journals: list[FetchedJournal]
    asked: str
    sent: str | None
    ended: str | None


@routes.post("/robots/{robot}/fetches", "data.fetch", status_code=202)
def ask_robot(fleet: Fleet, who: Who, robot: OfRobot, new: NewFetch) -> Fetch:
    """Ask a robot for a window of its record: now, or as soon as it is connected."""
    from_ns, to_ns = span_in(fleet, robot.id, new.from_, new.to)
    if from_ns is None or to_ns is None:
        raise UsageError("a window has a beginning and an end", "give from and to")
    with fleet.database.begin() as connection:
        now_ns, by = fleet.clock.wall_ns(), str(who.principal)
        one = ledger.add(connection, now_ns, robot.id, by, new.item, (from_ns, to_ns))
        details = {"id": one.id, "item": new.item, "from": shown(from_ns), "to": shown(to_ns)}
        who.note(connection, now_ns, "data.fetch", robot.id, details=details)
    _tell(fleet, one, ask=True)
    return _shown(one)


@routes.get("/robots/{robot}/fetches", "data.query")
def list_fetches(
    fleet: Fleet, robot: OfRobot, limit: Limit = 100,
    after: Annotated[str, Query(max_length=64, description="the last id of the page before")] = "",
) -> list[Fetch]:  # fmt: skip
    """List what was asked of a robot, newest first."""
    with fleet.database.reading() as connection:
        return [_shown(one) for one in ledger.listed(connection, robot.id, after, limit)]


@routes.get("/robots/{robot}/fetches/{id}", "data.query")
def read_fetch(fleet: Fleet, robot: OfRobot, id: FetchId) -> Fetch:
    """Tell how far it is."""
    with fleet.database.reading() as connection:
        return _shown(_find(connection, robot, id))


@routes.delete("/robots/{robot}/fetches/{id}", "data.fetch")
def cancel_fetch(fleet: Fleet, who: Who, robot: OfRobot, id: FetchId) -> Fetch:
    """Want it no more; journals that the robot has marked already may still come."""
    with fleet.database.begin() as connection:
        one, now_ns = _find(connection, robot, id), fleet.clock.wall_ns()
        if ledger.cancel(connection, now_ns, one):
            who.note(connection, now_ns, "data.fetch.cancel", robot.id, details={"id": id})
        one = _find(connection, robot, id)
    _tell(fleet, one, ask=False)
    return _shown(one)


def _find(connection: Connection, robot: KnownRobot, fetch_id: str) -> Fetched:
    found = ledger.find(connection, robot.id, fetch_id)
    if found is None:
        raise HTTPException(404, f"nothing like this was asked of {robot.id}")
    return found


def _tell(fleet: Services, one: Fetched, *, ask: bool) -> None:
    fleet.bus.publish(Change("fetch", one.robot, {"id": one.id, "ask": ask}))


def _shown(one: Fetched) -> Fetch:
    files = [
        FetchedJournal(store_id=f.store_id, journal=f.journal, bytes=f.bytes, state=f.state)
        for f in one.files
    ]
    return Fetch(
        id=one.id, robot=one.robot, item=one.item, from_=format_time(one.from_ns),
        to=format_time(one.to_ns), who=one.who, state=one.state, reason=one.reason,
        copied=sum(bool(file.state) for file in files), journals=files,
        asked=format_time(one.asked_ns), sent=shown(one.sent_ns), ended=shown(one.ended_ns),
    )  # fmt: skip
