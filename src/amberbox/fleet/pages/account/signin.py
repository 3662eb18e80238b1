"""The page to sign in."""

from __future__ import annotations

import re

from fastapi import Request, Response
from starlette.responses import RedirectResponse

from amberbox.fleet.api.access import Open
from amberbox.fleet.pages.page import Pages, render, visitor

routes = Pages()

_PATH = re.compile(r"/(?![/\\])[^\x00-\x20\\\x7f]*")


@routes.get("/sign-in", Open("asks for name and password; shows nothing"))
def show(request: Request, next: str = "/") -> Response:
    """Ask for name and password; who is signed in goes on to where they wanted to go."""
    onward = next if _is_here(next) else "/"
    if visitor(request) is not None:
        return RedirectResponse(onward, 303)
    return render(request, "account/signin.html", onward=onward)


def _is_here(address: str) -> bool:
    """Tell whether an address is a path of this server: nobody is led elsewhere.

    Browsers drop tabs and line ends, and take a backslash for a slash.
    """
    return _PATH.fullmatch(address) is not None
