"""What all layers around the app share: their types, and answers that they give themselves."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TypeAlias

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["ASGIApp", "Message", "Pairs", "Receive", "Scope", "Send", "headers_of", "refuse"]

Pairs: TypeAlias = Sequence[tuple[bytes, bytes]]


def headers_of(scope: Scope) -> Headers:
    """Return the headers of a request."""
    return Headers(scope=scope)


async def refuse(
    scope: Scope,
    send: Send,
    status: int,
    what: str,
    hint: str = "",
    more: Pairs = (),
    code: str = "",
) -> None:
    """Answer a request, or a socket that wants to open, with an error of the usual form.

    ``code`` tells programs apart what has the same status.
    """
    said = {"what": what, "hint": hint, **({"code": code} if code else {})}
    body = json.dumps({"error": said}).encode()
    prefix = "websocket." if scope["type"] == "websocket" else ""
    about = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body)), *more]
    start = {"type": f"{prefix}http.response.start", "status": status, "headers": about}
    await send(start)
    content = b"" if scope.get("method") == "HEAD" else body
    await send({"type": f"{prefix}http.response.body", "body": content})
