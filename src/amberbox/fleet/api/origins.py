"""Which pages are our own: browsers say from which origin a request comes."""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from amberbox.fleet.serving.binding import is_local
from amberbox.fleet.serving.settings import Settings

_PORTS = {"https": 443, "http": 80}


def is_own_page(origin: str, connection: HTTPConnection, settings: Settings) -> bool:
    """Tell whether an origin is that of this server's pages.

    It is its public address; on the machine itself also the local name by which it was asked.
    """
    asked = _parts(origin)
    if asked == _parts(settings.public_url):
        return True
    here = f"{asked[0]}://{connection.headers.get('host', '')}"
    scheme = "https" if settings.certificate is not None else "http"
    is_here = asked == _parts(here) and asked[0] == scheme and is_local(asked[1])
    return is_here and not settings.proxies


def _parts(url: str) -> tuple[str, str, int | None]:
    try:
        parts = urlsplit(url)
        return parts.scheme, parts.hostname or "", parts.port or _PORTS.get(parts.scheme)
    except ValueError:
        return "", url, None
