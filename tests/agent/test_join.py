"""``amberbox join``: with a real server, a wrong one, and none."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn

from amberbox.agent.join import HelloResult
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.server import process
from amberbox.server.accounts.robots import add_robot
from amberbox.server.app import make_app
from amberbox.server.config import ServerSettings
from amberbox.testing.clock import PATIENCE_S
from tests.support.processes import free_port

OTHER_KEY = "abr_0123456789ab_" + "K" * 43


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, str]]:
    """A server on loopback with the robot r1: its port, and r1's key."""
    services = process.make_services(
        tmp_path_factory.mktemp("server"), ServerSettings("http://127.0.0.1")
    )
    with services.database.begin() as connection:
        key = add_robot(connection, time.time_ns(), "r1", ()).text
    config = uvicorn.Config(make_app(services), port=0, log_level="error", lifespan="off")
    running = uvicorn.Server(config)
    thread = threading.Thread(target=running.run, daemon=True)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    yield running.servers[0].sockets[0].getsockname()[1], key
    running.should_exit = True
    thread.join(PATIENCE_S)
    process.close(services)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "robot.yaml").write_text("# ours\nid: r1\n")
    (tmp_path / "black_box.yaml").write_text("- sim: {}\n")
    return tmp_path


def line(port: int, key: str, robot: str = "r1") -> str:
    return f"amberbox+http://{robot}:{key}@127.0.0.1:{port}/"


def test_a_robot_that_joins_is_known(
    folder: Path, server: tuple[int, str], capsys: pytest.CaptureFixture[str]
) -> None:
    port, key = server
    assert main(["join", str(folder), line(port, key)]) == 0
    said = capsys.readouterr().out
    assert "it knows this robot" in said and key not in said
    assert (folder / KEY_FILE).read_text() == f"{key}\n"
    assert (folder / KEY_FILE).stat().st_mode & 0o777 == 0o600
    text = (folder / "robot.yaml").read_text()
    assert text == f"# ours\nid: r1\n\nserver:\n  url: http://127.0.0.1:{port}\n"
    assert main(["join", str(folder), line(port, key)]) == 0, "once more changes nothing"
    assert (folder / "robot.yaml").read_text() == text


def test_a_server_that_refuses_the_key_leaves_everything_as_it_is(
    folder: Path, server: tuple[int, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["join", str(folder), line(server[0], OTHER_KEY)]) == 2
    assert "does not take this robot" in capsys.readouterr().err
    assert not (folder / KEY_FILE).exists()
    assert "server" not in (folder / "robot.yaml").read_text()


def test_a_server_that_does_not_answer_is_written_down(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["join", str(folder), line(free_port(), OTHER_KEY)]) == 1
    assert "cannot be reached now" in capsys.readouterr().out
    assert (folder / KEY_FILE).exists()


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (line(1, OTHER_KEY)[:40], "its address cannot be read"),
        (line(1, OTHER_KEY[:-3]), "cut off or changed"),
        (line(1, OTHER_KEY, "r2"), "is for the robot 'r2', this folder is 'r1'"),
        ("https://fleet.example", "does not begin with amberbox+https://"),
        (line(1, OTHER_KEY).replace("127.0.0.1", "192.0.2.7"), "without TLS"),
    ],
)
def test_a_wrong_line_is_refused(
    folder: Path, text: str, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["join", str(folder), text]) == 2
    said = capsys.readouterr().err
    assert what in said and OTHER_KEY not in said
    assert not (folder / KEY_FILE).exists()


def test_another_server_is_left_only_when_that_is_said(
    folder: Path, server: tuple[int, str], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "robot.yaml").write_text("id: r1\nserver:\n  url: https://other.example  # it\n")
    assert main(["join", str(folder), line(*server)]) == 2
    assert "names another server, https://other.example" in capsys.readouterr().err
    assert main(["join", str(folder), line(*server), "--replace"]) == 0
    assert "other.example" not in (folder / "robot.yaml").read_text()


def test_a_wrong_clock_is_named() -> None:
    assert HelloResult(30 * NS).clock_note == ""
    assert HelloResult(600 * NS).clock_note == "this computer's clock is 10 min behind the server's"
    assert "ahead of" in HelloResult(-20 * 3600 * NS).clock_note
