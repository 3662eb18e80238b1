"""The live robot: over ZeroMQ, with the truth beside it, and orders while it runs."""

from __future__ import annotations

import io
import json
import queue
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from amberbox.core.errors import UsageError
from amberbox.sim.__main__ import main, parse_fault
from amberbox.sim.faults import catalogue
from amberbox.sim.live import LiveRun, apply_order, listen, publish
from amberbox.sim.robot import Robot
from amberbox.testing.clock import PATIENCE_S


class _Wire:
    """Stores the sent messages, and the size of the truth file at that time."""

    def __init__(self, truth: Path | None = None) -> None:
        self.sent: list[list[bytes]] = []
        self.truth = truth

    def send_multipart(self, msg_parts: list[bytes]) -> None:
        self.sent.append(msg_parts)
        if self.truth is not None:
            assert self.truth.read_text().count("\n") >= len(self.sent)


def test_the_truth_is_written_before_each_message_goes_out(tmp_path: Path) -> None:
    path = tmp_path / "truth.jsonl"
    wire = _Wire(path)
    plan = LiveRun("max", 0.5, path)
    count = publish(Robot(5), wire, plan, queue.SimpleQueue(), threading.Event())
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert count == len(wire.sent) == len(lines) > 80
    for (topic, data), line in zip(wire.sent, lines, strict=True):
        header = json.loads(data)["header"]
        stamp_ns = header["stamp"]["sec"] * 10**9 + header["stamp"]["nanosec"]
        assert line == {"topic": topic.decode(), "seq": header["seq"], "stamp_ns": stamp_ns}


def test_orders_are_obeyed_between_ticks() -> None:
    orders: queue.SimpleQueue[str] = queue.SimpleQueue()
    listen(io.StringIO("fault wifi_drops\n\nfault wifi_weak 12\nheal wifi_drops\n"), orders)
    robot = Robot(5)
    publish(robot, _Wire(), LiveRun("max", 0.2), orders, threading.Event())
    assert [(fault.id, fault.magnitude) for fault in robot.active_faults()] == [("wifi_weak", 12.0)]


@pytest.mark.parametrize(
    ("order", "answer"),
    [
        ("fault wifi_weak", "wifi_weak acts from 0.00 s on"),
        ("fault wifi_week", "did you mean wifi_weak"),
        ("fault wifi_weak much", "could not convert"),
        ("heal wifi_weak", "was not injected"),
        ("explode", "cannot read 'explode'"),
    ],
)
def test_answers_to_orders(order: str, answer: str) -> None:
    assert answer in apply_order(Robot(), order)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("wifi_weak", ("wifi_weak", 0.0, None)),
        ("wifi_weak@20s", ("wifi_weak", 20.0, None)),
        ("wifi_weak=10@2 min", ("wifi_weak", 120.0, 10.0)),
    ],
)
def test_faults_on_the_command_line(text: str, fault: tuple[str, float, float | None]) -> None:
    assert parse_fault(text) == fault


@pytest.mark.parametrize("text", ["wifi_weak=much", "wifi_weak@soon"])
def test_unreadable_faults_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_fault(text)


def test_the_catalogue_prints_as_table_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list-faults"]) == 0
    table = capsys.readouterr().out
    assert main(["--list-faults", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [fault["id"] for fault in listed] == list(catalogue())
    assert all(fault_id in table for fault_id in catalogue())


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ([], "nowhere to publish"),
        (["--zmq", "tcp://127.0.0.1:*", "--speed", "fast"], "no speed"),
        (["--zmq", "tcp://127.0.0.1:*", "--fault", "wifi_week"], "did you mean wifi_weak"),
        (["--zmq", "tcp://127.0.0.1:*", "--for", "soon"], "soon"),
        (["--zmq", "nonsense"], "cannot bind nonsense"),
    ],
)
def test_wrong_usage_ends_with_a_hint(
    arguments: list[str],
    part: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())  # its orders: none
    assert main(arguments) in (1, 2)
    told = capsys.readouterr().err
    assert part in told and "hint:" in told


def test_a_subscriber_hears_everything_until_sigterm(tmp_path: Path) -> None:
    """A real process and a real socket, from the first message to a clean end."""
    zmq = pytest.importorskip("zmq")
    truth = tmp_path / "truth.jsonl"
    command = [sys.executable, "-m", "amberbox.sim", "--zmq", "tcp://127.0.0.1:*", "--wait"]
    process = subprocess.Popen(
        [*command, "--truth", str(truth), "--speed", "4"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    endpoint = process.stdout.readline().split()[-1]
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVHWM, 0)
        socket.setsockopt(zmq.RCVTIMEO, 10_000)
        socket.subscribe(b"")
        socket.connect(endpoint)
        heard = [socket.recv_multipart() for _ in range(150)]
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=PATIENCE_S)
        socket.setsockopt(zmq.RCVTIMEO, 500)
        with pytest.raises(zmq.Again):
            while True:
                heard.append(socket.recv_multipart())
    assert process.returncode == 0, err
    assert out.startswith("published ")
    told = [json.loads(line) for line in truth.read_text().splitlines()]
    assert len(told) == len(heard)
    assert [line["topic"].encode() for line in told] == [topic for topic, _ in heard]
