"""The command process as a real process: commands in, motions of a robot behind a socket out."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import cast

import msgspec
import pytest

from amberbox.agent.command_gate import LEASE_S
from amberbox.agent.command_socket import (
    SOCKET,
    Announcement,
    Answers,
    Challenge,
    FromGate,
    LinkBegins,
    MessageBuffer,
    OrderOutcome,
    OrderReport,
    SiteAsks,
    SiteConfirms,
    SiteConnection,
    SiteOrders,
    SiteState,
    SocketServer,
    ToGate,
    WaitingMotion,
    packed,
)
from amberbox.blackbox.query import record
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
from amberbox.core.files import wait_readable
from amberbox.link.frames import (
    AbortFrame,
    CommandsFrame,
    ConfirmFrame,
    LeaseFrame,
    RevokedFrame,
)
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.processes import wait_for
from tests.support.zmq_robot import ACTIONS, ZmqRobot, boot_s, zmq_robot

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
        self._socket.settimeout(PATIENCE_S)
        for message in messages:
            self._socket.sendall(packed(message))
        self._socket.settimeout(0.05)

    def wait(self, found: Callable[[FromGate], bool]) -> FromGate:
        """Return the first report that fits."""

        def look() -> FromGate | None:
            self.read()
            return next(filter(found, self.reports), None)

        return cast("FromGate", wait_for(look, "a report"))

    def read(self) -> None:
        """Read the reports that have come, for a moment."""
        with suppress(TimeoutError):
            data = self._socket.recv(1 << 16)
            self.reports += map(self._decoder.decode, self._buffer.feed(data))

    def answer(self, command_id: str, *states: str) -> str:
        """Wait for one of these answers to a command; return its reason."""

        def fits(report: FromGate) -> bool:
            return isinstance(report, Answers) and any(
                one.id == command_id and one.state in states for one in report.answers
            )

        report = self.wait(fits)
        assert isinstance(report, Answers)
        return next(a.reason for a in report.answers if a.id == command_id and a.state in states)

    def done(self, command_id: str, at: Challenge) -> None:
        """Wait until a command is done; the lease it was ordered under is renewed meanwhile."""

        def look() -> bool:
            self.send(LeaseFrame("renew", "anna", at.lease.run, at.lease.number))
            self.read()
            return any(
                one.id == command_id and one.state == "done"
                for report in self.reports
                if isinstance(report, Answers)
                for one in report.answers
            )

        wait_for(look, "the end of a command")

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
    at = link.take()
    link.done(link.order("light", at=at), at)
    assert len(robot.heard("light")) == 1


def test_an_actor_that_was_killed_while_it_waited_is_replaced(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    at = link.take()
    children = Path(f"/proc/{act.process.pid}/task/{act.process.pid}/children")
    waiting = wait_for(children.read_text, "the actor that waits").split()
    for child in waiting:
        os.kill(int(child), signal.SIGKILL)
    link.done(link.order("light", at=at), at)
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
    assert robot.wait_until("stop")[0] - at_s < PATIENCE_S
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


def test_a_flood_of_commands_holds_up_neither_renewals_nor_an_abort(
    act: Act, robot: ZmqRobot
) -> None:
    link = Linked(act.store)
    at = link.take()
    command = link.order("drive", '{"distance_m": 1}', risk="moves", at=at)
    link.renew_until(at.lease.number, lambda: act.state().waiting)
    act.site().ask(SiteConfirms(on_site=True))
    link.renew_until(at.lease.number, lambda: robot.heard("linear"))
    flood = [
        encode_command(Command(new_command_id(), "ropod_001", "light", "{}", "eve", "record"))
        for _ in range(5000)
    ]
    until_s = boot_s() + LEASE_S + 1.0  # longer than a lease lasts without renewals
    while boot_s() < until_s:
        for start in range(0, len(flood), 100):
            link.send(CommandsFrame(flood[start : start + 100]))
        link.send(LeaseFrame("renew", "anna", "run-1", at.lease.number))
        link.read()
        assert act.state().running and not robot.heard("stop")
    link.send(*(CommandsFrame(flood[n : n + 100]) for n in range(0, 5000, 100)), AbortFrame())
    sent_s = boot_s()
    assert robot.wait_until("stop")[0] - sent_s < 2.0
    assert "the server" in link.answer(command, "aborted")
    rows = list(record.open(act.store).query("amberbox_command", ["state", "text"]).rows())
    assert sum(row["state"] == "refused" for row in rows) < 400
    texts = [str(row["text"]) for row in rows]
    assert any("commands were dropped" in text for text in texts)
    assert any("too many to be recorded" in text for text in texts)


def test_a_server_that_lies_moves_nothing(act: Act, robot: ZmqRobot) -> None:
    link = Linked(act.store)
    before_reboot = link.take()
    act.kill()
    act.start()
    link = Linked(act.store)
    at = link.take()

    def drive(to: str = "ropod_001", ttl_s: int = 30, minted: Challenge = at) -> Command:
        ordered = Command(
            new_command_id(), to, "drive", '{"distance_m": 1}', "anna", "moves", run="run-1"
        )
        return sign_command(
            ordered, PRIVATE, lease=at.lease.number, challenge=minted.challenge, ttl_s=ttl_s,
            server=SERVER,
        )  # fmt: skip

    def changed(**values: object) -> Command:
        return msgspec.structs.replace(drive(), **values)

    def say(*frames: ToGate) -> None:
        link.send(LeaseFrame("renew", "anna", "run-1", at.lease.number), *frames)

    lies = [
        changed(parameters='{"distance_m": 2}'), changed(run="run-2"), changed(risk="state"),
        changed(id=new_command_id()), changed(signature=None), drive(to="ropod_002"),
        drive(ttl_s=31_536_000), drive(minted=before_reboot),
    ]  # fmt: skip
    for lie in lies:
        say(CommandsFrame([encode_command(lie)]))
        assert link.answer(lie.id, "refused")
    honest = drive()
    frame = bytearray(encode_command(honest))
    frame[-1] ^= 1  # the last byte of the signature
    say(CommandsFrame([bytes(frame)]))
    assert "signature is not that of anna" in link.answer(honest.id, "refused")
    waits = drive()
    say(CommandsFrame([encode_command(waits)]))
    link.wait(lambda report: isinstance(report, Challenge) and report.waiting == waits.id)
    code = cast("WaitingMotion", act.state().waiting).code
    guesses = [f"{number:06d}" for number in range(4) if f"{number:06d}" != code]
    say(*(ConfirmFrame(waits.id, guess) for guess in guesses[:3]))
    assert "3 times" in link.answer(waits.id, "refused")
    say(ConfirmFrame(waits.id, code), CommandsFrame([encode_command(waits)]))
    link.done(link.order("light", at=at), at)
    assert [said["do"] for _, said in robot.hears] == ["light"]


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


class Terminal:
    """``amberbox action run`` in the folder of the robot."""

    def __init__(self, folder: Path, *words: str) -> None:
        command = [sys.executable, "-m", "amberbox", "action", "run", str(folder), *words]
        self.process = subprocess.Popen(command, stdout=-1, stderr=-1, text=True)

    def end(self) -> tuple[int, str]:
        out, error = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out + error


def test_somebody_at_the_robot_orders_and_stops(act: Act, robot: ZmqRobot, folder: Path) -> None:
    link = Linked(act.store)
    first = Terminal(folder, "drive", "distance_m=1", "--yes")
    robot.wait_until("linear")
    lease = act.state().lease
    assert lease.holder.endswith("at the robot")
    second = Terminal(folder, "light").end()
    assert second[0] == 1 and f"held by {lease.holder}" in second[1]
    link.send(LeaseFrame("take", "anna", "run-1"))
    refused = link.wait(lambda one: isinstance(one, Challenge) and bool(one.lease.reason))
    assert isinstance(refused, Challenge) and "at the robot" in refused.lease.reason
    link.send(LeaseFrame("release", lease.holder, "", lease.number))
    first.process.send_signal(signal.SIGINT)
    robot.wait_until("stop")
    code, text = first.end()
    assert code == 130 and "aborted by" in text
    assert not act.state().lease.holder, "it ends with its order"
    assert Terminal(folder, "light").end()[0] == 0 and robot.heard("light")
    at = link.take()
    signed = link.order("light", at=at)
    link.done(signed, at)
    answers = [report.answers for report in link.reports if isinstance(report, Answers)]
    heard = {one.id for several in answers for one in several}
    assert heard == {signed}, "a server hears only answers to its own commands"


def test_a_terminal_that_is_killed_stops_the_robot(act: Act, robot: ZmqRobot, folder: Path) -> None:
    first = Terminal(folder, "drive", "distance_m=1", "--yes")
    robot.wait_until("linear")
    first.process.kill()
    robot.wait_until("stop")
    first.end()
    wait_until(lambda: not act.state().running)


def test_a_terminal_that_hangs_loses_the_robot(act: Act, robot: ZmqRobot, folder: Path) -> None:
    first = Terminal(folder, "drive", "distance_m=1", "--yes")
    robot.wait_until("linear")
    first.process.send_signal(signal.SIGSTOP)
    robot.wait_until("stop")
    first.process.send_signal(signal.SIGCONT)
    code, text = first.end()
    assert code == 1 and "lease" in text


def test_what_moves_needs_a_confirmation_in_the_order(act: Act, robot: ZmqRobot) -> None:
    site = act.site()
    site.send(SiteOrders("ab" * 16, "drive", '{"distance_m": 1}', "nico"))
    site.send(SiteOrders("cd" * 16, "drive", '{"distance_m": 9}', "nico", True))
    site.send(SiteOrders("ef" * 16, "fly", "[]", "nico", True))
    found: list[FromGate] = []

    def look() -> bool:
        found.extend(site.received(0.1))
        return len(found) == 3

    wait_until(look)
    refused = [one for one in found if isinstance(one, OrderOutcome)]
    assert {one.state for one in refused} == {"refused"}
    texts = [one.reason for one in refused]
    assert "was not confirmed" in texts[0] and "above the largest" in texts[1] and texts[2]
    assert not robot.hears


def test_the_server_learns_what_an_action_recovers(act: Act, folder: Path) -> None:
    components = folder / "components"
    components.mkdir()
    (components / "lamp.yaml").write_text(
        "component_name: lamp\nrecovery_actions: [light, replace the bulb]\n"
    )
    (folder / "actions" / "more.yaml").write_text(
        "blink: {kind: shell, command: [echo], risk: state}\n"
    )
    link = Linked(act.store)

    def names_it(report: FromGate) -> bool:
        if not isinstance(report, Announcement):
            return False
        actions = msgspec.json.decode(report.actions)["actions"]
        found = {action["name"]: action["recovers"] for action in actions}
        return found == {"blink": [], "drive": [], "light": ["lamp"]}

    link.wait(names_it)


def test_a_client_that_does_not_read_is_dropped_and_waited_for_no_more(tmp_path: Path) -> None:
    """Sending to it closed it: its socket has no number any more that could be waited for."""
    server = SocketServer(tmp_path)
    site = SiteConnection(tmp_path)
    assert server.received() == []
    [client] = server.clients
    report = OrderReport("", "x" * 100_000)
    while not client.is_closed:
        client.send(report)
    wait_readable(server.filenos(), 0)
    server.received()
    assert server.clients == []
    site.close()
    server.close()
