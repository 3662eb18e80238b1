"""One's own account: who one is, the password, sessions, tokens."""

from __future__ import annotations

from fastapi import Request, Response

from amberbox.fleet.accounts.actions import SCOPES
from amberbox.fleet.api.access import Fleet, Who
from amberbox.fleet.api.session import list_own as list_sessions
from amberbox.fleet.api.tokens import list_own as list_tokens
from amberbox.fleet.pages.account.device import device
from amberbox.fleet.pages.page import Pages, render

routes = Pages()


@routes.get("/account", "own.read")
def show(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show one's own account; who has to change the password first sees nothing else."""
    if who.principal.must_change:
        return render(request, "account/account.html", sessions=[], tokens=[], scopes={},
                      device=device)  # fmt: skip
    tokens = [token for token in list_tokens(fleet, who) if token.revoked is None]
    sessions = list_sessions(who, fleet)
    return render(request, "account/account.html", sessions=sessions, tokens=tokens, scopes=SCOPES,
                  device=device)  # fmt: skip
