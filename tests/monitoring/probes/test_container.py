"""Containers, queried from an HTTP server on a Unix socket, as container engines have it."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import UnixStreamServer
from typing import Any

import pytest

from amberbox.core.errors import AmberboxError
from amberbox.monitoring.probes.container import ask
from amberbox.testing.clock import PATIENCE_S

RUNNING = {"State": {"Status": "running", "Running": True}, "RestartCount": 2}
SICK = {"State": {"Status": "running", "Health": {"Status": "unhealthy"}}, "RestartCount": 0}
WELL = {"State": {"Status": "running", "Health": {"Status": "healthy"}}, "RestartCount": 0}
OVER = {"State": {"Status": "exited", "Health": {"Status": ""}}, "RestartCount": 0}
ANSWERS: Mapping[str, tuple[int, Any]] = {
    "/containers/rosbridge/json": (200, RUNNING),
    "/containers/sick/json": (200, SICK),
    "/containers/well/json": (200, WELL),
    "/containers/over/json": (200, OVER),
    "/containers/torn/json": (500, {"message": "no"}),
    "/containers/a%2F..%2Fb/json": (200, RUNNING),
}


class Engine(BaseHTTPRequestHandler):
    """A part of the Docker Engine API, with GET only."""

    def do_GET(self) -> None:
        status, answer = ANSWERS.get(self.path, (404, {"message": "No such container"}))
        data = json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def address_string(self) -> str:
        return "socket"

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the log."""


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "docker.sock"
    with UnixStreamServer(str(path), Engine) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield path
        server.shutdown()
        thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("name", "ok", "state", "health", "restarts"),
    [
        ("rosbridge", True, "running", None, 2),
        ("sick", False, "running", "unhealthy", 0),
        ("well", True, "running", "healthy", 0),
        ("over", False, "exited", None, 0),
        ("a/../b", True, "running", None, 2),
    ],
)
def test_what_the_engine_says_is_read(
    engine: Path, name: str, ok: bool, state: str, health: str | None, restarts: int
) -> None:
    found = {"ok": ok, "state": state, "health": health, "restarts": restarts}
    assert ask([engine], name) == found


def test_a_container_that_is_not_there_is_not_ok(engine: Path) -> None:
    assert ask([engine], "rosbridg") == {"ok": False, "state": "absent"}


def test_the_engine_that_knows_it_answers_for_one_that_is_dead(
    engine: Path, tmp_path: Path
) -> None:
    dead = tmp_path / "podman.sock"
    dead.touch()  # nobody listens there
    assert ask([dead, engine], "well")["ok"] is True
    with pytest.raises(AmberboxError, match=r"podman\.sock: .*refused"):
        ask([dead, engine], "rosbridg")


def test_without_an_engine_or_with_a_broken_one_nothing_is_known(
    engine: Path, tmp_path: Path
) -> None:
    with pytest.raises(AmberboxError, match="neither Docker nor Podman"):
        ask([tmp_path / "no.sock"], "rosbridge")
    with pytest.raises(AmberboxError, match=r"docker\.sock: 500"):
        ask([engine], "torn")
