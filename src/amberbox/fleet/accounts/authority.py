"""Which certificate authority robots are told to trust: the one that the server made itself."""

from __future__ import annotations

import hashlib
import ssl
from pathlib import Path

CERTIFICATE = Path("tls") / "ca.pem"
"""Where the server's own authority keeps its certificate, below the data folder."""


def fingerprint(folder: Path) -> str:
    """Return the SHA-256 of the authority's certificate, 64 hex digits; empty without one."""
    path = folder / CERTIFICATE
    if not path.is_file():
        return ""
    der = ssl.PEM_cert_to_DER_cert(path.read_text(encoding="ascii").strip() + "\n")
    return hashlib.sha256(der).hexdigest()
