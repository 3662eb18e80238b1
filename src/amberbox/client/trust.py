"""Whom a client trusts: an authority that was pinned, else those of the system."""

from __future__ import annotations

import ssl
from pathlib import Path
from urllib.parse import urlsplit

from amberbox.client.errors import UnreachableError
from amberbox.client.servers import SignIn
from amberbox.core import tls
from amberbox.core.errors import UsageError


def context_of(url: str, pin: str, kept: SignIn | None) -> ssl.SSLContext | None:
    """Return what verifies a server; None for one of this machine without TLS.

    The certificate of a pinned authority is taken from the sign-in, else asked of the server and
    compared. Raises PinError for another authority than the pinned one.
    """
    if urlsplit(url).scheme == "http":
        return None
    wanted = pin or (kept.pin if kept else "")
    if not wanted:
        return ssl.create_default_context()
    if kept and kept.authority and kept.pin == tls.normal(wanted):
        return tls.pinned_context(kept.authority.encode(), wanted)
    return tls.pinned_context(authority_of(url), wanted)


def authority_of(url: str) -> bytes:
    """Ask a server for its authority's certificate; raises UnreachableError."""
    try:
        return tls.fetch_ca(url)
    except OSError as error:
        why = error.strerror or str(error)
        raise UnreachableError(
            f"{url} does not answer: {why}", "is the address right, and does the server run?"
        ) from error


def context_from(file: Path) -> ssl.SSLContext:
    """Return what trusts the authorities in a PEM file only."""
    try:
        return ssl.create_default_context(cafile=str(file))
    except (OSError, ssl.SSLError) as error:
        raise UsageError(f"{file} holds no certificate: {error}") from error
