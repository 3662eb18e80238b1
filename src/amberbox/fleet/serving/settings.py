"""What the server was started with."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network
from pathlib import Path

Network = IPv4Network | IPv6Network


@dataclass(frozen=True, slots=True)
class Settings:
    """How the server is reached.

    ``public_url`` is what browsers and robots call it, without a slash at the end. ``proxies`` are
    the addresses whose ``X-Forwarded-*`` headers are believed. ``certificate`` and ``key`` are
    there where the server speaks TLS itself; ``names`` are those of its certificate.
    """

    public_url: str
    host: str = "127.0.0.1"
    port: int = 8443
    proxies: tuple[Network, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    names: tuple[str, ...] = ()

    @property
    def is_secure(self) -> bool:
        """Tell whether browsers come by TLS: cookies are for such connections only then."""
        return self.public_url.startswith("https://")
