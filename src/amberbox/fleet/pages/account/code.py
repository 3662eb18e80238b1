"""The page of one-time links: its module takes the code from behind the ``#`` and signs in."""

from __future__ import annotations

from fastapi import Request, Response

from amberbox.fleet.api.access import Open
from amberbox.fleet.api.demo import InDemo
from amberbox.fleet.pages.page import Pages, render

routes = Pages()


@routes.get("/in", Open("signs in by a link, in a demonstration; 404 anywhere else"))
def show(request: Request, demo: InDemo) -> Response:
    """Show that somebody is being signed in; the code never comes here."""
    return render(request, "account/in.html")
