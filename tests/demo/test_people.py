"""The people that the demonstration plays, with a simulated robot, its link and command process."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox import sim
from amberbox.client.fleet import Fleet
from amberbox.client.signing_key import SigningKey
from amberbox.core.command import Command, new_command_id
from amberbox.core.errors import UsageError
from amberbox.demo.people import PlayedTechnician, confirm_motion, resume_tasks, waiting_motion
from amberbox.testing.clock import wait_until
from tests.support.commanded import ROBOT, Commanded, commanded, simulated_robot
from tests.support.commands import ANNA
from tests.support.experiments import DRIVE_FILES

ACTIONS = Path(sim.__file__).parent / "folder" / "actions" / "sim.yaml"


def test_they_sign_confirm_and_send_the_robot_back(tmp_path: Path) -> None:
    with simulated_robot(tmp_path) as endpoint:
        actions = ACTIONS.read_text().replace("tcp://127.0.0.1:5557", endpoint)
        with (
            commanded(tmp_path, endpoint, actions, files=DRIVE_FILES) as world,
            world.fleet("anna") as anna,
        ):
            key = SigningKey("anna", ANNA.public, ANNA.private)
            store = world.folder / "store"
            PlayedTechnician(world.url, world.tokens["anna"], ROBOT, store, key)
            drive_by_hand(world, anna, store)
            drive_in_a_run(anna, store)
            # refused while the technician's own order is carried out
            wait_until(lambda: resume_tasks(store).state == "done", "the robot's tasks")


def drive_by_hand(world: Commanded, anna: Fleet, store: Path) -> None:
    """Order a motion without a run: its lease is taken and held until it has ended."""
    wanted = Command(
        new_command_id(), ROBOT, "drive_linear", '{"distance_m": 0.2}', "anna", "moves",
        "by hand", "",
    )  # fmt: skip
    with pytest.raises(UsageError, match="no motion waits"):
        confirm_motion(store)
    anna.send_command(ROBOT, wanted)
    wait_until(lambda: waiting_motion(store) is not None, "the motion waits")
    confirm_motion(store)
    world.wait_for_state(wanted.id, "done")
    wait_until(lambda: not anna.actions(ROBOT).lease.holder, "the end of its lease")


def drive_in_a_run(anna: Fleet, store: Path) -> None:
    """Run an experiment: its commands are signed under its own lease."""
    wait_until(lambda: bool(anna.experiments(ROBOT)), "the robot's experiments")
    run = anna.start_run(ROBOT, "drive", {"distance_m": 0.2}).id
    wait_until(lambda: bool(anna.run(ROBOT, run).people), "the first step")
    anna.complete_step(ROBOT, run, anna.run(ROBOT, run).people[0].task, {"path_clear": True})
    wait_until(lambda: waiting_motion(store) is not None, "the motion waits")
    confirm_motion(store)
    wait_until(lambda: bool(anna.run(ROBOT, run).people), "the last step")
    anna.complete_step(ROBOT, run, anna.run(ROBOT, run).people[0].task, {"seen": "It stands."})
    wait_until(lambda: anna.run(ROBOT, run).run.is_over, "its end")
    assert anna.run(ROBOT, run).run.state == "passed"
