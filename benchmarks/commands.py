"""How long a signed command takes from a person's computer to the robot, and a stop without a link.

Server, link, command process and robot are processes of their own on this machine. A motion is
confirmed at the robot as soon as it asks for it. The targets are 300 ms from the signature to the
first motion, and 3.5 s from the cut of the link to the stop, by the robot's own record.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from amberbox.agent.command_socket import SiteAsks, SiteConfirms, SiteConnection
from amberbox.blackbox.journal.channels import COMMAND
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import open_store
from amberbox.client.commanding import HeldLease, signed_now
from amberbox.client.fleet import Fleet
from amberbox.client.signing_key import SigningKey
from amberbox.core.clock import NS
from amberbox.core.command import Command, Risk, new_command_id
from benchmarks.common import Row
from tests.support.commanded import ROBOT, Commanded, commanded
from tests.support.commands import ANNA
from tests.support.zmq_robot import ZmqRobot, boot_s, zmq_robot

REPEATS = 9
CUTS = 5
_KEY = SigningKey(ANNA.name, ANNA.public, ANNA.private)
_ASK_S = 0.002


def measure() -> list[Row]:
    """Order a change and a motion several times; cut the link while the robot drives."""
    with (
        tempfile.TemporaryDirectory() as place,
        zmq_robot() as robot,
        commanded(Path(place), robot.endpoint) as world,
        world.fleet() as fleet,
    ):
        changes = [_changed_ms(world, fleet, robot) for _ in range(REPEATS)]
        motions = [_moved_ms(world, fleet, robot) for _ in range(REPEATS)]
        stops = [_stopped_s(world, fleet, robot) for _ in range(CUTS)]
    note = "target: 300; on loopback, confirmed at the robot at once"
    cut = "target: 3.5; lease of 3 s"
    return [
        Row("signature to a change of state", statistics.median(changes), "ms", note="on loopback"),
        Row("signature to first motion", statistics.median(motions), "ms", note=note),
        Row("signature to first motion, longest", max(motions), "ms", note=note),
        Row("cut link to stop, by the robot's record", max(by_record for _, by_record in stops),
            "s", note=f"{cut}, longest of {CUTS}"),
        Row("cut link to stop, as the robot heard it", max(heard for heard, _ in stops), "s",
            note=f"{cut}, longest of {CUTS}"),
    ]  # fmt: skip


def _changed_ms(world: Commanded, fleet: Fleet, robot: ZmqRobot) -> float:
    with HeldLease(fleet, ROBOT) as held:
        signed_s, command_id = _order(fleet, held, "light", "state", "{}")
        heard_s = robot.wait_until("light")[-1]
        world.wait_for_state(command_id, "done")
    _free(world, fleet, robot)
    return 1000 * (heard_s - signed_s)


def _moved_ms(world: Commanded, fleet: Fleet, robot: ZmqRobot) -> float:
    with HeldLease(fleet, ROBOT) as held:
        signed_s, _ = _order(fleet, held, "drive", "moves", '{"distance_m": 1}')
        _confirm(world)
        heard_s = robot.wait_until("linear")[-1]
    _free(world, fleet, robot)
    return 1000 * (heard_s - signed_s)


def _stopped_s(world: Commanded, fleet: Fleet, robot: ZmqRobot) -> tuple[float, float]:
    """Cut the link during a motion; return when the robot heard the stop, and when it recorded."""
    with HeldLease(fleet, ROBOT) as held:
        _, command_id = _order(fleet, held, "drive", "moves", '{"distance_m": 1}')
        _confirm(world)
        robot.wait_until("linear")
        world.proxy.silence()
        cut_s, cut_ns = boot_s(), time.time_ns()
        heard_s = robot.wait_until("stop")[0]
        world.proxy.cut()
        world.wait_for_state(command_id, "aborted")
    store = open_store(world.folder / "store")
    records = OwnRecords(store, "act", {COMMAND}).step()
    recorded_ns = next(
        one.wall_ns
        for one in records
        if one.values["state"] == "stop" and one.values["id"] == command_id
    )
    _free(world, fleet, robot)
    return heard_s - cut_s, (recorded_ns - cut_ns) / NS


def _order(
    fleet: Fleet, held: HeldLease, action: str, risk: Risk, parameters: str
) -> tuple[float, str]:
    """Sign and send a command; return when it was signed, and its id."""
    command = Command(new_command_id(), ROBOT, action, parameters, "", risk, held.lease.run)
    signed = signed_now(fleet, ROBOT, command, _KEY, held.lease.number, 20)
    signed_s = boot_s()
    return signed_s, fleet.send_command(ROBOT, signed).id


def _confirm(world: Commanded) -> None:
    site = SiteConnection(world.folder / "store")
    while site.ask(SiteAsks()).waiting is None:
        time.sleep(_ASK_S)
    site.ask(SiteConfirms(on_site=True))
    site.close()


def _free(world: Commanded, fleet: Fleet, robot: ZmqRobot) -> None:
    """Wait until nothing runs and nobody holds the robot."""
    _until(lambda: not world.site().running and not fleet.actions(ROBOT).lease.holder)
    robot.hears.clear()


def _until(holds: Callable[[], bool]) -> None:
    while not holds():
        time.sleep(_ASK_S)
