"""What a server refuses, in its own words."""

from __future__ import annotations

import msgspec

from amberbox.core.errors import AmberboxError, UsageError


class UnreachableError(AmberboxError):
    """The server does not answer."""


class NotSignedInError(AmberboxError):
    """There is no token for this server, or it does not work (any more)."""

    exit_code = UsageError.exit_code


class NotAllowedError(AmberboxError):
    """The token works, but not for this."""

    exit_code = UsageError.exit_code


class ConflictError(AmberboxError):
    """Somebody changed it meanwhile: look again."""


class _Said(msgspec.Struct):
    what: str = ""
    hint: str = ""


class _Body(msgspec.Struct):
    error: _Said


def refused(status: int, body: bytes, url: str) -> AmberboxError:
    """Return the error that a server's answer stands for, with its address."""
    said = _said(body) or _Said(f"it answered with status {status}")
    what = f"{url}: {said.what}"
    if status == 401:
        return NotSignedInError(what, said.hint or f"amberbox sign-in {url}")
    if status == 403:
        hint = "who made the token can make one with more scopes, or with a higher role"
        return NotAllowedError(what, said.hint or hint)
    if status == 409:
        return ConflictError(what, said.hint or "look again, then decide")
    if status in (400, 404):
        return UsageError(what, said.hint)
    return AmberboxError(what, said.hint)


def _said(body: bytes) -> _Said | None:
    try:
        return msgspec.json.decode(body, type=_Body).error
    except msgspec.MsgspecError:
        return None
