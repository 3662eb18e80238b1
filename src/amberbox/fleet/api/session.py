"""One's own session: sign in and out, who one is."""

from __future__ import annotations

from typing import Any

from amberbox.fleet.accounts.sessions import csrf_token
from amberbox.fleet.api.access import Routes, Who

routes = Routes("session")


@routes.get("/session", "own.read")
def read_session(who: Who) -> dict[str, Any]:
    """Return who asks, and the token that changes need."""
    principal = who.principal
    return {
        "kind": principal.kind,
        "name": principal.id,
        "role": principal.role,
        "groups": None if principal.groups is None else sorted(principal.groups),
        "csrf": csrf_token(who.secret) if who.secret else "",
    }
