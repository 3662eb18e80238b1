"""The middleware of the app: permissions, rates, sizes, and the access log."""

from __future__ import annotations

import asyncio
import ipaddress
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.types import Receive, Scope, Send

from amberbox.server.app import wrapped
from amberbox.server.config import ServerSettings
from amberbox.server.http.auth import COOKIE
from amberbox.server.middleware import (
    FILE,
    AccessLog,
    BodyLimit,
    BodyLimits,
    Hosts,
    Rate,
    RateLimits,
    SecurityHeaders,
)
from amberbox.testing.clock import ManualClock
from tests.server.house import URL, House, house

SETTINGS = ServerSettings(URL)
PROXIED = ServerSettings(URL, proxies=(ipaddress.ip_network("10.0.0.5"),))


async def hello(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer anything: what the layers let through gets here."""
    size = 0
    while True:
        message = await receive()
        size += len(message.get("body", b""))
        if not message.get("more_body"):
            break
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"%d" % size})


def ask(app: Any, path: str = "/", peer: str = "203.0.113.9", **options: Any) -> Any:
    client = TestClient(app, URL, client=(peer, 4711), raise_server_exceptions=False)
    return client.request(options.pop("method", "GET"), path, **options)


@pytest.mark.parametrize(
    ("host", "peer", "status"),
    [
        ("fleet.example", "203.0.113.9", 200),
        ("fleet.example:8443", "203.0.113.9", 200),
        ("evil.example", "203.0.113.9", 421),
        ("evil.example", "127.0.0.1", 421),  # a name that leads here by a trick of DNS
        ("localhost:8443", "127.0.0.1", 200),
        ("localhost", "203.0.113.9", 421),
        ("[::1]:8443", "::1", 200),
        ("[", "127.0.0.1", 421),
    ],
)
def test_only_names_of_this_server_are_answered(host: str, peer: str, status: int) -> None:
    assert ask(Hosts(hello, SETTINGS), peer=peer, headers={"Host": host}).status_code == status


def test_nobody_gets_around_the_proxy() -> None:
    app = Hosts(hello, PROXIED)
    assert ask(app, peer="10.0.0.5").status_code == 200
    assert ask(app, peer="203.0.113.9").status_code == 403
    assert ask(app, peer="203.0.113.9", headers={"X-Forwarded-For": "10.0.0.5"}).status_code == 403


def test_sockets_are_refused_as_requests_are() -> None:
    client = TestClient(Hosts(hello, SETTINGS), URL, client=("203.0.113.9", 1))
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        client.websocket_connect("/link/v1", headers={"host": "evil.example"}),
    ):
        pass
    assert refused.value.status_code == 421


def test_every_answer_says_what_a_browser_may_do_with_it() -> None:
    found = ask(SecurityHeaders(hello, SETTINGS), "/api/v1/robots").headers
    policy = dict(
        part.strip().split(" ", 1) for part in found["content-security-policy"].split(";")
    )
    assert policy["default-src"] == policy["script-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert "unsafe-inline" not in found["content-security-policy"]
    assert found["x-content-type-options"] == "nosniff"
    assert found["cache-control"] == "no-store"
    assert "strict-transport-security" in found
    plain = ask(SecurityHeaders(hello, ServerSettings("http://localhost:8443"))).headers
    assert "strict-transport-security" not in plain


def test_a_body_that_is_too_large_is_refused_before_and_while_it_comes() -> None:
    app = BodyLimits(hello, BodyLimit(most=1000))
    assert ask(app, method="POST", content=b"x" * 1000).text == "1000"
    assert ask(app, method="POST", content=b"x" * 1001).status_code == 413
    for length in ("-5", "9" * 5000, "²", "٣"):
        said = {"Content-Length": length.encode()}
        assert ask(app, method="POST", headers=said).status_code == 413


def test_pieces_of_journals_may_be_larger() -> None:
    path = "/link/v1/journals/a/main/b"
    assert ask(BodyLimits(hello), path, method="PATCH", content=b"x" * (4 << 20)).status_code == 200
    assert ask(BodyLimits(hello), path, method="PUT", content=b"x" * (4 << 20)).status_code == 413


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("layers") / "server") as found:
        yield found


def test_a_body_without_a_stated_length_is_counted_as_it_comes(home: House) -> None:
    app = BodyLimits(home.app, BodyLimit(most=1000))
    pieces = iter([b'{"name": "', b"x" * 2000, b'"}'])
    found = ask(app, "/api/v1/session", method="POST", content=pieces,
                headers={"Content-Type": "application/json"})  # fmt: skip
    assert (found.status_code, found.headers["connection"]) == (413, "close")


def test_a_body_that_does_not_come_is_given_up(home: House) -> None:
    app = BodyLimits(home.app, BodyLimit(pause_s=0.05))
    assert asyncio.run(_stalled(app)) == 408


async def _stalled(app: Any) -> int:
    """Send half a body, and then nothing."""
    sent = [{"type": "http.request", "body": b'{"na', "more_body": True}]
    statuses: list[int] = []

    async def receive() -> Any:
        if not sent:
            await asyncio.Event().wait()
        return sent.pop()

    async def send(message: Any) -> None:
        statuses.append(message.get("status", 0))

    scope = {
        "type": "http", "method": "POST", "path": "/api/v1/session", "query_string": b"",
        "headers": [(b"content-type", b"application/json")], "client": ("203.0.113.9", 1),
        "scheme": "https", "server": ("fleet.example", 443), "http_version": "1.1",
        "root_path": "", "raw_path": b"/api/v1/session",
    }  # fmt: skip
    await app(scope, receive, send)
    return statuses[0]


class Limited:
    """Rate limits with a clock that is moved by hand."""

    def __init__(self, settings: ServerSettings = SETTINGS) -> None:
        self.now_s = 0.0
        rates = {"address": Rate(6, 1.0), "principal": Rate(3, 1.0)}
        self.app = RateLimits(hello, settings, clock_s=lambda: self.now_s, **rates)

    def statuses(self, count: int, path: str = "/api/v1/x", **options: Any) -> list[int]:
        return [ask(self.app, path, **options).status_code for _ in range(count)]


def test_who_asks_too_often_waits() -> None:
    limited = Limited()
    assert limited.statuses(7) == [200] * 6 + [429]
    assert ask(limited.app).headers["retry-after"] == "1"
    assert limited.statuses(1, peer="203.0.113.10") == [200], "others do not wait"
    limited.now_s += 2.0
    assert limited.statuses(3) == [200, 200, 429]


def test_one_session_cannot_take_all_of_an_address() -> None:
    limited = Limited()
    mine = {"Cookie": f"other=1; {COOKIE}=mine"}
    assert limited.statuses(4, headers=mine) == [200, 200, 200, 429]
    same = {"Cookie": f"{COOKIE}=mine; other=2"}
    assert limited.statuses(1, headers=same) == [429], "another cookie makes nobody else"
    assert limited.statuses(1, headers={"Authorization": "Bearer other"}) == [200]


def test_forged_headers_do_not_make_somebody_else() -> None:
    limited = Limited()
    forged = [{"X-Forwarded-For": f"198.51.100.{n}"} for n in range(7)]
    assert [limited.statuses(1, headers=one)[0] for one in forged] == [200] * 6 + [429]
    behind = Limited(PROXIED)
    through = [behind.statuses(1, peer="10.0.0.5", headers=one)[0] for one in forged]
    assert through == [200] * 7, "what the proxy says counts"


def test_robots_are_not_counted() -> None:
    limited, key = Limited(), {"Authorization": "Robot r1:abr_x"}
    assert limited.statuses(20, "/link/v1/journals/x", headers=key) == [200] * 20
    assert limited.statuses(7, "/link/v1x", headers=key)[-1] == 429
    assert limited.statuses(1, "/link/v1/ca.pem") == [429], "without a key it is one of many"


def test_who_only_says_that_he_is_a_robot_is_counted() -> None:
    async def refuses(scope: Scope, receive: Receive, send: Send) -> None:
        is_good = dict(scope["headers"])[b"authorization"] == b"Robot r1:good"
        start: Any = {
            "type": "http.response.start",
            "status": 200 if is_good else 401,
            "headers": [],
        }
        await send(start)
        await send({"type": "http.response.body", "body": b""})

    app = RateLimits(refuses, SETTINGS, strangers=Rate(3, 1.0), clock_s=lambda: 0.0)
    bad = [{"Authorization": f"Robot r1:{number}"} for number in range(5)]
    good, path = {"Authorization": "Robot r1:good"}, "/link/v1/journals/x"
    assert ask(app, path, headers=good).status_code == 200
    assert [ask(app, path, headers=one).status_code for one in bad] == [401, 401, 429, 429, 429]
    assert ask(app, path, headers=good).status_code == 200, "its key has worked"


def test_requests_are_written_down_without_what_is_private(home: House, tmp_path: Path) -> None:
    clock = ManualClock(1_800_000_000 * 10**9)
    log = AccessLog(home.app, tmp_path, PROXIED, clock)
    cookie = home.client("admin").cookies[COOKIE]
    ask(log, "/api/v1/session?secret=hunter2", peer="10.0.0.5",
        headers={"Cookie": f"{COOKIE}={cookie}", "X-Forwarded-For": "203.0.113.9"})  # fmt: skip
    ask(log, "/nowhere%0Aforged")
    log.close()
    path = tmp_path / FILE
    assert path.stat().st_mode & 0o777 == 0o600
    first, second = map(json.loads, path.read_text().splitlines())
    assert first.pop("ms") >= 0
    assert first == {
        "time": "2027-01-15T08:00:00.000000000Z", "principal": "user:admin",
        "address": "203.0.113.9", "method": "GET", "path": "/api/v1/session", "status": 200,
    }  # fmt: skip
    assert (second["principal"], second["status"]) == ("", 404)
    assert "hunter2" not in path.read_text() and cookie not in path.read_text()


def test_all_layers_together_answer_as_the_app_does(home: House) -> None:
    served = wrapped(home.services)
    cookie = {"Cookie": f"{COOKIE}={home.client('viewer').cookies[COOKIE]}"}
    found = ask(served, "/api/v1/session", headers=cookie)
    assert found.json()["name"] == "viewer"
    assert found.headers["x-content-type-options"] == "nosniff"
    assert ask(served, "/", headers={"Host": "evil"}).headers["x-frame-options"] == "DENY"
    served.close()
