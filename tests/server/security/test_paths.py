"""Names that lead elsewhere, break lines or are too long: in every part of every path and query."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from urllib.parse import quote

import httpx
import pytest
from starlette.testclient import TestClient

from tests.server.house import URL, House, house
from tests.server.routes import SOCKET, all_routes

CANARY = "the canary that no answer may hold"
NASTY = (
    "..",
    "../../canary.yaml",
    "..\\..\\canary.yaml",
    "/etc/passwd",
    "....//....//canary.yaml",
    "%2e%2e%2f%2e%2e%2fcanary.yaml",
    "canary.yaml\0.txt",
    "a\r\nX-Evil: 1\r\n\r\n<script>",
    "\N{FULLWIDTH FULL STOP}\N{FULLWIDTH FULL STOP}/canary.yaml",
    "'; DROP TABLE users; --",
    "%",
    "*",
    "x" * 3_000,
)
KNOWN = {
    "robot": "ropod_001",
    "config_hash": "ab" * 32,
    "store_id": "12345678-1234-1234-1234-123456789012",
    "folder": "20260101",
}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    around = tmp_path_factory.mktemp("around")
    with house(around / "deep" / "server") as found:
        for folder in (around, around / "deep", found.services.folder):
            (folder / "canary.yaml").write_text(CANARY)
        yield found


def _urls(path: str) -> Iterator[str]:
    """Yield a path with something nasty in the place of each of its names, one at a time."""
    names = re.findall(r"{(\w+)(?::\w+)?}", path)
    for nasty in NASTY:
        for chosen in names:
            url = path
            for name in names:
                value = nasty if name == chosen else KNOWN.get(name, "nothing")
                url = re.sub(rf"{{{name}(:\w+)?}}", quote(value, safe=""), url)
            yield url


def _files(home: House) -> set[str]:
    root = home.services.folder.parents[1]
    return {str(path.relative_to(root)) for path in root.rglob("*") if "tables" not in path.parts}


def _judge(answer: httpx.Response) -> None:
    assert answer.status_code < 500, (answer.request.url, answer.text)
    assert CANARY not in answer.text, answer.request.url
    assert "root:" not in answer.text, answer.request.url
    assert b"SQLite format" not in answer.content, answer.request.url
    assert "x-evil" not in answer.headers, answer.request.url


def test_no_path_leads_out_of_the_folder(home: House) -> None:
    before = _files(home)
    assert asyncio.run(_ask_all(home)) > 300
    assert {name for name in _files(home) - before if not name.endswith(("-wal", "-shm"))} == set()


async def _ask_all(home: House) -> int:
    """Ask every route with every name, all in one loop; return how often."""
    robot, admin = _client(home, home.robot_client()), _client(home, home.client("admin"))
    asked = 0
    for method, path in sorted(all_routes(home.app)):
        client = robot if path.startswith("/link") else admin
        for url in _urls(path) if method != SOCKET and "{" in path else ():
            _judge(await client.request(method, url))
            asked += 1
    return asked


def _client(home: House, who: TestClient) -> httpx.AsyncClient:
    transport = httpx.ASGITransport(home.app, raise_app_exceptions=False)
    return httpx.AsyncClient(
        transport=transport, base_url=URL, headers=who.headers, cookies=who.cookies
    )


@pytest.mark.parametrize("nasty", NASTY[1::3])
def test_no_query_breaks_an_answer(home: House, nasty: str) -> None:
    admin = home.client("admin")
    described = admin.get("/api/v1/openapi.json").json()["paths"]
    for path, methods in described.items():
        asked = [one["name"] for one in methods.get("get", {}).get("parameters", ())
                 if one["in"] == "query" and one["schema"].get("type") == "string"]  # fmt: skip
        if asked:
            url = re.sub(r"{(\w+)}", lambda found: KNOWN.get(found[1], "nothing"), path)
            for name in asked:
                _judge(admin.get(url, params={name: nasty}))


@pytest.mark.parametrize("nasty", NASTY)
def test_no_name_that_is_kept_leads_anywhere(home: House, nasty: str) -> None:
    admin = home.client("admin")
    for path, name in (("users", "name"), ("groups", "name"), ("robots", "robot")):
        more = {"role": "viewer"} if path == "users" else {}
        answer = admin.post(f"/api/v1/{path}", json={name: nasty, **more})
        assert answer.status_code in (400, 422), (path, nasty)
        _judge(answer)
