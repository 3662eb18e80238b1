"""Whether a web page or service answers, such as the robot's own user interface."""

from __future__ import annotations

import http.client
import ssl
import time
from urllib.parse import urlsplit

from amberbox.core.errors import UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "status": ("int", "", "what it answers, such as 200; null without an answer"),
    "latency_ms": ("float", "ms", "until the answer began"),
}
SUBJECT = "its address, such as http://localhost:8080/status"
PERIOD_S = 2.0

_WAIT_S = 3.0
_WORKS = range(200, 400)


def measure(subject: str) -> Measured:
    """Get the page once, without following redirects; certificates are not checked."""
    parts = urlsplit(subject)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise UsageError(f"'{subject}' is no address", "such as http://localhost:8080/")
    if parts.username is not None:
        raise UsageError(
            "an address with a password is not asked", "leave it out: subjects are recorded"
        )
    begin_s = time.monotonic()
    connection = _connection(parts.scheme, parts.netloc)
    try:
        connection.request("GET", f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}")
        status = connection.getresponse().status
    except (ConnectionError, TimeoutError, http.client.HTTPException) as error:
        return {"ok": False, "error": _text(error)}
    finally:
        connection.close()
    latency_ms = (time.monotonic() - begin_s) * 1e3
    return {"ok": status in _WORKS, "status": status, "latency_ms": latency_ms}


def _text(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def _connection(scheme: str, place: str) -> http.client.HTTPConnection:
    if scheme == "http":
        return http.client.HTTPConnection(place, timeout=_WAIT_S)
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return http.client.HTTPSConnection(place, timeout=_WAIT_S, context=context)
