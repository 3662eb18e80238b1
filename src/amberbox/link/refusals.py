"""Codes that tell programs apart why a server answers 503; older servers send none."""

from __future__ import annotations

import json

NOT_SET_UP = "not_set_up"
"""The server has no admin yet; asking again helps only once somebody has made one."""
BUSY = "busy"
"""Too much at this moment: ask again."""
DAMAGED = "damaged"
"""The server's database is damaged: somebody has to restore it."""


def why_unavailable(body: bytes) -> str:
    """Return in words why a server answered 503, by the body of its answer."""
    try:
        error = json.loads(body)["error"]
        code, what = str(error.get("code", "")), str(error["what"])
    except (ValueError, KeyError, TypeError, AttributeError):  # a proxy's, or none at all
        return "it is too busy, or not set up yet"
    if code == NOT_SET_UP:
        return (
            "it is not set up yet and waits for its first admin: on the server "
            "'amberbox serve add-user NAME --data DIR', or its page /setup"
        )
    return what[:300]
