"""The recorder notifies systemd that it is ready, alive or stopping, and sends nothing
without it.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core.systemd import Notifier, notify, watchdog_s
from amberbox.testing.clock import PATIENCE_S

SIM = "- sim:\n    seed: 1\n    topics: [{name: odom}]\n"


@dataclass
class Manager:
    """What systemd is to a service: a datagram socket."""

    address: str
    link: socket.socket

    def heard(self) -> list[str]:
        found = []
        while True:
            try:
                found.append(self.link.recv(4096).decode())
            except BlockingIOError:
                return found

    def environ(self, **more: str) -> dict[str, str]:
        return {"NOTIFY_SOCKET": self.address, **more}


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(address)
        link.setblocking(False)
        yield Manager(address, link)


class Hand:
    """A monotonic clock that is moved by hand."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_message_reaches_a_socket_in_the_file_system(manager: Manager) -> None:
    assert notify("READY=1", manager.environ())
    assert manager.heard() == ["READY=1"]


def test_a_message_reaches_an_abstract_socket() -> None:
    name = f"amberbox-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(f"\0{name}")
        link.settimeout(PATIENCE_S)
        assert notify("READY=1", {"NOTIFY_SOCKET": f"@{name}"})
        assert link.recv(100) == b"READY=1"


@pytest.mark.parametrize("address", ["", "relative", "vsock:2:1234", "/nowhere/at/all"])
def test_nobody_there_is_no_trouble(address: str) -> None:
    assert not notify("READY=1", {"NOTIFY_SOCKET": address})
    assert not notify("READY=1", {})


@pytest.mark.parametrize(
    ("environ", "seconds"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "10000000"}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, 10.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_the_watchdog_is_the_one_of_this_process(
    environ: dict[str, str], seconds: float | None
) -> None:
    assert watchdog_s(environ) == seconds


def test_signs_of_life_come_twice_per_interval_and_only_once_ready(manager: Manager) -> None:
    clock = Hand()
    notifier = Notifier(manager.environ(WATCHDOG_USEC="10000000"), clock)
    notifier.alive(lambda: "waiting")
    assert manager.heard() == ["EXTEND_TIMEOUT_USEC=30000000\nSTATUS=waiting"]
    notifier.ready()
    notifier.ready()
    assert manager.heard() == ["READY=1"]
    for clock.now in (104.9, 105.0, 105.1, 109.9, 110.0):
        notifier.alive(lambda: f"at {clock.now}")
    assert manager.heard() == ["WATCHDOG=1\nSTATUS=at 105.0", "WATCHDOG=1\nSTATUS=at 110.0"]
    notifier.stopping()
    assert manager.heard() == ["STOPPING=1\nSTATUS=writing the rest"]


def test_what_nobody_took_is_said_again(tmp_path: Path) -> None:
    address = str(tmp_path / "notify")
    clock = Hand()
    notifier = Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "10000000"}, clock)
    notifier.ready()
    notifier.alive(lambda: "unheard")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(address)
        link.setblocking(False)
        notifier.ready()
        notifier.alive(lambda: "heard")
        assert Manager(address, link).heard() == ["READY=1", "WATCHDOG=1\nSTATUS=heard"]


def test_without_systemd_not_even_the_status_is_made() -> None:
    notifier = Notifier({})
    notifier.ready()
    notifier.alive(lambda: pytest.fail("nobody asked"))
    notifier.stopping()


def test_the_recorder_is_ready_once_bytes_are_there_and_says_when_it_stops(
    tmp_path: Path, manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text(SIM)
    recorder = Recorder(load_folder(tmp_path), retention=False)
    thread = threading.Thread(target=recorder.run)
    assert journal_bytes(tmp_path) == 0
    thread.start()
    manager.link.settimeout(PATIENCE_S)
    try:
        assert manager.link.recv(100) == b"READY=1"
        assert journal_bytes(tmp_path) > 0
        assert manager.link.recv(100).startswith(b"WATCHDOG=1\nSTATUS=")
    finally:
        recorder.stop.set()
        thread.join(PATIENCE_S)
    manager.link.setblocking(False)
    assert manager.heard()[-1].startswith("STOPPING=1")


def journal_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("store/journal/*.mcap"))


def test_a_recorder_that_hangs_gives_no_sign_of_life(
    tmp_path: Path, manager: Manager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", manager.address)
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text(SIM)
    recorder = Recorder(load_folder(tmp_path), retention=False)
    hangs, goes_on, tick = threading.Event(), threading.Event(), recorder.pipeline.tick
    signs = 0

    def tick_then_hang() -> None:
        if signs >= 2:
            hangs.set()
            assert goes_on.wait(PATIENCE_S)
        tick()

    monkeypatch.setattr(recorder.pipeline, "tick", tick_then_hang)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    manager.link.settimeout(PATIENCE_S)
    try:
        while signs < 2:
            signs += manager.link.recv(200).startswith(b"WATCHDOG=1")
        assert hangs.wait(PATIENCE_S)
        manager.link.setblocking(False)
        manager.heard()
        manager.link.settimeout(0.3)  # three intervals
        with pytest.raises(TimeoutError):
            manager.link.recv(200)
    finally:
        goes_on.set()
        recorder.stop.set()
        thread.join(PATIENCE_S)
