"""Pages of admins: overview, people, teams, robots, settings, health and the audit log."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Literal
from urllib.parse import urlencode, urlsplit

from fastapi import Path, Query, Request, Response
from sqlalchemy import Connection, select

from amberbox.core.api import AuditRow
from amberbox.core.timestamps import maybe_time
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.tokens import working_tokens
from amberbox.server.alarms.recipients import Notifications, Webhook
from amberbox.server.alarms.store import robots_of
from amberbox.server.http.auth import Fleet, Who, services_of
from amberbox.server.http.forms import AuditFilter
from amberbox.server.live.links import damaged_files
from amberbox.server.schema import AUDIT
from amberbox.server.services.alarms import list_notifications
from amberbox.server.services.audit import list_rows, read_head
from amberbox.server.services.commands import list_revoked_keys
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.health import (
    families,
    find_troubles,
    read_health,
    read_system,
    server_clock,
)
from amberbox.server.services.people import list_groups, list_people, list_waiting_keys
from amberbox.server.services.robots import list_cards
from amberbox.server.services.settings import read_setting
from amberbox.server.settings import read
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue

routes = PageRoutes()

_MOST = 1000
PAGES = (
    ("users", "person", "users.read"), ("teams", "graph", "users.read"),
    ("robots", "robot", "robots.write"), ("keys", "key", "keys.write"),
    ("retention", "tape", "retention.write"),
    ("notifications", "bell", "settings.write"), ("alarms", "time", "settings.write"),
    ("downloads", "download", "settings.write"), ("audit", "note", "audit.read"),
    ("health", "heart", "metrics.read"), ("system", "box", "status.read"),
)  # fmt: skip
"""The pages below /admin: name, picture, and the action that one needs."""


@dataclass(frozen=True, slots=True)
class SetupStep:
    """A step of the setup of a new server, and whether it is done."""

    name: str
    href: str
    is_done: bool


@routes.get("/admin", "own.tokens")
def show_overview(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show what needs attention, and the pages that the caller may open."""
    pages = [(name, picture) for name, picture, action in PAGES if who.may(action)]
    steps = list(_steps(fleet, who)) if who.may("users.write") else []
    troubles = find_troubles(fleet) if who.may("metrics.read") else []
    health = read_health(fleet).status
    return render(request, "admin/admin.html", pages=pages, steps=steps, health=health,
                  troubles=troubles, is_new=not all(step.is_done for step in steps))  # fmt: skip


def _steps(fleet: Services, who: Caller) -> Iterator[SetupStep]:
    groups, people = list_groups(fleet, "", _MOST), list_people(fleet, "", _MOST)
    cards = list_cards(fleet, who, "", "", _MOST)
    yield SetupStep("team", "/admin/teams", bool(groups))
    yield SetupStep("robot", "/admin/robots", bool(cards))
    yield SetupStep("connect", "/admin/robots", any(card.last_seen for card in cards))
    yield SetupStep("people", "/admin/users", len(people) > 1)
    yield SetupStep("notify", "/admin/settings/notifications", bool(_destinations(fleet)))


def _destinations(fleet: Services) -> Sequence[object]:
    with fleet.database.reading() as connection:
        found = read(connection, "notifications", Notifications)
    return found.destinations()


@routes.get("/admin/users", "users.read")
def show_people(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show all accounts and their tokens."""
    people = list_people(fleet, "", _MOST)
    with fleet.database.reading() as connection:
        tokens = working_tokens(connection, fleet.clock.wall_ns())
    return render(request, "admin/users.html", people=people, roles=list(Role), tokens=tokens,
                  teams=_teams(fleet), rfc3339=maybe_time, may=who.may("users.write"))  # fmt: skip


@routes.get("/admin/teams", "users.read")
def show_teams(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show the groups of robots and people."""
    groups = list_groups(fleet, "", _MOST)
    return render(request, "admin/teams.html", groups=groups, may=who.may("users.write"))


@routes.get("/admin/robots", "robots.write")
def show_robots(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show the robots that may connect, and signing keys that wait for confirmation."""
    return render(request, "admin/robots.html", cards=list_cards(fleet, who, "", "", _MOST),
                  teams=_teams(fleet), waiting_keys=list_waiting_keys(fleet))  # fmt: skip


@routes.get("/admin/keys", "keys.write")
def show_keys(request: Request, fleet: Fleet) -> Response:
    """Show the keys of people that are revoked, and the form that revokes one."""
    return render(request, "admin/keys.html", keys=list_revoked_keys(fleet)[::-1])


def _teams(fleet: Services) -> list[str]:
    return [group.name for group in list_groups(fleet, "", _MOST)]


_LISTED = 20
Name = Annotated[Literal["retention", "notifications", "alarms", "downloads"], Path()]


@routes.get("/admin/settings/{setting}", "settings.write")
def show_settings(request: Request, fleet: Fleet, who: Who, setting: Name) -> Response:
    """Show a setting as a form; for notifications also the last messages."""
    notifies = setting == "notifications"
    messages = list_notifications(fleet, None, 0, 0, _LISTED) if notifies else []
    return render(
        request, "admin/setting.html", setting=asdict(read_setting(fleet, setting)),
        messages=messages, destinations=_settings_destinations(fleet) if notifies else [],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class NotificationTarget:
    """A destination of notifications: its name, its kind and its address."""

    name: str
    how: Literal["email", "webhook"]
    where: str


def _settings_destinations(fleet: Services) -> list[NotificationTarget]:
    with fleet.database.reading() as connection:
        found = read(connection, "notifications", Notifications)
    return [
        NotificationTarget(one.name, "webhook", urlsplit(one.url).netloc)
        if isinstance(one, Webhook)
        else NotificationTarget(one.name, "email", ", ".join(one.to))
        for one in found.destinations()
    ]


_LOW, _VERY_LOW = 0.1, 0.03
"""Shares of free disk space: below the first it needs attention soon, below the second at once."""


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """Free and total space on the disk of the data folder, in bytes."""

    free: float
    whole: float

    @property
    def level(self) -> str:
        """Return its level: ``ok``, ``warn`` or ``error``."""
        share = self.free / self.whole if self.whole else 1.0
        return "error" if share < _VERY_LOW else "warn" if share < _LOW else "ok"


@routes.get("/admin/health", "metrics.read")
def show_health(request: Request, fleet: Fleet) -> Response:
    """Show the metrics of the server."""
    found = _figures(request)
    with fleet.database.reading() as connection:
        damaged = sorted(damaged_files(connection, fleet.clock.wall_ns()).items())
    disk = DiskSpace(found["amberbox_disk_free_bytes"], found["amberbox_disk_bytes"])
    return render(request, "admin/health.html", figures=found, disk=disk,
                  health=read_health(fleet).status,
                  troubles=find_troubles(fleet), damaged=damaged,
                  clock=server_clock(fleet.archive.ages.read()))  # fmt: skip


@routes.get("/admin/system", "status.read")
def show_system(request: Request, fleet: Fleet) -> Response:
    """Show the statuses of teams and of the system, which the server monitors."""
    return render(request, "admin/system.html", folders=read_system(fleet))


def _figures(request: Request) -> Mapping[str, float]:
    """Return metrics by name, with the values of their labels as ``name:value``."""
    received = request.app.state.received
    return {
        ":".join((family.name, *sample.labels.values())): sample.value
        for family in families(services_of(request), received)
        for sample in family.samples
    }


_SHOWN = 100
_NEWEST = 20_000
"""Number of rows from which the lists of people and actions are made; older ones are found
by name.
"""
_AUDIT_LISTED = 300
_ALARM = re.compile(r"[1-9][0-9]{0,17}")


@routes.get("/admin/audit", "audit.read")
def show_audit(
    request: Request, fleet: Fleet, wanted: AuditFilter,
    after: Annotated[int, Query(ge=0, le=2**62)] = 0,
) -> Response:  # fmt: skip
    """Show rows of the audit log, newest first."""
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
    """Return an action in words, or its name if the catalogue has none."""
    return catalogue().texts.get(f"audit.acts.{action.replace('.', '_')}", action)


def person(principal: str) -> str:
    """Return the name of a principal in words, with its kind for programs and robots."""
    kind, _, name = principal.partition(":")
    if not name:
        return catalogue().text("audit.people.server") if kind == "server" else principal
    if name == "?":
        return catalogue().text("audit.people.unknown")
    texts = catalogue().texts
    return texts.get(f"audit.people.{kind}", "{name}").format(name=name)


def alarm_of(row: AuditRow) -> int | None:
    """Return the number of the alarm that a row concerns; None for other rows."""
    is_one = row.action.startswith("alarms.") and _ALARM.fullmatch(row.object)
    return int(row.object) if is_one else None


def _occurring(connection: Connection, name: str, chosen: str) -> list[str]:
    """Return the values of a column in the newest rows, sorted, including the chosen one."""
    newest = select(AUDIT.c[name]).order_by(AUDIT.c.seq.desc()).limit(_NEWEST).subquery()
    found = connection.execute(select(newest.c[name]).distinct().limit(_AUDIT_LISTED)).scalars()
    return sorted({*found, *([chosen] if chosen else [])})


def _alarms(connection: Connection, rows: Sequence[AuditRow]) -> Mapping[int, str]:
    """Return the robots of the alarms in rows, by the number of the alarm."""
    numbers = sorted({number for row in rows if (number := alarm_of(row)) is not None})
    return dict(_named(connection, numbers)) if numbers else {}


def _named(connection: Connection, numbers: Sequence[int]) -> Iterator[tuple[int, str]]:
    for number, robots in robots_of(connection, numbers).items():
        if robots:
            yield number, ", ".join(sorted(str(one["robot"]) for one in robots))
