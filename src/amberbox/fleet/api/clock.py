"""The time that ages of recordings are counted by: what is held of a jump, and its confirmation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import HTTPException
from pydantic import Field

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time, ns_of
from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.forms import Form
from amberbox.fleet.archive.ageclock import SLACK_NS, Reading

routes = Routes("health")


@dataclass(frozen=True, slots=True)
class ServerClock:
    """The server's clock beside the confirmed time, by which recordings grow old.

    ``jump``: ``ahead`` or ``behind``, nothing is deleted because of ``by_s`` until it is confirmed;
    empty where both agree. ``text`` says so.
    """

    time: str
    confirmed: str
    jump: Literal["", "ahead", "behind"]
    by_s: float
    text: str


class RightTime(Form):
    """What the server's clock says, as it was read: another jump meanwhile is not confirmed."""

    time: Annotated[str, Field(max_length=40)]


@routes.get("/clock", "metrics.read")
def read_clock(fleet: Fleet) -> ServerClock:
    """Show the server's clock, and whether a jump of it is held."""
    return _shown(fleet.archive.ages.read())


@routes.post("/clock/confirm", "retention.write")
def confirm_clock(fleet: Fleet, who: Who, right: RightTime) -> ServerClock:
    """Confirm that the server's clock is right; what is too old by it is deleted from then on."""
    ages = fleet.archive.ages
    read_ns = ns_of(right.time)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        if abs(now_ns - read_ns) > SLACK_NS:
            raise HTTPException(409, f"the server's clock says {format_time(now_ns)} by now")
        held = ages.confirm(connection, str(who.principal))
        told = {"jump": held.jump, "by_s": round(held.ahead_ns / NS)}
        who.note(connection, now_ns, "clock.confirm", details=told)
    return _shown(ages.read())


def _shown(found: Reading) -> ServerClock:
    return ServerClock(
        format_time(found.wall_ns), format_time(found.age_ns), found.jump,
        found.ahead_ns / NS if found.jump else 0.0, found.text,
    )  # fmt: skip
