"""One's own account: who one is, the password, sessions, tokens."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import Request, Response

from amberbox.fleet.accounts.actions import SCOPES
from amberbox.fleet.accounts.groups import list_groups
from amberbox.fleet.api.access import Fleet, Who
from amberbox.fleet.api.session import list_own as list_sessions
from amberbox.fleet.api.tokens import list_own as list_tokens
from amberbox.fleet.pages.account.device import device
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()


@routes.get("/account", "own.read")
def show(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show one's own account; who has to change the password first sees nothing else."""
    more = {} if who.principal.must_change else _more(fleet, who)
    return render(request, "account/account.html", **more)


def _more(fleet: Services, who: Who) -> Mapping[str, Any]:
    mine = who.principal.groups
    with fleet.database.reading() as connection:
        teams = list_groups(connection) if mine is None else sorted(mine)
    tokens = [token for token in list_tokens(fleet, who) if token.revoked is None]
    return {"sessions": list_sessions(who, fleet), "tokens": tokens, "scopes": SCOPES,
            "teams": teams, "device": device}  # fmt: skip
