"""Nothing leaves the machine: the server, its workers, its pages."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from amberbox.server.app import rules
from tests.support.processes import free_port

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def _environment(folder: Path) -> dict[str, str]:
    """Return one in which every Python process watches itself."""
    folder.mkdir()
    shutil.copy(HERE / "offline" / "watching.py", folder / "sitecustomize.py")
    paths = [str(folder), str(ROOT / "src"), str(ROOT)]
    log = str(folder / "attempts.log")
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "AMBERBOX_OFFLINE_LOG": log}


def _attempts(environment: dict[str, str]) -> str:
    log = Path(environment["AMBERBOX_OFFLINE_LOG"])
    return log.read_text() if log.exists() else ""


@pytest.mark.parametrize(
    "attempt",
    [
        "import socket; socket.create_connection(('192.0.2.1', 80), 1)",
        "import socket; socket.getaddrinfo('fleet.example', 443)",
        "import socket; socket.socket(type=socket.SOCK_DGRAM).sendto(b'x', ('192.0.2.1', 53))",
        "import urllib.request; urllib.request.urlopen('http://fleet.example', timeout=1)",
    ],
)
def test_an_attempt_would_be_seen(tmp_path: Path, attempt: str) -> None:
    environment = _environment(tmp_path / "watch")
    ended = subprocess.run(
        [sys.executable, "-c", attempt], env=environment, capture_output=True, text=True
    )
    assert ended.returncode != 0
    assert "beyond this machine" in ended.stderr
    assert _attempts(environment)


def test_a_server_reaches_nobody_else(tmp_path: Path) -> None:
    environment = _environment(tmp_path / "watch")
    port = str(free_port())
    program = [sys.executable, "-m", "tests.server.ingest.server", str(tmp_path / "data"), port]
    ended = subprocess.run(
        program, env=environment, capture_output=True, text=True, cwd=ROOT, timeout=100
    )
    assert ended.returncode == 0, ended.stderr
    assert _attempts(environment) == ""
    found = json.loads(ended.stdout.splitlines()[-1])
    reading = {path for method, path in rules() if method == "GET" and "{" not in path}
    assert reading <= set(found)
    assert all(status < 500 for status in found.values()), found
    for path in ("/api/docs", "/api/v1/robots", "/api/v1/robots/{robot}/items"):
        assert found[path] == 200, found
