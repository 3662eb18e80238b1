"""Settings of the server, each as a form of what it is made of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Literal
from urllib.parse import urlsplit

from fastapi import Path, Request, Response

from amberbox.fleet.api.access import Fleet, Who
from amberbox.fleet.api.notifications import list_notifications
from amberbox.fleet.api.settings import read_setting
from amberbox.fleet.notifying.settings import Notifications, Webhook
from amberbox.fleet.options.options import read
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()

_LISTED = 20
Name = Annotated[Literal["retention", "notifications", "alarms", "downloads"], Path()]


@routes.get("/admin/settings/{setting}", "settings.write")
def show(request: Request, fleet: Fleet, who: Who, setting: Name) -> Response:
    """Show a setting as a form; of notifications also what became of the last messages."""
    tells = setting == "notifications"
    messages = list_notifications(fleet, None, 0, 0, _LISTED) if tells else []
    return render(
        request, "admin/setting.html", setting=asdict(read_setting(fleet, setting)),
        messages=messages, destinations=_destinations(fleet) if tells else [],
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Told:
    """Who is told: the name, how, and where in a few words."""

    name: str
    how: Literal["email", "webhook"]
    where: str


def _destinations(fleet: Services) -> list[Told]:
    with fleet.database.reading() as connection:
        found = read(connection, "notifications", Notifications)
    return [
        Told(one.name, "webhook", urlsplit(one.url).netloc) if isinstance(one, Webhook)
        else Told(one.name, "email", ", ".join(one.to))
        for one in found.destinations()
    ]  # fmt: skip
