"""Runs on a simulated robot, over server, link and command process, each its own process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import amberbox.sim
from amberbox.client.commanding import signed_now
from amberbox.client.fleet import Fleet
from amberbox.client.models import RunDetail
from amberbox.client.signing_key import SigningKey
from amberbox.client.transport import ConflictError
from amberbox.core.command import Command
from amberbox.core.errors import AmberboxError, UsageError
from tests.support.commanded import ROBOT, Commanded, commanded, simulated_robot
from tests.support.commands import ANNA
from tests.support.experiments import DRIVE_FILES
from tests.support.processes import wait_for, wait_for_listener

KEY = SigningKey("anna", ANNA.public, ANNA.private)


ACTIONS = Path(amberbox.sim.__file__).parent / "folder" / "actions" / "sim.yaml"


def adapted(endpoint: str) -> str:
    """Return the simulated robot's actions, at its address."""
    return ACTIONS.read_text().replace("tcp://127.0.0.1:5557", endpoint)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commanded]:
    folder = tmp_path_factory.mktemp("world")
    with (
        simulated_robot(folder) as endpoint,
        commanded(folder, endpoint, adapted(endpoint), files=DRIVE_FILES) as found,
    ):
        with found.fleet() as fleet:
            wait_for(lambda: fleet.experiments(ROBOT), "the robot's experiments")
        yield found


@pytest.fixture(autouse=True)
def _no_run_is_left(world: Commanded) -> Iterator[None]:
    """A test that failed amid its run does not keep the robot from the next one."""
    yield
    with world.fleet("anna") as anna:
        for line in anna.runs(ROBOT):
            if not line.is_over:
                anna.abort_run(ROBOT, line.id, "its test has ended")


def wait_for_run(fleet: Fleet, run: str, *what: str) -> RunDetail:
    """Wait for a run that has one of these states, or in which a step of this element waits."""

    def found() -> RunDetail | None:
        detail = fleet.run(ROBOT, run)
        steps = [*(step.element for step in detail.people), *(s.element for s in detail.robot)]
        if detail.run.is_over and detail.run.state not in what:
            raise AssertionError(f"{detail.run.state}: {detail.run.reason}, {detail.events}")
        return detail if {detail.run.state, *steps} & {*what} else None

    return wait_for(found, f"{what} of {run}")


def sign_waiting(fleet: Fleet, run: str) -> str:
    """Wait for a command of the run without a signature, and sign it; return its id."""
    [line] = wait_for(
        lambda: fleet.commands(ROBOT, state=("unsigned",), run=run), "a command to sign"
    )
    command = Command(
        line.id, ROBOT, line.action, line.parameters, line.issuer, line.risk, line.run, line.step
    )
    lease = wait_for(
        lambda: state.lease if (state := fleet.actions(ROBOT)).lease.run == run else None,
        "the lease of the run",
    )
    signed = signed_now(fleet, ROBOT, command, KEY, lease.number, 20)
    assert signed.signature is not None
    fleet.sign_command(ROBOT, line.id, signed.signature)
    return line.id


def begin_drive(anna: Fleet, olga: Fleet, distance_m: float = 0.3) -> tuple[str, str]:
    """Start a run and bring it to the robot's step; return its id and that of the command."""
    run = anna.start_run(ROBOT, "drive", {"distance_m": distance_m}).id
    olga.be_present(ROBOT, run, "operator")
    task = wait_for_run(olga, run, "clear").people[0].task
    olga.complete_step(ROBOT, run, task, {"path_clear": True})
    return run, sign_waiting(anna, run)


def test_a_drive_passes(world: Commanded) -> None:
    with world.fleet("anna") as anna, world.fleet("olga") as olga:
        [line] = anna.experiments(ROBOT)
        assert (line.title, [*line.problems]) == ("Drive a little", [])
        assert [*line.roles] == ["operator"]
        run, command = begin_drive(anna, olga)
        with pytest.raises(ConflictError, match="reserved by anna for Drive a little"):
            anna.start_run(ROBOT, "drive")
        step = wait_for(
            lambda: next((s for s in anna.run(ROBOT, run).robot if s.confirm), None), "the code"
        )
        assert (step.element, step.command) == ("drive", command)
        olga.confirm_command(ROBOT, command, world.code(command))
        task = wait_for_run(olga, run, "look").people[0].task
        olga.note_deviation(ROBOT, run, task, "It squeaks.")
        olga.complete_step(ROBOT, run, task, {"seen": "It stands."})
        with pytest.raises(ConflictError, match=r"olga has done this step already|the run is"):
            olga.complete_step(ROBOT, run, task, {})
        detail = wait_for_run(anna, run, "passed")
        report = json.loads(anna.run_report(ROBOT, run))
        assert report["verdict"] == "passed"
        assert [s["name"] for s in report["steps"]][1] == "Drive"
        assert [e["text"] for e in report["events"] if e["kind"] == "deviation"] == ["It squeaks."]
        assert b"It squeaks." in anna.run_report(ROBOT, run, "html")
        assert b'failures="0"' in anna.run_report(ROBOT, run, "junit")
        assert "is-done" in anna.diagram(ROBOT, run=run)
        assert detail.run.who == "anna"
        wait_for(lambda: not anna.actions(ROBOT).lease.holder, "the end of the lease")


def test_an_abort_stops_the_robot(world: Commanded) -> None:
    with world.fleet("anna") as anna, world.fleet("olga") as olga:
        run, command = begin_drive(anna, olga)
        olga.confirm_command(ROBOT, command, world.code(command))
        world.wait_for_state(command, "accepted")
        olga.abort_run(ROBOT, run, "somebody comes")
        detail = wait_for_run(anna, run, "aborted")
        assert "somebody comes" in detail.run.reason
        world.wait_for_state(command, "aborted")
        assert olga.abort_run(ROBOT, run).state == "aborted"


def test_what_is_not_safe_is_not_driven(world: Commanded) -> None:
    with world.fleet("anna") as anna, world.fleet("olga") as olga:
        run = anna.start_run(ROBOT, "drive").id
        task = wait_for_run(olga, run, "clear").people[0].task
        with pytest.raises(UsageError, match="neither pass, fail nor skipped"):
            olga.complete_step(ROBOT, run, task, {"path_clear": "yes"})
        olga.complete_step(ROBOT, run, task, {"path_clear": False})
        assert not wait_for_run(anna, run, "aborted").robot
        assert anna.commands(ROBOT, run=run) == []
        with pytest.raises(AmberboxError, match="above the largest value"):
            anna.start_run(ROBOT, "drive", {"distance_m": 5})
        with pytest.raises(UsageError, match="no experiment 'drvie'"):
            anna.start_run(ROBOT, "drvie")


def test_a_withdrawn_command_leads_to_the_error_path(world: Commanded) -> None:
    with world.fleet("anna") as anna, world.fleet("olga") as olga:
        run = anna.start_run(ROBOT, "drive").id
        olga.be_present(ROBOT, run, "operator")
        task = wait_for_run(olga, run, "clear").people[0].task
        olga.complete_step(ROBOT, run, task, {"path_clear": True})
        [line] = wait_for(lambda: anna.commands(ROBOT, run=run), "a command")
        anna.withdraw_command(ROBOT, line.id)
        task = wait_for_run(olga, run, "recover").people[0].task
        olga.complete_step(ROBOT, run, task)
        assert wait_for_run(anna, run, "failed")


def confirmed_or_over(world: Commanded, olga: Fleet, command: str) -> str:
    """Enter the code once it is shown; return the state once the command has begun or ended."""
    waiting = world.site().waiting
    if waiting is not None and waiting.id == command == olga.actions(ROBOT).waiting:
        olga.confirm_command(ROBOT, command, waiting.code)
    state = olga.command(ROBOT, command).state
    return state if state not in ("waiting", "sent") else ""


def test_a_killed_server_goes_on_with_the_run(world: Commanded) -> None:
    """It is killed while a command waits for its signature, and while the robot drives."""

    def kill() -> None:
        world.processes.kill("serve")
        server = world.processes.again("serve")
        wait_for_listener(world.port, server, world.data.parent / "server.log")
        with world.fleet() as fleet:
            wait_for(lambda: fleet.actions(ROBOT).takes_commands, "the robot's link")

    with world.fleet("anna") as anna, world.fleet("olga") as olga:
        run = anna.start_run(ROBOT, "drive", {"distance_m": 0.3}).id
        task = wait_for_run(olga, run, "clear").people[0].task
        olga.complete_step(ROBOT, run, task, {"path_clear": True})
        kill()
        olga.be_present(ROBOT, run, "operator")
        command = sign_waiting(anna, run)
        # refused where it was signed for the lease that the robot lost meanwhile
        state = wait_for(lambda: confirmed_or_over(world, olga, command), "its confirmation")
        if state != "refused":
            kill()  # longer than a lease lasts: the robot may have stopped by itself
        detail = wait_for_run(olga, run, "look", "recover")
        [step] = detail.people
        olga.complete_step(ROBOT, run, step.task)
        ended = wait_for_run(anna, run, "passed", "failed")
        assert ended.run.state == ("passed" if step.element == "look" else "failed")
        assert [line.id for line in anna.commands(ROBOT, run=run)] == [command]


@pytest.mark.parametrize("victim", ["act", "link"])
def test_a_robot_that_dies_while_it_drives_leads_to_the_error_path(
    world: Commanded, victim: str
) -> None:
    with world.fleet("anna") as anna, world.fleet("olga") as olga:
        run, command = begin_drive(anna, olga, 1.0)
        olga.confirm_command(ROBOT, command, world.code(command))
        world.wait_for_state(command, "accepted")
        world.processes.kill(victim)
        if victim == "link":  # its lease is lost, and it says so when it is back
            wait_for(lambda: not world.site().running, "the stop of the robot")
        world.processes.again(victim)
        detail = wait_for_run(olga, run, "recover")
        [ended] = [event for event in detail.events if event.kind == "ended"]
        assert ended.values["state"] == ("outcome_unknown" if victim == "act" else "aborted")
        olga.complete_step(ROBOT, run, detail.people[0].task)
        wait_for_run(anna, run, "failed")
        assert [line.id for line in anna.commands(ROBOT, run=run)] == [command]
