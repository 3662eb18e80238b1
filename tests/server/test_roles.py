"""Every route and socket as everybody: who gets through is written in roles.yaml, by hand."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
import yaml
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from amberbox.server.accounts.permissions import SCOPES
from tests.server.house import URL, House, house
from tests.server.people import VICTIM, headers_of, page, settle
from tests.server.routes import SOCKET, all_routes

TABLE = yaml.safe_load((Path(__file__).parent / "roles.yaml").read_text(encoding="utf-8"))
NOT_THERE = "there is no such robot, or not for you"
REFUSED = (401, 403)
ELSEWHERE = ("/sign-in", "/account")
FOREIGN = ("https://evil.example", "null", "http://fleet.example", f"{URL}.evil.example")
READS = ("GET", "HEAD", SOCKET)
RUNNER = asyncio.Runner()
_KEPT: dict[tuple[str, str | None], dict[str, str]] = {}
PATH: Mapping[str, str] = {
    "robot": "ropod_001",
    "name": VICTIM,
    "config_hash": "ab" * 32,
    "store_id": "12345678-1234-1234-1234-123456789012",
}
"""Values of parameters in paths; other parameters get an unknown name."""


@dataclass(frozen=True)
class Written:
    """A line of the table: a route, the scope that tokens need for it, who gets through."""

    method: str
    path: str
    scope: str | None
    through: frozenset[str]

    @property
    def url(self) -> str:
        """Return the path with names in it."""
        return re.sub(r"{(\w+)(:\w+)?}", lambda found: PATH.get(found[1], "nothing"), self.path)


def _written(route: str, profile: str) -> Written:
    method, path = route.split(" ")
    said = TABLE["profiles"][profile]
    return Written(method, path, said.get("scope"), frozenset(said["through"]))


WRITTEN = [_written(*line) for line in TABLE["routes"].items()]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house")) as found:
        settle(found)
        yield found
        RUNNER.close()


def test_every_route_is_in_the_table_and_no_other(home: House) -> None:
    answered = all_routes(home.app)
    written = {(line.method, line.path) for line in WRITTEN}
    assert sorted(answered - written) == [], "not in roles.yaml"
    assert sorted(written - answered) == [], "in roles.yaml, and nowhere else"


def test_the_table_names_nobody_unknown() -> None:
    assert all(line.through <= set(TABLE["principals"]) for line in WRITTEN)
    assert {line.scope for line in WRITTEN} <= {None, *SCOPES}
    assert set(TABLE["profiles"]) == set(TABLE["routes"].values())


@pytest.mark.parametrize("line", WRITTEN, ids=lambda line: f"{line.method} {line.path}")
def test_who_gets_through(home: House, line: Written) -> None:
    got = {name for name in TABLE["principals"] if _gets_through(home, line, name)}
    assert got == line.through


def test_changes_need_the_token_of_the_session(home: House) -> None:
    for line in WRITTEN:
        if line.method not in READS and "nobody" not in line.through:
            cookie = headers_of(home, "admin", None)["Cookie"]
            answer = _ask(home, line, {"Cookie": cookie})
            assert answer.status_code in REFUSED, (line.method, line.path)


def test_sockets_are_closed_to_pages_of_others(home: House) -> None:
    sockets = [line for line in WRITTEN if line.method == SOCKET]
    assert sockets
    for line in sockets:
        cookie = headers_of(home, "admin", None)["Cookie"]
        for origin in (
            "https://evil.example",
            "null",
            "http://fleet.example",
            f"{URL}.evil.example",
        ):
            headers = {"Cookie": cookie, "Origin": origin}
            assert not _opens(page(home, headers), line.url), (line.path, origin)
        assert not _opens(page(home, {"Cookie": cookie}), line.url), f"{line.path} without Origin"


def test_sockets_with_a_key_are_no_pages(home: House) -> None:
    for line in WRITTEN:
        if line.method == SOCKET:
            headers = headers_of(home, "robot" if "robot" in line.through else "token", line.scope)
            assert _opens(page(home, headers), line.url)
            for more in ({"Origin": URL}, headers_of(home, "admin", None)):
                with_page = {**more, **headers}
                assert not _opens(page(home, with_page), line.url), (line.path, list(more))


def _headers(home: House, line: Written, principal: str) -> dict[str, str]:
    """Return what a principal sends; after anything but reading, sessions and keys may be over."""
    if line.method not in READS:
        _KEPT.clear()
        return headers_of(home, principal, line.scope)
    key = (principal, line.scope)
    if key not in _KEPT:
        _KEPT[key] = headers_of(home, principal, line.scope)
    return _KEPT[key]


def _gets_through(home: House, line: Written, principal: str) -> bool:
    headers = _headers(home, line, principal)
    if line.method == SOCKET:
        client = page(home, headers)
        if "Cookie" in headers:
            client.headers["Origin"] = URL
        return _opens(client, line.url)
    return _is_through(_ask(home, line, headers))


def _ask(home: House, line: Written, headers: dict[str, str]) -> httpx.Response:
    return RUNNER.run(_asked(home, line, headers))


async def _asked(home: House, line: Written, headers: dict[str, str]) -> httpx.Response:
    transport = httpx.ASGITransport(home.app, raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url=URL, headers=headers) as client:
        return await client.request(line.method, line.url)


def _is_through(answer: httpx.Response) -> bool:
    assert answer.status_code < 500, answer.text
    if answer.status_code == 404:
        return NOT_THERE not in answer.text
    if answer.status_code == 303:  # what is not for somebody leads them to sign in
        return not answer.headers["location"].startswith(ELSEWHERE)
    return answer.status_code not in REFUSED


def _opens(client: TestClient, url: str) -> bool:
    try:
        with suppress(CancelledError), client.websocket_connect(url):
            return True  # leaving ends the socket's task: no fault of the route
        return True
    except WebSocketDenialResponse as denied:
        assert denied.status_code in (*REFUSED, 404)
    except WebSocketDisconnect as closed:
        assert closed.code in (1008, 4401, 4403)
    return False
