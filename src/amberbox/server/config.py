"""How the server was started: address and port, public URL, TLS, and trusted proxies.

Plain HTTP is offered to this machine only. ``X-Forwarded-*`` is used only from a trusted proxy.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from pathlib import Path
from urllib.parse import urlsplit

from amberbox.core.errors import UsageError
from amberbox.server import certificates
from amberbox.server.certificates import CertificateFiles

Network = IPv4Network | IPv6Network


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """How the server is reached.

    ``public_url`` is the URL for browsers and robots, without a trailing slash. ``proxies`` are the
    addresses whose ``X-Forwarded-*`` headers are trusted. ``certificate`` and ``key`` are set where
    the server does TLS itself; ``names`` are the names in its certificate.
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
        """Return whether browsers connect by TLS; cookies are then marked ``Secure``."""
        return self.public_url.startswith("https://")


Address = IPv4Address | IPv6Address


def client_address(peer: str, forwarded: Sequence[str], proxies: Sequence[Network]) -> str:
    """Return the address of the client.

    ``forwarded`` are the values of ``X-Forwarded-For``, read from the right because each proxy
    appends its client: the first address that is no trusted proxy is the client's. Entries left of
    it may be forged.
    """
    found = read(peer)
    if found is None or not is_trusted(found, proxies):
        return peer if found is None else str(found)
    for entry in reversed(",".join(forwarded).split(",")):
        address = read(entry)
        if address is None:
            break
        found = address
        if not is_trusted(found, proxies):
            break
    return str(found)


def is_trusted(address: Address, proxies: Sequence[Network]) -> bool:
    """Return whether an address belongs to a trusted proxy."""
    return any(address in network for network in proxies)


def read(text: str) -> Address | None:
    """Parse an address as peers and proxies write it, with a port or without; None if invalid."""
    plain = text.strip().strip('"')
    if plain.startswith("["):
        plain = plain[1:].partition("]")[0]
    elif plain.count(":") == 1:
        plain = plain.partition(":")[0]
    try:
        found = ipaddress.ip_address(plain.partition("%")[0])
    except ValueError:
        return None
    mapped = found.ipv4_mapped if isinstance(found, IPv6Address) else None
    return mapped or found


def is_loopback(text: str) -> bool:
    """Return whether an address is a loopback address."""
    found = read(text)
    return found is not None and found.is_loopback


PORT = 8443
_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class ListenOptions:
    """Options of ``amberbox serve``: how the server is to be reached."""

    host: str = _LOOPBACK
    port: int = PORT
    public_url: str = ""
    proxies: Sequence[str] = ()


def resolve_settings(folder: Path, wanted: ListenOptions) -> ServerSettings:
    """Return how the server is reached; raises UsageError for an unsafe combination."""
    if not 0 <= wanted.port <= 65535:
        raise UsageError(f"{wanted.port} is no port", "take one of 1 to 65535")
    if wanted.proxies:
        return _behind(wanted)
    files = CertificateFiles(folder)
    if files.are_there:
        return _secure(folder, files, wanted)
    if not is_local(wanted.host):
        raise UsageError(
            f"beyond this machine ({wanted.host}) the server is reached by TLS only",
            f"amberbox serve cert --data {folder} --host NAME makes a certificate; or say "
            "--behind-proxy ADDRESS --public-url https://NAME",
        )
    url = checked_url(wanted.public_url or f"http://{_netloc(wanted.host, wanted.port)}")
    if not is_local(urlsplit(url).hostname or ""):
        raise UsageError(
            f"{url} is not this machine, and nothing here speaks TLS",
            "a proxy that does is named with --behind-proxy ADDRESS",
        )
    return ServerSettings(url, wanted.host, wanted.port)


def checked_url(text: str) -> str:
    """Return a server URL without a trailing slash; raises UsageError for anything else."""
    try:
        parts = urlsplit(text.strip())
        is_right = parts.scheme in ("http", "https") and bool(parts.hostname)
        is_right = is_right and (parts.port is None or parts.port > 0)
    except ValueError:
        is_right = False
    if not is_right or parts.query or parts.fragment or parts.username or parts.path.strip("/"):
        raise UsageError(
            f"'{text}' is no address of a server", "such as https://fleet.example:8443"
        )
    return f"{parts.scheme}://{parts.netloc.lower()}"


def is_local(host: str) -> bool:
    """Return whether a host name or address is ``localhost`` or a loopback address."""
    return host == "localhost" or is_loopback(host)


def networks(texts: Sequence[str]) -> tuple[Network, ...]:
    """Parse addresses and networks of proxies; raises UsageError."""
    return tuple(map(_network, texts))


def _network(text: str) -> Network:
    try:
        found = ipaddress.ip_network(text.strip())
    except ValueError as error:
        raise UsageError(
            f"--behind-proxy {text}: {error}", "name the proxy's address, such as 10.0.0.5"
        ) from error
    if found.prefixlen == 0:
        raise UsageError(f"--behind-proxy {text} is everybody", "name the proxy's own address")
    return found


def _behind(wanted: ListenOptions) -> ServerSettings:
    if not wanted.public_url:
        raise UsageError(
            "behind a proxy the server has to know what it is called",
            "--public-url https://fleet.example",
        )
    url = checked_url(wanted.public_url)
    if not url.startswith("https://"):
        raise UsageError(f"{url} is not encrypted", "let the proxy speak TLS: https://...")
    return ServerSettings(url, wanted.host, wanted.port, networks(wanted.proxies))


def _secure(folder: Path, files: CertificateFiles, wanted: ListenOptions) -> ServerSettings:
    names = certificates.names_of(folder)
    url = checked_url(wanted.public_url or f"https://{_netloc(names[0], wanted.port)}")
    if (urlsplit(url).hostname or "") not in names:
        raise UsageError(
            f"the certificate is for {', '.join(names)}, not for {urlsplit(url).hostname}",
            f"amberbox serve cert --data {folder} --host {urlsplit(url).hostname}",
        )
    if not url.startswith("https://"):
        raise UsageError(f"the server speaks TLS, {url} does not", "say https://")
    return ServerSettings(url, wanted.host, wanted.port, (), files.server, files.server_key, names)


def _netloc(host: str, port: int) -> str:
    name = f"[{host}]" if ":" in host else host
    return f"{name}:{port}"
