"""TLS of the link: the authority that a robot pinned, kept in its store once it was fetched."""

from __future__ import annotations

import ssl
from pathlib import Path
from urllib.parse import urlsplit

from amberbox.core.files import replace_file
from amberbox.core.tls import CA_PATH as CA_PATH
from amberbox.core.tls import PinError as PinError
from amberbox.core.tls import fetch_ca as fetch_ca
from amberbox.core.tls import fingerprint as fingerprint
from amberbox.core.tls import normal as normal
from amberbox.core.tls import pinned_context as pinned_context

FILE = "server-ca.pem"


def context_for(url: str, pin: str, store: Path) -> ssl.SSLContext | None:
    """Return what is needed to talk to a server; None for one without TLS.

    A pinned authority's certificate is fetched once and kept in the store; it is not trusted for
    where it came from, but for its fingerprint. Raises PinError, and OSError while nobody answers.
    """
    if urlsplit(url).scheme not in ("https", "wss"):
        return None
    if not pin:
        return ssl.create_default_context()
    kept = store / FILE
    if kept.exists() and _fits(kept.read_bytes(), pin):
        return pinned_context(kept.read_bytes(), pin)
    pem = fetch_ca(url)
    context = pinned_context(pem, pin)
    replace_file(kept, pem.decode("ascii"))
    return context


def _fits(pem: bytes, pin: str) -> bool:
    try:
        return fingerprint(pem) == normal(pin)
    except ValueError:
        return False
