"""People, teams and robots: who may sign in, who sees what, which robots may connect."""

from __future__ import annotations

from fastapi import Request, Response

from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.tokens import working_tokens
from amberbox.fleet.api.access import Fleet, Who
from amberbox.fleet.api.enrolment import list_waiting_keys
from amberbox.fleet.api.forms import shown
from amberbox.fleet.api.groups import list_groups
from amberbox.fleet.api.robots import list_cards
from amberbox.fleet.api.users import list_people
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()

_MOST = 1000


@routes.get("/admin/users", "users.read")
def show_people(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show who may sign in."""
    people = list_people(fleet, "", _MOST)
    with fleet.database.reading() as connection:
        tokens = working_tokens(connection, fleet.clock.wall_ns())
    return render(request, "admin/users.html", people=people, roles=list(Role), tokens=tokens,
                  teams=_teams(fleet), rfc3339=shown, may=who.may("users.write"))  # fmt: skip


@routes.get("/admin/teams", "users.read")
def show_teams(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show the groups of robots and people."""
    groups = list_groups(fleet, "", _MOST)
    return render(request, "admin/teams.html", groups=groups, may=who.may("users.write"))


@routes.get("/admin/robots", "robots.write")
def show_robots(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show which robots may connect, and whether they do."""
    return render(request, "admin/robots.html", cards=list_cards(fleet, who, "", "", _MOST),
                  teams=_teams(fleet), waiting_keys=list_waiting_keys(fleet))  # fmt: skip


def _teams(fleet: Services) -> list[str]:
    return [group.name for group in list_groups(fleet, "", _MOST)]
