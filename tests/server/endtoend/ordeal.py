"""An ordeal: kills, power cuts, changed cards and old images, at random moments of one seed.

``python -m tests.server.endtoend.ordeal ROBOTS SECONDS KILLS [SEED]`` runs a long one.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from amberbox.server.database import FILE, ServerDatabase
from amberbox.testing.clock import PATIENCE_S
from tests.server.endtoend import disaster
from tests.server.endtoend.judging import is_caught_up, judge_data, judge_journals, judge_rows
from tests.server.endtoend.robotprocess import END
from tests.server.endtoend.world import Robot, World, kill


@dataclass
class Result:
    """The result; ``faults`` are those of connections, ``frames`` those of frames."""

    kills: int = 0
    rows: int = 0
    messages: int = 0
    journals: int = 0
    caught_up_s: float = 0.0
    faults: int = 0
    frames: int = 0


def run(folder: Path, robots: int, seconds: float, kills: int, seed: int = 0) -> Result:
    """Run it, wait until the networks are good again, and check the data on the server."""
    chance = random.Random(seed)
    result = Result(kills=kills)
    with World(folder, robots, seed) as world:
        for robot in world.robots:
            robot.start()
        world.wait_for_server()
        for robot in world.robots:
            robot.wait()
        begin = time.monotonic()
        for number in range(kills):
            due = begin + (number + chance.uniform(0.3, 1.0)) * seconds / kills
            time.sleep(max(0.0, due - time.monotonic()))
            world.wait_for_link()
            _strike(world, number, chance)
        result.faults = sum(len(robot.proxy.struck) for robot in world.robots)
        result.frames = sum(len(robot.proxy.mangled) for robot in world.robots)
        _settle(world, result)
        _judge(world, result)
    return result


def _strike(world: World, number: int, chance: random.Random) -> None:
    """Do the next thing: every disaster has its turn, the others are plain kills."""
    victim = world.robots[number % len(world.robots)]
    disasters: dict[int, Callable[[Robot], None]] = {
        3: _new_card, 7: _image, 9: _power_cut, 13: _restore, 16: _power_cut,
    }  # fmt: skip
    struck = disasters.get(number % 20)
    if struck is not None:
        victim = world.robots[0] if struck in (_image, _restore) else victim
        victim.wait()
        struck(victim)
    elif number % 5 == 0:
        world.kill_server()
        time.sleep(chance.uniform(0.0, 0.3))
        world.start_server()
        world.wait_for_server()  # else links would never get far enough to be cut
    elif number % 2 == 1 and victim.link is not None:
        kill(victim.link)
        victim.start_link()
    elif victim.box is not None:
        kill(victim.box)
        victim.start_box()


def _power_cut(robot: Robot) -> None:
    robot.lose_power()
    disaster.cut_power(robot.store)
    robot.start()


def _new_card(robot: Robot) -> None:
    robot.lose_power()
    robot.old.append(disaster.new_card(robot.store))
    robot.start()


def _image(robot: Robot) -> None:
    robot.lose_power()
    disaster.image(robot.store)
    robot.start()


def _restore(robot: Robot) -> None:
    robot.lose_power()
    robot.old.append(disaster.restore(robot.store))
    robot.start()


def _settle(world: World, result: Result) -> None:
    """Let robots end in order, networks be good, and wait until all is on the server."""
    world.clear_networks()
    for robot in world.robots:
        (robot.folder / END).touch()
    for robot in world.robots:
        assert robot.box is not None
        assert robot.box.wait(PATIENCE_S) == 0, robot.log.read_text()[-3000:]
    begin = time.monotonic()
    database = ServerDatabase(world.data / FILE, read_only=True)
    waiting = list(world.robots)
    while waiting:
        assert time.monotonic() - begin < 120, _reports(waiting)
        time.sleep(0.2)
        waiting = [r for r in waiting if not is_caught_up(database, r.store, r.name)]
    result.caught_up_s = time.monotonic() - begin
    database.close()
    for robot in world.robots:
        assert robot.link is not None
        robot.link.terminate()
    for robot in world.robots:
        assert robot.link is not None
        assert robot.link.wait(PATIENCE_S) == 0, robot.log.read_text()[-3000:]


def _reports(robots: list[Robot]) -> str:
    return "\n".join(f"{robot.name}: {robot.log.read_text()[-3000:]}" for robot in robots)


def _judge(world: World, result: Result) -> None:
    database = ServerDatabase(world.data / FILE, read_only=True)
    try:
        for robot in world.robots:
            name, path = robot.name, robot.store
            result.rows += judge_rows(database, world.data, name, path, robot.old)
            result.journals += judge_journals(database, world.data, name, [path, *robot.old])
            result.messages += judge_data(database, world.data, name, path)
    finally:
        database.close()


if __name__ == "__main__":
    count, length, deaths, *rest = sys.argv[1:]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:
        print(run(Path(place), int(count), float(length), int(deaths), int((rest or ["0"])[0])))
