"""Credentials for servers: stored tokens, pinned authorities, TLS trust, and making a token.

A token and a pin per server are stored in a file that only its owner can read. A pinned authority
is trusted, else those of the system.
"""

from __future__ import annotations

import os
import ssl
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec

from amberbox.client.address import read_address
from amberbox.client.transport import ApiConnection, UnreachableError
from amberbox.core import tls
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import write_private

VARIABLE = "AMBERBOX_TOKEN"
_FILE = "servers.yaml"


@dataclass(frozen=True, slots=True)
class StoredSignIn:
    """A stored sign-in; ``pin`` is the SHA-256 of the server's authority, empty for the system's.

    ``authority`` is the certificate of a pinned authority, in PEM.
    """

    token: str = field(repr=False)
    pin: str = ""
    authority: str = ""


def path() -> Path:
    """Return the path of the file with sign-ins."""
    home = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(home) / "amberbox" / _FILE


def sign_in_of(url: str) -> StoredSignIn | None:
    """Return the stored sign-in for a server; None if there is none.

    Raises UsageError when others can read the file.
    """
    values = _read().get(url)
    if not isinstance(values, Mapping):
        return None
    texts = {name: str(values.get(name) or "") for name in ("token", "ca", "authority")}
    return StoredSignIn(texts["token"], texts["ca"].removeprefix("sha256:"), texts["authority"])


def keep(url: str, entry: StoredSignIn) -> None:
    """Store a sign-in for a server."""
    kept = {"token": entry.token, "ca": f"sha256:{entry.pin}" if entry.pin else "",
            "authority": entry.authority}  # fmt: skip
    _write({**_read(), url: {key: value for key, value in kept.items() if value}})


def forget(url: str) -> bool:
    """Delete the sign-in for a server; return whether there was one."""
    known = dict(_read())
    found = known.pop(url, None) is not None
    if found:
        _write(known)
    return found


def _read() -> Mapping[str, Any]:
    import yaml

    file = path()
    try:
        with file.open(encoding="utf-8") as opened:
            if os.fstat(opened.fileno()).st_mode & 0o077:
                raise UsageError(f"others can read the tokens in {file}", f"chmod 600 {file}")
            found = yaml.safe_load(opened.read())
    except FileNotFoundError:
        return {}
    except (yaml.YAMLError, UnicodeDecodeError):
        raise AmberboxError(f"{file} cannot be read", "delete it and sign in again") from None
    return found if isinstance(found, Mapping) else {}


def _write(known: Mapping[str, Any]) -> None:
    import yaml

    file = path()
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_private(file, yaml.safe_dump(dict(known)))


def context_of(url: str, pin: str, kept: StoredSignIn | None) -> ssl.SSLContext | None:
    """Return the TLS context for a server; None for plain HTTP, which is for this machine only.

    The certificate of a pinned authority is taken from the sign-in, else fetched from the server
    and compared. Raises PinError for another authority than the pinned one.
    """
    if urlsplit(url).scheme == "http":
        return None
    wanted = pin or (kept.pin if kept else "")
    if not wanted:
        return ssl.create_default_context()
    if kept and kept.authority and kept.pin == tls.normal_fingerprint(wanted):
        return tls.pinned_context(kept.authority.encode(), wanted)
    return tls.pinned_context(authority_of(url), wanted)


def authority_of(url: str) -> bytes:
    """Return the certificate of a server's authority (PEM), fetched from it.

    Raises UnreachableError.
    """
    try:
        return tls.fetch_ca(url)
    except OSError as error:
        why = error.strerror or str(error)
        raise UnreachableError(
            f"{url} does not answer: {why}", "is the address right, and does the server run?"
        ) from error


def context_from(file: Path) -> ssl.SSLContext:
    """Return a TLS context that trusts only the authorities in a PEM file."""
    try:
        return ssl.create_default_context(cafile=str(file))
    except (OSError, ssl.SSLError) as error:
        raise UsageError(f"{file} holds no certificate: {error}") from error


def wire_to(url: str, token: str | None, ca: str | Path | None, timeout_s: float) -> ApiConnection:
    """Return a connection to a server with token and TLS context, not opened yet."""
    from amberbox.client.transport import ApiConnection

    address = read_address(url)
    kept = sign_in_of(address.url)
    given = os.environ.get(VARIABLE) if token is None else token
    text = given or (kept.token if kept and token is None else "")
    if isinstance(ca, Path) or (ca and not ca.startswith("sha256:")):
        return ApiConnection(address.url, text or "", context_from(Path(ca)), timeout_s)
    context = context_of(address.url, str(ca or address.pin), kept)
    return ApiConnection(address.url, text or "", context, timeout_s)


class _Session(msgspec.Struct):
    csrf: str
    must_change: bool = False


class _Made(msgspec.Struct):
    token: str


def make_token(
    wire: ApiConnection, name: str, password: str, called: str, scopes: Collection[str]
) -> str:
    """Sign in, make a token of this name, and sign out; return its secret.

    Raises UsageError for a password that has to be changed first, NotSignedInError for a wrong one,
    NotAllowedError if the account may not make tokens.
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
