"""Where the server listens, and whether that is safe: plain HTTP never leaves the machine."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from amberbox.core.errors import UsageError
from amberbox.fleet.serving import certificates
from amberbox.fleet.serving.certificates import Files
from amberbox.fleet.serving.forwarded import is_loopback
from amberbox.fleet.serving.settings import Network, Settings

PORT = 8443
_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Wanted:
    """How somebody wants the server to be reached, as it was typed."""

    host: str = _LOOPBACK
    port: int = PORT
    public_url: str = ""
    proxies: Sequence[str] = ()


def settings_of(folder: Path, wanted: Wanted) -> Settings:
    """Decide how the server is reached; raises UsageError for what would not be safe."""
    if not 0 <= wanted.port <= 65535:
        raise UsageError(f"{wanted.port} is no port", "take one of 1 to 65535")
    if wanted.proxies:
        return _behind(wanted)
    files = Files(folder)
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
    return Settings(url, wanted.host, wanted.port)


def checked_url(text: str) -> str:
    """Return the address of a server without a slash at its end; raises UsageError."""
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
    """Tell whether a name or address is this machine and nothing else."""
    return host == "localhost" or is_loopback(host)


def networks(texts: Sequence[str]) -> tuple[Network, ...]:
    """Read addresses and networks of proxies; raises UsageError."""
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


def _behind(wanted: Wanted) -> Settings:
    if not wanted.public_url:
        raise UsageError(
            "behind a proxy the server has to know what it is called",
            "--public-url https://fleet.example",
        )
    url = checked_url(wanted.public_url)
    if not url.startswith("https://"):
        raise UsageError(f"{url} is not encrypted", "let the proxy speak TLS: https://...")
    return Settings(url, wanted.host, wanted.port, networks(wanted.proxies))


def _secure(folder: Path, files: Files, wanted: Wanted) -> Settings:
    names = certificates.names_of(folder)
    url = checked_url(wanted.public_url or f"https://{_netloc(names[0], wanted.port)}")
    if (urlsplit(url).hostname or "") not in names:
        raise UsageError(
            f"the certificate is for {', '.join(names)}, not for {urlsplit(url).hostname}",
            f"amberbox serve cert --data {folder} --host {urlsplit(url).hostname}",
        )
    if not url.startswith("https://"):
        raise UsageError(f"the server speaks TLS, {url} does not", "say https://")
    return Settings(url, wanted.host, wanted.port, (), files.server, files.server_key, names)


def _netloc(host: str, port: int) -> str:
    name = f"[{host}]" if ":" in host else host
    return f"{name}:{port}"
