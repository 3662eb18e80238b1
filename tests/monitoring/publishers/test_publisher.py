"""Statuses over ZeroMQ: a real subscriber gets them, and none can delay the watcher."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from amberbox.blackbox.robot_folder.folder import inspect_folder
from amberbox.blackbox.robot_folder.robot_yaml import Format, PublishOptions
from amberbox.core.errors import AmberboxError
from amberbox.monitoring.status_publisher import StatusPublisher
from amberbox.testing.clock import PATIENCE_S, ManualClock
from tests.monitoring.publishers.laser import OF_DEVICE, PLAN, STATUSES


@contextmanager
def subscriber(url: str, **options: Any) -> Iterator[Any]:
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    for name, value in options.items():
        setattr(socket, name, value)
    socket.subscribe(b"")
    socket.connect(url)
    try:
        yield socket
    finally:
        context.destroy(linger=0)


@contextmanager
def publishing(*entries: PublishOptions, **how: Any) -> Iterator[StatusPublisher]:
    publisher = StatusPublisher(entries, PLAN, **how)
    publisher.open()
    try:
        yield publisher
    finally:
        publisher.close()


def first_heard(publisher: StatusPublisher, socket: Any) -> list[bytes]:
    """Publish until the subscriber, whose subscription takes a moment, has received a message."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        publisher.publish(STATUSES)
        if socket.poll(20):
            frames: list[bytes] = socket.recv_multipart()
            return frames
    raise TimeoutError("nothing was heard")


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/statuses"


def at_once(url: str, format_: Format = "paper", topic: str = "") -> PublishOptions:
    return PublishOptions(url, format_, every=1e-6, topic=topic)


def test_subscriber_gets_the_papers_messages(url: str) -> None:
    with publishing(at_once(url)) as publisher, subscriber(url) as socket:
        (frame,) = first_heard(publisher, socket)
        message = json.loads(frame)
    assert message["robotId"] == "ropod_001"
    assert message["healthStatus"] == {"front_laser_working": True, "rear_laser_working": True}


def test_topic_is_the_first_frame(url: str) -> None:
    entry = at_once(url, "health_status", "HEALTH-STATUS")
    with publishing(entry) as publisher, subscriber(url) as socket:
        topic, frame = first_heard(publisher, socket)
    assert topic == b"HEALTH-STATUS"
    assert json.loads(frame)["payload"]["monitors"][0]["component_id"] == "laser"


def test_formats_share_an_address(url: str) -> None:
    entries = (at_once(url, "diagnostics", "d"), at_once(url, "health_status", "h"))
    with publishing(*entries) as publisher, subscriber(url) as socket:
        first_heard(publisher, socket)
        heard = {first_heard(publisher, socket)[0] for _ in range(4)}
    assert heard == {b"d", b"h"}


def test_tcp_is_heard_as_well() -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as free:
        port = free.bind_to_random_port("tcp://127.0.0.1")
    url = f"tcp://127.0.0.1:{port}"
    with publishing(at_once(url)) as publisher, subscriber(url) as socket:
        assert first_heard(publisher, socket)


def test_numbers_of_numpy_are_published(url: str) -> None:
    outputs: dict[str, Any] = {"a": np.float64(1.5), "b": np.bool_(True)}
    status = replace(OF_DEVICE, outputs=outputs)
    with publishing(at_once(url)) as publisher, subscriber(url) as socket:
        first_heard(publisher, socket)
        publisher.publish([status])
        heard = b""
        while b'"a"' not in heard:
            assert socket.poll(PATIENCE_S * 1000)
            heard = socket.recv()
    assert json.loads(heard)["healthStatus"] == {"a": 1.5, "b": True}


class Noting(StatusPublisher):
    """Records which outlets publish instead of sending."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.spoke: list[str] = []

    def _send(self, outlet: Any, statuses: object, diagnosis: object) -> None:
        self.spoke.append(outlet.options.topic)


def test_each_address_keeps_its_pace(url: str) -> None:
    clock = ManualClock()
    entries = (replace(at_once(url), every=0.5), replace(at_once(url, topic="slow"), every=2.0))
    publisher = Noting(entries, PLAN, lambda: clock.boot_ns() / 1e9)
    publisher.open()
    for _ in range(41):  # 0.0 to 4.0 s
        publisher.publish(STATUSES)
        assert not publisher.is_due()
        clock.advance(0.1)
    publisher.close()
    assert publisher.spoke.count("") == 9
    assert publisher.spoke.count("slow") == 3


def test_pace_begins_anew_after_a_pause(url: str) -> None:
    clock = ManualClock()
    publisher = Noting([replace(at_once(url), every=1.0)], PLAN, lambda: clock.boot_ns() / 1e9)
    publisher.open()
    for pause_s in (0.0, 60.0, 0.5, 0.5):
        clock.advance(pause_s)
        publisher.publish(STATUSES)
    publisher.close()
    assert len(publisher.spoke) == 3


def test_slow_subscriber_holds_nobody_up_and_misses_some(url: str) -> None:
    rounds = 20_000
    with publishing(at_once(url)) as publisher, subscriber(url, rcvhwm=1) as socket:
        first_heard(publisher, socket)
        for _ in range(rounds):
            publisher.publish(STATUSES)
        waiting = 0
        while socket.poll(100):
            socket.recv()
            waiting += 1
    assert 0 < waiting < 2 * rounds


def test_nothing_is_opened_without_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zmq, "Context", lambda: pytest.fail("a socket is opened"))
    with publishing() as publisher:
        publisher.publish(STATUSES)
        assert not publisher.is_due()


def test_address_that_is_taken_is_an_error(url: str) -> None:
    with publishing(at_once("tcp://127.0.0.1:5599")):
        other = StatusPublisher([at_once(url), at_once("tcp://127.0.0.1:5599")], PLAN)
        with pytest.raises(AmberboxError, match=r"published at tcp://127.0.0.1:5599: Address"):
            other.open()
        assert not other.is_due()


def test_documented_entries_are_sound(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "robot" / "status.md").read_text("utf-8")
    (shown,) = re.findall(r"```yaml\n(monitoring:.*?)```", page, re.DOTALL)
    (tmp_path / "robot.yaml").write_text(f"id: robot\n{shown}")
    (tmp_path / "black_box.yaml").write_text("- zmq: {endpoint: tcp://localhost:5555}\n")
    folder, problems = inspect_folder(tmp_path)
    assert problems == []
    assert folder is not None
    assert [entry.format for entry in folder.robot.monitoring.publish] == [
        "paper", "health_status", "diagnostics", "diagnostics", "mqtt",
    ]  # fmt: skip


def folder_problems(folder: Path, monitoring: str) -> list[str]:
    (folder / "robot.yaml").write_text(f"id: robot\nmonitoring:\n  publish:\n    - {monitoring}\n")
    (folder / "black_box.yaml").write_text("- zmq: {endpoint: tcp://localhost:5555}\n")
    return [str(problem) for problem in inspect_folder(folder)[1]]


@pytest.mark.parametrize(
    "url",
    ["tcp://127.0.0.1:5581", "tcp://localhost:1", "ipc:///run/x", "ros://", "ws://10.0.0.7:8765"],
)
def test_what_stays_on_the_computer_is_no_note(tmp_path: Path, url: str) -> None:
    of_ros = ", format: diagnostics" if url.startswith(("ros", "ws")) else ""
    assert folder_problems(tmp_path, f'{{url: "{url}"{of_ros}}}') == []


@pytest.mark.parametrize("url", ["tcp://*:5581", "tcp://10.0.0.7:5581", "ros://robot:11311"])
def test_check_notes_what_leaves_the_computer(tmp_path: Path, url: str) -> None:
    (note,) = folder_problems(tmp_path, f'{{url: "{url}", format: diagnostics}}')
    assert f"{tmp_path}/robot.yaml:4: note: monitoring.publish[0].url: '{url}'" in note
    assert "reads the robot's name, its components and their states" in note


@pytest.mark.parametrize(
    ("entry", "what"),
    [
        ("{url: 5581}", "'5581' is no address"),
        ("{url: 'http://localhost:5581'}", "is no address"),
        ("{url: 'tcp://localhost'}", "has no port"),
        ("{url: 'tcp://localhost:0'}", "has no port"),
        ("{url: 'tcp://localhost:1', every: 0}", "must be above 0"),
        ("{url: 'tcp://localhost:1', format: papre}", "did you mean 'paper'"),
        ("{url: 'ros://', format: paper}", "ROS has no type for paper"),
        ("{url: 'ros://robot:x', format: diagnostics}", "write ros://robot:11311"),
        ("{url: 'ws://', format: diagnostics}", "is no address"),
        ("{url: 'ros://', format: diagnostics, topic: diag}", "is not a name ROS allows"),
    ],
)
def test_check_refuses_what_cannot_work(tmp_path: Path, entry: str, what: str) -> None:
    assert what in "\n".join(folder_problems(tmp_path, entry))


def test_stale_after_of_all_modes(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text("- zmq: {endpoint: tcp://localhost:5555}\n")
    for written, stale_s in (("2 min", 120.0), ("never", None), ("0.5", 0.5)):
        (tmp_path / "robot.yaml").write_text(f"id: a\nmonitoring: {{stale_after: {written}}}\n")
        folder, problems = inspect_folder(tmp_path)
        assert folder is not None, problems
        assert folder.robot.monitoring.stale_s == stale_s
    (tmp_path / "robot.yaml").write_text("id: a\nmonitoring: {stale_after: 0}\n")
    assert "must be above 0, or never" in "\n".join(map(str, inspect_folder(tmp_path)[1]))
