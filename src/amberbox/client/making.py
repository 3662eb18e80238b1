"""Make a token with somebody's name and password: for a computer from which that person works."""

from __future__ import annotations

from collections.abc import Collection

import msgspec

from amberbox.client.wire import Wire
from amberbox.core.errors import UsageError


class _Session(msgspec.Struct):
    csrf: str
    must_change: bool = False


class _Made(msgspec.Struct):
    token: str


def make_token(wire: Wire, name: str, password: str, called: str, scopes: Collection[str]) -> str:
    """Sign in, make a token of this name, sign out again; return its secret.

    Raises UsageError for a password that has to be changed first, NotSignedInError for a wrong one,
    NotAllowedError where this person may make none.
    """
    reply = wire.send("POST", "/session", {"name": name, "password": password})
    session = msgspec.json.decode(reply.body, type=_Session)
    cookie = reply.headers.get("set-cookie", "").partition(";")[0]
    wire.headers = {"Cookie": cookie, "X-CSRF-Token": session.csrf}
    try:
        if session.must_change:
            raise UsageError(
                f"{name} has to change the password first", "it was set by somebody else: sign in "
                f"at {wire.url} in a browser, or PUT {wire.url}/api/v1/session/password"
            )  # fmt: skip
        made = wire.send("POST", "/tokens", {"name": called, "scopes": sorted(scopes)})
        return msgspec.json.decode(made.body, type=_Made).token
    finally:
        wire.send("DELETE", "/session")
        wire.headers = {}
