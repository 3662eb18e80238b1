"""The command process as a real process: commands in, motions of a robot behind a socket out."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import msgspec
import pytest

from amberbox.agent.command_socket import (
    SOCKET,
    Answers,
    Challenge,
    FromGate,
    LinkBegins,
    MessageBuffer,
    SiteAsks,
    SiteConfirms,
    SiteConnection,
    SiteState,
    ToGate,
    packed,
)
from amberbox.cli.main import main
from amberbox.core import ed25519
from amberbox.core.command import (
    Command,
    Risk,
    encode_command,
    key_id,
    key_text,
    new_command_id,
    sign_command,
)
from amberbox.core.errors import AmberboxError
from amberbox.link.frames import CommandsFrame, LeaseFrame, RevokedFrame
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.processes import wait_for
from tests.support.zmq_robot import ZmqRobot, boot_s, zmq_robot

SERVER = "5e" * 16
PRIVATE = bytes(range(32))
ROBOT_YAML = """\
id: ropod_001
commands: TRUST
"""
TRUST = f"""\
server: {SERVER}
confirm: code
people:
  anna: {{key: "{key_text(ed25519.public_key_of(PRIVATE))}", risk: moves}}
"""
ACTIONS = """\
drive:
  kind: zmq_request
  endpoint: ENDPOINT
  request: {do: linear, distance_m: "{distance_m}"}
  poll: {do: state}
  until: {moving: false}
  poll_every: 0.05 s
  safe_stop: {do: stop}
  parameters:
    distance_m: {unit: m, min: -2, max: 2}
  risk: moves
  timeout: 60 s
light:
  kind: zmq_request
  endpoint: ENDPOINT
  request: {do: light}
  risk: state
"""


class Linked:
    """What the link process does: the server's frames in, reports out."""

    def __init__(self, store: Path) -> None:
        self.reports: list[FromGate] = []
        self._buffer = MessageBuffer()
        self._decoder = msgspec.msgpack.Decoder(FromGate)
        self._socket = socket.socket(socket.AF_UNIX)
        folder = os.open(store, os.O_PATH)
        self._socket.connect(f"/proc/self/fd/{folder}/{SOCKET}")
        os.close(folder)
        self._socket.settimeout(0.05)
        self.send(LinkBegins(SERVER))

    def send(self, *messages: ToGate) -> None:
        for message in messages:
            self._socket.sendall(packed(message))

    def wait(self, found: Callable[[FromGate], bool]) -> FromGate:
        """Return the first report that fits."""

        def look() -> FromGate | None:
            try:
                data = self._socket.recv(1 << 16)
                self.reports += map(self._decoder.decode, self._buffer.feed(data))
            except TimeoutError:
                pass
            return next(filter(found, self.reports), None)

        return cast("FromGate", wait_for(look, "a report"))

    def answer(self, command_id: str, *states: str) -> str:
        """Wait for one of these answers to a command; return its reason."""

        def fits(report: FromGate) -> bool:
            return isinstance(report, Answers) and any(
                one.id == command_id and one.state in states for one in report.answers
            )

        report = self.wait(fits)
        assert isinstance(report, Answers)
        return next(a.reason for a in report.answers if a.id == command_id and a.state in states)

    def take(self, run: str = "run-1") -> Challenge:
        """Take the lease; return the challenge that comes with it."""
        self.send(LeaseFrame("take", "anna", run))
        report = self.wait(lambda one: isinstance(one, Challenge) and one.lease.run == run)
        assert isinstance(report, Challenge)
        return report

    def order(
        self, action: str, parameters: str = "{}", *, risk: Risk = "state", at: Challenge,
    ) -> str:  # fmt: skip
        """Sign and send a command; return its id."""
        command = Command(
            new_command_id(), "ropod_001", action, parameters, "anna", risk, run=at.lease.run
        )
        signed = sign_command(
            command, PRIVATE, lease=at.lease.number, challenge=at.challenge, ttl_s=30, server=SERVER
        )
        self.send(CommandsFrame([encode_command(signed)]))
        return command.id

    def renew_until(self, number: int, done: Callable[[], object]) -> None:
        """Renew the lease until something holds."""
        end_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < end_s
            self.send(LeaseFrame("renew", "anna", "run-1", number))
            time.sleep(0.1)


@pytest.fixture
def robot() -> Iterator[ZmqRobot]:
    with zmq_robot() as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path, robot: ZmqRobot) -> Path:
    found = tmp_path / "robot"
    (found / "actions").mkdir(parents=True)
    (found / "actions" / "all.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
    trust = tmp_path / "trust.yaml"
    trust.write_text(TRUST)
    trust.chmod(0o600)
    (found / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    (found / "robot.yaml").write_text(ROBOT_YAML.replace("TRUST", str(trust)))
    return found


class Act:
    """The process; ``store`` is where its socket is."""

    def __init__(self, folder: Path) -> None:
        self.store = folder / "store"
        self._folder = folder
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "amberbox", "act", str(self._folder)]
        )
        wait_until(self._is_ready)

    def _is_ready(self) -> bool:
        try:
            self.site().close()
        except AmberboxError:
            assert self.process.poll() is None
            return False
        return True

    def site(self) -> SiteConnection:
        return SiteConnection(self.store)

    def state(self) -> SiteState:
        site = self.site()
        found = site.ask(SiteAsks())
        site.close()
        return found

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def act(folder: Path) -> Iterator[Act]:
    found = Act(folder)
    yield found
    found.process.terminate()
    assert found.process.wait(PATIENCE_S) == 0


def test_a_signed_command_is_carried_out_once(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    command = link.order("light", at=link.take())
    link.answer(command, "done")
    assert len(robot.heard("light")) == 1


def test_a_motion_waits_for_its_code_and_ends_with_the_lease(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    at = link.take()
    command = link.order("drive", '{"distance_m": 1}', risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    waiting = act.state().waiting
    assert waiting is not None and len(waiting.code) == 6 and waiting.person == "anna"
    site = act.site()
    site.ask(SiteConfirms("000000" if waiting.code != "000000" else "111111"))
    assert act.state().waiting is not None and not robot.hears
    site.ask(SiteConfirms(waiting.code))
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    last_s = boot_s()
    stopped_s = robot.wait_until("stop")[0]
    assert 2.0 < stopped_s - last_s <= 3.5
    assert "lease" in link.answer(command, "aborted")
    assert not act.state().running


def test_the_robot_stops_when_everything_of_ours_is_killed(
    act: Act, robot: ZmqRobot, folder: Path
) -> None:
    link = Linked(act.store)
    at = link.take()
    command = link.order("drive", '{"distance_m": 1}', risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    act.site().ask(SiteConfirms(on_site=True))
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    children = Path(f"/proc/{act.process.pid}/task/{act.process.pid}/children").read_text()
    act.process.send_signal(signal.SIGSTOP)  # it cannot react to the end of its actors
    for child in children.split():
        os.kill(int(child), signal.SIGKILL)
    act.kill()
    assert not robot.heard("stop")
    act.start()
    robot.wait_until("stop")
    again = Linked(act.store)
    assert "ended while" in again.answer(command, "outcome_unknown")
    assert len(robot.heard("linear")) == 1 and not act.state().running


def test_a_killed_process_leaves_no_motion(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    at = link.take()
    link.order("drive", '{"distance_m": 1}', risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    act.site().ask(SiteConfirms(on_site=True))
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    act.kill()
    at_s = boot_s()
    assert robot.wait_until("stop")[0] - at_s < 1.5
    act.start()


def test_a_revoked_key_stops_what_it_ordered(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    at = link.take()
    command = link.order("drive", '{"distance_m": 1}', risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    act.site().ask(SiteConfirms(on_site=True))
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    link.send(RevokedFrame([key_id(ed25519.public_key_of(PRIVATE))]))
    robot.wait_until("stop")
    assert "revoked" in link.answer(command, "aborted")
    refused = link.order("light", at=link.take("run-2"))
    assert "revoked" in link.answer(refused, "refused")
    assert not robot.heard("light")


def test_confirm_shows_confirms_and_aborts(
    act: Act, robot: ZmqRobot, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["confirm", str(folder), "--yes"]) == 1
    assert "nothing waits" in capsys.readouterr().out
    link = Linked(act.store)
    at = link.take()
    command = link.order("drive", '{"distance_m": 1}', risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    assert main(["confirm", str(folder)]) == 0
    assert "anna orders drive" in capsys.readouterr().out
    assert main(["confirm", str(folder), "--yes"]) == 0
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    assert main(["confirm", str(folder), "--abort"]) == 0
    robot.wait_until("stop")
    link.answer(command, "aborted")


def test_without_the_process_confirm_says_so(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "store").mkdir()
    assert main(["confirm", str(folder)]) == 1
    assert "amberbox run" in capsys.readouterr().err
