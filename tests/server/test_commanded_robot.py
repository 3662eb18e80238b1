"""Commands end to end: command line, server, link, command process and a robot, each a process."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

import amberbox.sim
from amberbox.cli.main import main
from amberbox.client import credentials, signing_key
from amberbox.client.commanding import HeldLease, signed_now
from amberbox.client.fleet import Fleet
from amberbox.client.signing_key import SigningKey
from amberbox.client.transport import ConflictError
from amberbox.core.command import Command, CommandSignature, Risk, new_command_id
from amberbox.core.errors import UsageError
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.schema import AUDIT, COMMAND_ANSWER
from amberbox.testing.clock import PATIENCE_S
from tests.support.commanded import ROBOT, Commanded, commanded, simulated_robot
from tests.support.commands import ANNA, BEN, EVE, Person
from tests.support.processes import command, wait_for
from tests.support.terminal import AtTerminal
from tests.support.zmq_robot import ZmqRobot, boot_s, zmq_robot

BY_ANNA = r"held by anna \(run cart-7\)"


@pytest.fixture(scope="module")
def robot() -> Iterator[ZmqRobot]:
    with zmq_robot() as found:
        yield found


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, robot: ZmqRobot) -> Iterator[Commanded]:
    """A robot that drives on until it is stopped, of two people who may command it."""
    with commanded(
        tmp_path_factory.mktemp("world"), robot.endpoint, people=(ANNA, BEN, EVE)
    ) as found:
        yield found


@pytest.fixture(autouse=True)
def at_home(
    world: Commanded, robot: ZmqRobot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Anna's computer, with her key; afterwards nothing runs any more."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv(credentials.VARIABLE, world.tokens["anna"])
    monkeypatch.setattr("amberbox.core.ed25519.new_private_key", lambda: ANNA.private)
    signing_key.make_key("anna")
    yield
    with world.fleet() as fleet:
        fleet.abort(ROBOT)
        wait_for(lambda: not fleet.actions(ROBOT).lease.holder, "a free robot")
    wait_for(lambda: not world.site().running, "the end of what ran")
    robot.hears.clear()


def key_of(person: Person) -> SigningKey:
    return SigningKey(person.name, person.public, person.private)


def order(action: str = "drive", risk: Risk = "moves", run: str = "", parameters: str = "{}") \
        -> Command:  # fmt: skip
    return Command(new_command_id(), ROBOT, action, parameters, "", risk, run)


def sent(fleet: Fleet, held: HeldLease, person: Person = ANNA) -> str:
    """Send a drive under a lease; return its id."""
    ordered = order(run=held.lease.run, parameters='{"distance_m": 2}')
    signed = signed_now(fleet, ROBOT, ordered, key_of(person), held.lease.number, 20)
    return fleet.send_command(ROBOT, signed).id


def started(*words: str) -> subprocess.Popen[str]:
    """Start ``amberbox`` as somebody would; Ctrl-C reaches it."""
    return subprocess.Popen(
        command(*words), text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip


def confirmed_by_olga(world: Commanded) -> str:
    """Enter the code that is shown at the robot; return the command's id."""
    code = world.code()
    with world.fleet("olga") as fleet:
        waiting = wait_for(lambda: fleet.actions(ROBOT).waiting, "what waits, at the server")
        assert fleet.confirm_command(ROBOT, waiting, code).state in ("accepted", "done")
    return waiting


def test_ctrl_c_stops_the_robot(world: Commanded, robot: ZmqRobot) -> None:
    person = started("command", "send", world.where, "drive", "distance_m=1", "--yes")
    confirmed_by_olga(world)
    robot.wait_until("linear")
    person.send_signal(signal.SIGINT)
    out, error = person.communicate(timeout=PATIENCE_S)
    assert person.returncode == 130, error
    assert robot.heard("stop")
    assert "aborted: " in out


def test_who_orders_is_asked_and_enters_the_code(world: Commanded, robot: ZmqRobot) -> None:
    no = AtTerminal("command", "send", world.where, "drive", "distance_m=1")
    no.wait("Is its way free? [y/N] ")
    no.type("n\n")
    assert no.end() == 2
    yes = AtTerminal("command", "send", world.where, "drive", "distance_m=1")
    yes.wait("[y/N] ")
    yes.type("y\n")
    yes.wait("code that is shown at the robot: ")
    code = world.code()
    yes.type("111111\n" if code != "111111" else "222222\n")
    yes.wait("not the one at the robot")
    yes.wait("code that is shown at the robot: ")
    assert not robot.hears
    yes.type(f"{code}\n")
    yes.wait("accepted")
    robot.wait_until("linear")
    yes.type("\x03")
    yes.wait("aborted: ")
    assert yes.end() == 130


def test_a_signer_is_asked_for_each_command(world: Commanded, robot: ZmqRobot) -> None:
    with world.fleet("ben") as ben:
        ids = [ben.send_command(ROBOT, order("light", "state", run)).id for run in ("a", "b")]
        signer = AtTerminal("sign", world.where, "--once")
        signer.wait("ben orders light {} (state) of the run a")
        signer.wait("sign it? [y/N] ")
        signer.type("n\n")
        signer.wait("of the run b")
        signer.wait("sign it? [y/N] ")
        signer.type("y\n")
        signer.wait("light: done")
        assert signer.end() == 0
        assert [ben.command(ROBOT, one).state for one in ids] == ["unsigned", "done"]
    assert len(robot.hears) == 1


def test_a_computer_that_dies_stops_the_robot(world: Commanded, robot: ZmqRobot) -> None:
    person = started("command", "send", world.where, "drive", "distance_m=1", "--yes")
    ordered = confirmed_by_olga(world)
    robot.wait_until("linear")
    person.kill()
    person.communicate()
    killed_s = boot_s()
    assert robot.wait_until("stop")[0] - killed_s <= 5.0
    assert "not renewed" in world.wait_for_state(ordered, "aborted")


def test_a_cut_link_stops_the_robot_and_its_answer_comes_later(
    world: Commanded, robot: ZmqRobot
) -> None:
    with world.fleet() as fleet, HeldLease(fleet, ROBOT) as held:
        ordered = sent(fleet, held)
        confirmed_by_olga(world)
        robot.wait_until("linear")
        world.proxy.silence()
        robot.wait_until("stop")
        assert fleet.command(ROBOT, ordered).state == "accepted", "nobody has told the server"
        world.proxy.cut()
        assert "not renewed" in world.wait_for_state(ordered, "aborted")


def test_another_run_is_refused_with_the_holders_name(world: Commanded, robot: ZmqRobot) -> None:
    with world.fleet() as anna, world.fleet("ben") as ben, HeldLease(anna, ROBOT, "cart-7") as held:
        assert held.lease.holder == "anna"
        with pytest.raises(ConflictError, match=BY_ANNA):
            ben.take_lease(ROBOT)
        for attempt in (ben.renew_lease, ben.release_lease):
            with pytest.raises(ConflictError, match=BY_ANNA):
                attempt(ROBOT, held.lease.number)
        own = order(run="mine", parameters='{"distance_m": 1}')
        signed = signed_now(ben, ROBOT, own, key_of(BEN), held.lease.number, 20)
        with pytest.raises(ConflictError, match="cart-7"):
            ben.send_command(ROBOT, signed)
        assert anna.renew_lease(ROBOT, held.lease.number).run == "cart-7"
    with world.fleet("ben") as ben, HeldLease(ben, ROBOT) as other:
        assert other.lease.number == held.lease.number + 1
    assert not robot.hears


def test_only_the_code_of_this_motion_counts_three_times(world: Commanded, robot: ZmqRobot) -> None:
    with world.fleet() as fleet, HeldLease(fleet, ROBOT) as held:
        ordered = sent(fleet, held)
        code = world.code(ordered)
        wrong = "000000" if code != "000000" else "111111"
        with pytest.raises(ConflictError, match="does not wait"):
            light = order("light", "state", held.lease.run)
            signed = signed_now(fleet, ROBOT, light, key_of(ANNA), held.lease.number, 20)
            other = fleet.send_command(ROBOT, signed).id
            world.wait_for_state(other, "done")
            fleet.confirm_command(ROBOT, other, code)
        for _ in range(2):
            with pytest.raises(ConflictError, match="not the one at the robot"):
                fleet.confirm_command(ROBOT, ordered, wrong)
        assert fleet.confirm_command(ROBOT, ordered, wrong).state == "refused"
        with pytest.raises(ConflictError, match="it is refused"):
            fleet.confirm_command(ROBOT, ordered, code)
    assert not robot.heard("linear")


def test_a_signature_is_asked_for_where_the_key_is(
    world: Commanded, robot: ZmqRobot, capsys: pytest.CaptureFixture[str]
) -> None:
    with world.fleet("ben") as ben:
        light = ben.send_command(ROBOT, order("light", "state", "run-1")).id
        drive = ben.send_command(ROBOT, order(parameters='{"distance_m": 1}', run="run-1")).id
        assert ben.command(ROBOT, light).state == "unsigned"
        assert not robot.hears
        assert main(["sign", world.where, "--run", "run-1", "--yes-to", "li*", "--once"]) == 0
        shown = capsys.readouterr().out
        assert "ben orders light {} (state) of the run run-1" in shown
        line = ben.command(ROBOT, light)
        assert (line.state, line.key_id, line.run) == ("done", ANNA.key_id, "run-1")
        assert ben.command(ROBOT, drive).state == "unsigned", "it is not among those"
        assert ben.withdraw_command(ROBOT, drive).state == "withdrawn"
        with pytest.raises(UsageError, match="withdrawn"):
            ben.sign_command(ROBOT, drive, signature_of(ben, drive))
    assert [said["do"] for _, said in robot.hears] == ["light"]


def signature_of(fleet: Fleet, command_id: str) -> CommandSignature:
    """Sign a command as nobody's run."""
    line = fleet.command(ROBOT, command_id)
    known = Command(line.id, ROBOT, line.action, line.parameters, "", "moves", line.run)
    signed = signed_now(fleet, ROBOT, known, key_of(BEN), 1, 20)
    assert signed.signature is not None
    return signed.signature


def test_nothing_of_the_code_stays_on_the_server(world: Commanded, robot: ZmqRobot) -> None:
    with world.fleet() as fleet, HeldLease(fleet, ROBOT) as held:
        ordered = sent(fleet, held)
        code = world.code(ordered)
        confirmed_by_olga(world)
        robot.wait_until("linear")
    world.wait_for_state(ordered, "aborted")
    stored = ServerDatabase(world.data / FILE)
    audited = [row for row in stored.rows(AUDIT.select()) if row.object in (ordered, ROBOT)]
    said = [row.details for row in audited]
    said += [row.reason + row.result for row in stored.rows(COMMAND_ANSWER.select())]
    stored.close()
    assert {"commands.send", "commands.lease", "commands.confirm"} <= {a.action for a in audited}
    assert not [text for text in said if code in text]
    assert code not in (world.folder.parent / "server.log").read_text()


def test_a_revoked_key_ends_what_it_ordered(world: Commanded, robot: ZmqRobot) -> None:
    with world.fleet("ben") as fleet, HeldLease(fleet, ROBOT) as held:
        ordered = sent(fleet, held, EVE)
        confirmed_by_olga(world)
        robot.wait_until("linear")
        with world.fleet("admin") as admin:
            assert admin.revoke_key(EVE.key_id, "laptop lost").who == "admin"
        robot.wait_until("stop")
        assert "revoked" in world.wait_for_state(ordered, "aborted")
        wait_for(lambda: held.lost, "the end of the lease")
    with (
        world.fleet("ben") as fleet,
        HeldLease(fleet, ROBOT) as held,
        pytest.raises(UsageError, match="is revoked"),
    ):
        sent(fleet, held, EVE)


def test_the_simulated_robot_drives_when_it_is_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    actions = (Path(amberbox.sim.__file__).parent / "folder" / "actions" / "sim.yaml").read_text()
    with simulated_robot(tmp_path) as endpoint:
        adapted = actions.replace("tcp://127.0.0.1:5557", endpoint)
        with commanded(tmp_path, endpoint, adapted) as world:
            monkeypatch.setenv(credentials.VARIABLE, world.tokens["anna"])
            before = place(endpoint)
            words = ("drive_linear", "distance_m=0.3", "--yes", "--json")
            person = started("command", "send", world.where, *words)
            world.code()
            assert math.dist(before, place(endpoint)) < 0.1, "nobody has confirmed it"
            ordered = confirmed_by_olga(world)
            out, error = person.communicate(timeout=PATIENCE_S)
            assert person.returncode == 0, error
            assert json.loads(out)["state"] == "done"
            assert 0.2 < math.dist(before, place(endpoint)) < 0.4
            assert main(["command", "list", str(world.folder), "--json"]) == 0
            [recorded] = json.loads(capsys.readouterr().out)
            assert (recorded["id"], recorded["state"]) == (ordered, "done")


def place(endpoint: str) -> tuple[float, float]:
    """Ask the simulated robot where it is."""
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.linger = 0
        socket.connect(endpoint)
        socket.send_json({"do": "status"})
        assert socket.poll(int(PATIENCE_S * 1000))
        x_m, y_m, _ = json.loads(socket.recv())["pose"]
    return x_m, y_m
