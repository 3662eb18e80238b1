"""What admins see first: what needs somebody, what is left to set up, and where all else is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fastapi import Request, Response

from amberbox.fleet.api.access import Caller, Fleet, Who
from amberbox.fleet.api.groups import list_groups
from amberbox.fleet.api.health import read_health
from amberbox.fleet.api.robots import list_cards
from amberbox.fleet.api.users import list_people
from amberbox.fleet.metrics.troubles import troubles as find_troubles
from amberbox.fleet.notifying.settings import Notifications
from amberbox.fleet.options.options import read
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()

_MOST = 1000
PAGES = (
    ("users", "person", "users.read"), ("teams", "graph", "users.read"),
    ("robots", "robot", "robots.write"), ("retention", "tape", "retention.write"),
    ("notifications", "bell", "settings.write"), ("alarms", "time", "settings.write"),
    ("downloads", "download", "settings.write"), ("audit", "note", "audit.read"),
    ("health", "heart", "metrics.read"), ("system", "box", "status.read"),
)  # fmt: skip
"""The pages below /admin: name, picture, and the action that one needs."""


@dataclass(frozen=True, slots=True)
class Step:
    """Something to set up before the server is of use, and whether it is done."""

    name: str
    href: str
    is_done: bool


@routes.get("/admin", "own.tokens")
def show(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show what needs somebody, and the pages that one may open."""
    pages = [(name, picture) for name, picture, action in PAGES if who.may(action)]
    steps = list(_steps(fleet, who)) if who.may("users.write") else []
    troubles = find_troubles(fleet) if who.may("metrics.read") else []
    health = read_health(fleet, Response()).status
    return render(request, "admin/admin.html", pages=pages, steps=steps, health=health,
                  troubles=troubles, is_new=not all(step.is_done for step in steps))  # fmt: skip


def _steps(fleet: Services, who: Caller) -> Iterator[Step]:
    groups, people = list_groups(fleet, "", _MOST), list_people(fleet, "", _MOST)
    cards = list_cards(fleet, who, "", "", _MOST)
    yield Step("team", "/admin/teams", bool(groups))
    yield Step("robot", "/admin/robots", bool(cards))
    yield Step("connect", "/admin/robots", any(card.last_seen for card in cards))
    yield Step("people", "/admin/users", len(people) > 1)
    yield Step("notify", "/admin/settings/notifications", bool(_destinations(fleet)))


def _destinations(fleet: Services) -> Sequence[object]:
    with fleet.database.reading() as connection:
        found = read(connection, "notifications", Notifications)
    return found.destinations()
