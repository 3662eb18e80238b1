"""``amberbox play`` on the command line: its report, and what it refuses to do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zmq

from amberbox.cli.main import main
from amberbox.core.types import Topic
from tests.support.manual_recorder import COUNT, ManualBox, number

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def store(tmp_path: Path) -> Path:
    box = ManualBox(tmp_path / "store")
    for count in range(10):
        box.hear(COUNT, number(count))
        box.hear(Topic("pose", "json"), b'{"x": %d}' % count)
        box.write()
    box.close()
    return box.store


def test_json_is_played_over_zmq(store: Path, tmp_path: Path, capsys: Capture) -> None:
    endpoint = f"ipc://{tmp_path}/play"
    with zmq.Context() as context, context.socket(zmq.SUB) as sock:
        sock.subscribe(b"")
        sock.connect(endpoint)
        words = ["play", str(store), "--to", f"zmq={endpoint}", "--wait", "--speed", "max"]
        assert main([*words, "--json"]) == 0
        heard = [sock.recv_multipart() for _ in range(10)]
    assert heard == [[b"pose", b'{"x": %d}' % count] for count in range(10)]
    report = json.loads(capsys.readouterr().out)
    assert (report["counts"], report["unheard"], report["dropped"]) == ({"pose": 10}, 0, 0)
    assert report["left_out"] == {"/count": "its messages (ros1) are neither JSON nor msgpack"}


def test_a_store_that_is_being_recorded_is_played_up_to_now(
    tmp_path: Path, capsys: Capture
) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(Topic("pose", "json"), b'{"x": 1}')
    box.write()
    words = ["--to", f"zmq=ipc://{tmp_path}/play", "--speed", "max", "--json"]
    assert main(["play", str(box.store), *words]) == 0
    box.close()
    assert json.loads(capsys.readouterr().out)["counts"] == {"pose": 1}


def test_the_report_in_words(store: Path, tmp_path: Path, capsys: Capture) -> None:
    words = ["--to", f"zmq=ipc://{tmp_path}/play", "--speed", "1000", "--item", "ros_pose"]
    assert main(["play", str(store), *words]) == 0
    said = capsys.readouterr()
    assert "playing 1 topic of" in said.err
    lines = said.out.splitlines()
    assert lines[0].startswith("played 10 messages of 1 topic in ")
    assert lines[1:] == ["  nobody had subscribed to 10 of them"]


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ([], "the following arguments are required: --to"),
        (["--to", "12:00"], "the end of the range is --to-time"),
        (["--to", "zmq=5560"], "'5560' is no address"),
        (["--to", "zmq=tcp://127.0.0.1:5x"], "has no port"),
        (["--to", "foxglove=x"], "there is no port x"),
        (["--to", "foxglove", "--speed", "max"], "there is no --speed max for them"),
        (["--to", "ros=ftp://x"], "is not a protocol ROS masters speak"),
        (["--to", "ros", "--speed", "0"], "'0' is no speed"),
        (["--to", "ros", "--start-paused"], "--start-paused goes with --to foxglove"),
        (["--to", "zmq", "--clock"], "--clock goes with --to ros"),
        (["--to", "ros", "--prefix", "/9"], "is not a name that ROS allows"),
        (["--to", "ros", "--item", "ros_cuont"], "did you mean ros_count"),
        (["--to", "ros", "--item", "ros_pose"], "its messages (json) are none of ROS 1"),
        (["--to", "ros", "--mission", "last", "--from", "-1s"], "a mission has its own window"),
        (["--to", "ros", "--to-time", "soon"], "--to-time: "),
    ],
)
def test_wrong_usage(store: Path, words: list[str], what: str, capsys: Capture) -> None:
    assert main(["play", str(store), *words]) == 2
    assert what in capsys.readouterr().err


def test_an_open_address_is_noted(store: Path, tmp_path: Path, capsys: Capture) -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as taken:
        port = taken.bind_to_random_port("tcp://*")
        assert main(["play", str(store), "--to", f"zmq=tcp://*:{port}"]) == 1
    said = capsys.readouterr().err
    assert "can read what is played" in said and "cannot publish at tcp://*" in said
