"""The audit log: who did what, when, and whether nobody changed it afterwards."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated
from urllib.parse import urlencode

from fastapi import Depends, Query, Request, Response
from sqlalchemy import Connection, select

from amberbox.fleet.alarms.listing import robots_of
from amberbox.fleet.api.access import Fleet
from amberbox.fleet.api.audit import AuditRow, Filter, list_rows, read_head
from amberbox.fleet.audit.tables import AUDIT
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.pages.strings import catalogue

routes = Pages()

_SHOWN = 100
_NEWEST = 20_000
"""Of so many rows the lists of people and acts are made; older ones are found by their names."""
_LISTED = 300
_ALARM = re.compile(r"[1-9][0-9]{0,17}")


@routes.get("/admin/audit", "audit.read")
def show(
    request: Request, fleet: Fleet, wanted: Annotated[Filter, Depends()],
    after: Annotated[int, Query(ge=0, le=2**62)] = 0,
) -> Response:  # fmt: skip
    """Show rows of the log, the newest first."""
    rows = list_rows(fleet, wanted, "newest", after, _SHOWN)
    query = {"from": wanted.from_, "to": wanted.to, "principal": wanted.principal,
             "action": wanted.action, "object": wanted.object, "result": wanted.result}  # fmt: skip
    chosen = urlencode({name: value for name, value in query.items() if value})
    older = f"?{chosen}&after={rows[-1].seq}" if len(rows) == _SHOWN else ""
    with fleet.database.reading() as connection:
        people = _occurring(connection, "principal", wanted.principal)
        acts = _occurring(connection, "action", wanted.action)
        alarms = _alarms(connection, rows)
    return render(
        request, "admin/audit.html", rows=rows, wanted=wanted, chosen=chosen, older=older,
        head=read_head(fleet), people=people, acts=sorted(acts, key=act), alarms=alarms,
        act=act, person=person, alarm_of=alarm_of,
    )  # fmt: skip


def act(action: str) -> str:
    """Say in words what was done; what has no words keeps its name."""
    return catalogue().texts.get(f"audit.acts.{action.replace('.', '_')}", action)


def person(principal: str) -> str:
    """Say in words who it was: by name, programs and robots by what they are as well."""
    kind, _, name = principal.partition(":")
    if not name:
        return catalogue().text("audit.people.server") if kind == "server" else principal
    if name == "?":
        return catalogue().text("audit.people.unknown")
    texts = catalogue().texts
    return texts.get(f"audit.people.{kind}", "{name}").format(name=name)


def alarm_of(row: AuditRow) -> int | None:
    """Return the number of the alarm that a row is about, if it is about one."""
    is_one = row.action.startswith("alarms.") and _ALARM.fullmatch(row.object)
    return int(row.object) if is_one else None


def _occurring(connection: Connection, name: str, chosen: str) -> list[str]:
    """List what occurs in the newest rows, by name; what is chosen is one of them."""
    newest = select(AUDIT.c[name]).order_by(AUDIT.c.seq.desc()).limit(_NEWEST).subquery()
    found = connection.execute(select(newest.c[name]).distinct().limit(_LISTED)).scalars()
    return sorted({*found, *([chosen] if chosen else [])})


def _alarms(connection: Connection, rows: Sequence[AuditRow]) -> Mapping[int, str]:
    """Return the robots of the alarms that rows are about, by number; those that are there."""
    numbers = sorted({number for row in rows if (number := alarm_of(row)) is not None})
    return dict(_named(connection, numbers)) if numbers else {}


def _named(connection: Connection, numbers: Sequence[int]) -> Iterator[tuple[int, str]]:
    for number, robots in robots_of(connection, numbers).items():
        if robots:
            yield number, ", ".join(sorted(str(one["robot"]) for one in robots))
