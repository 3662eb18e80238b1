"""Little that becomes much: packed bodies, deep JSON, numbers without end."""

from __future__ import annotations

import gzip
import re
import resource
from collections.abc import Iterator
from pathlib import Path

import httpx
import msgspec
import pytest
import zstandard
from starlette.testclient import TestClient

from amberbox.link.folders import address
from tests.server.house import House, house
from tests.server.routes import all_routes

HASH = "ab" * 32
MB = 1 << 20
PATHS = {"robot": "ropod_001", "name": "viewer", "config_hash": HASH,
         "store_id": "12345678-1234-1234-1234-123456789012"}  # fmt: skip
DEEP = {
    "lists": b"[" * 200_000,
    "closed lists": b"[" * 100_000 + b"]" * 100_000,
    "objects": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "a number": b"1" * 200_000,
    "a number in a list": b"[" + b"9" * 10_000 + b"]",
    "an exponent": b'{"name": 1e999999999}',
    "halves of pairs": b'{"name": "\\ud800", "robot": "\\udfff"}',
    "no text": b"\xff\xfe\x00{",
    "the same key often": b"{" + b'"name":"x",' * 50_000 + b'"name":"x"}',
}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        yield found


def _taking_bodies(home: House) -> Iterator[tuple[str, str]]:
    for method, path in sorted(all_routes(home.app)):
        if method in ("POST", "PUT", "PATCH") and path != "/api/v1/session":
            yield method, re.sub(r"{(\w+)(:\w+)?}", lambda f: PATHS.get(f[1], "nothing"), path)


def _client(home: House, path: str) -> TestClient:
    return home.robot_client() if path.startswith("/link") else home.client("admin")


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@pytest.mark.parametrize("kind", DEEP)
def test_no_body_is_too_deep_for_any_route(home: House, kind: str) -> None:
    """Routes without a body must not read it; the others refuse it."""
    headers = {"Content-Type": "application/json"}
    for method, path in _taking_bodies(home):
        answer = _client(home, path).request(method, path, content=DEEP[kind], headers=headers)
        assert answer.status_code < 500, (method, path, answer.text)
    refused = home.client("admin").put("/api/v1/settings/retention", content=DEEP[kind],
                                       headers=headers)  # fmt: skip
    assert refused.status_code in (400, 422), refused.text


def test_a_packed_body_is_not_unpacked_where_nobody_expects_it(home: House) -> None:
    before = _peak()
    bomb = gzip.compress(bytes(100 * MB))
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    answer = home.client("admin").post("/api/v1/groups", content=bomb, headers=headers)
    assert answer.status_code in (400, 415, 422)
    assert _peak() - before < 50 * MB


@pytest.mark.parametrize("size", [40 * MB, 2_000 * MB])
def test_a_folder_that_would_be_too_large_is_refused_before_it_is(home: House, size: int) -> None:
    before = _peak()
    compressor = zstandard.ZstdCompressor(level=1).compressobj()
    bomb = b"".join(compressor.compress(bytes(MB)) for _ in range(size // MB)) + compressor.flush()
    assert len(bomb) < size // 1000
    answer = home.robot_client().put(address(HASH), content=bomb)
    _refused(answer)
    assert _peak() - before < 120 * MB


def test_a_folder_that_says_it_is_small_is_believed_nothing(home: House) -> None:
    content = msgspec.msgpack.encode({"robot.yaml": bytes(40 * MB)})
    honest = zstandard.ZstdCompressor(write_content_size=True).compress(content)
    silent = zstandard.ZstdCompressor(write_content_size=False).compress(content)
    for bomb in (honest, silent, honest[:-10], honest + honest):
        _refused(home.robot_client().put(address(HASH), content=bomb))


def test_a_folder_of_very_many_or_very_deep_things_is_refused(home: House) -> None:
    pack = zstandard.ZstdCompressor().compress
    many = {f"a/{number}.yaml": b"" for number in range(20_000)}
    for content in (
        msgspec.msgpack.encode(many),
        b"\x91" * 100_000 + b"\xc0",
        b"\xdf\xff\xff\xff\xff",  # a map of 4 billion pairs, of which none comes
        b"\x81\xa1a\xc6\xff\xff\xff\xff",  # a file of 4 GB, of which nothing comes
    ):
        _refused(home.robot_client().put(address(HASH), content=pack(content)))


def _refused(answer: httpx.Response) -> None:
    assert answer.status_code in (400, 413, 422), (answer.status_code, answer.text)


def test_nothing_of_it_was_kept(home: House) -> None:
    folders: list[Path] = [*(home.services.folder / "folders").rglob("*.yaml")]
    assert folders == []
