"""Pages that answer, refuse, or are not there, from a real web server."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.http import measure
from tests.support.processes import free_port

ASKED: list[str] = []


class Page(BaseHTTPRequestHandler):
    """Answers with the status that the path names."""

    def do_GET(self) -> None:
        ASKED.append(self.path)
        self.send_response(int(self.path.strip("/").partition("?")[0] or 200))
        self.send_header("Location", "/500")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the log."""


@pytest.fixture
def address() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(
    ("path", "ok", "status"),
    [("", True, 200), ("/204?a=b", True, 204), ("/302", True, 302), ("/404", False, 404),
     ("/503", False, 503)],
)  # fmt: skip
def test_the_status_says_whether_it_works(address: str, path: str, ok: bool, status: int) -> None:
    found = measure(address + path)
    assert (found["ok"], found["status"]) == (ok, status)
    assert 0 < found["latency_ms"] < 4000
    assert ASKED[-1] == (path or "/"), "it is asked once and not followed elsewhere"


def test_where_nobody_listens_it_is_not_ok() -> None:
    assert measure(f"http://127.0.0.1:{free_port()}/") == {
        "ok": False,
        "error": "Connection refused",
    }


def test_a_name_without_an_address_is_unknown() -> None:
    with pytest.raises(OSError, match=r"not known|resolution"):
        measure("http://no-such-host.invalid/")


@pytest.mark.parametrize("subject", ["localhost:8080", "ftp://robot/", "http://", ""])
def test_what_is_no_address_is_refused(subject: str) -> None:
    with pytest.raises(UsageError, match="no address"):
        measure(subject)


def test_an_address_with_a_password_is_refused() -> None:
    with pytest.raises(UsageError, match="with a password is not asked"):
        measure("http://admin:secret@localhost/")
