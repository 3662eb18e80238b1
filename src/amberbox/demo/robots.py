"""Robots of the demonstration: a folder each, and the box that records a simulated machine."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import amberbox.sim
from amberbox.demo.processes import start_tied
from amberbox.link.joining import JoinLine
from amberbox.robot.joining.writing import with_server, write_key, write_robot_file

IDS = ("ropod_001", "ropod_002", "ropod_003")
SEEDS: Mapping[str, int] = {"ropod_001": 7, "ropod_002": 11, "ropod_003": 5}
GROUPS: Mapping[str, str] = {"ropod_001": "ward", "ropod_002": "ward", "ropod_003": "kitchen"}
SOMETIMES_AWAY = "ropod_003"
"""Its way to the server is cut now and then."""
KNOWLEDGE = Path(amberbox.sim.__file__).parent / "folder"
_END_S = 30.0
_ROBOT = """\
id: {id}
model: Ropod (simulated)
software_version: "2026.11"

store:
  path: store
  quota: 2 GB
  rotate_s: 10             # so that the server has what was recorded after seconds

missions:                  # each delivery is one; it takes 24 s to 28 s
  - name: delivery
    start: >-
      sim_tasks.kind == 'delivery' and sim_tasks.event != 'finished' and
      sim_tasks.event != 'aborted'
    end: sim_tasks.event == 'finished' or sim_tasks.event == 'aborted'
    outcome: sim_tasks.event
    parameters: {{to: sim_tasks.location, task: sim_tasks.task_id}}
    max: 45 s              # whatever holds it up: then it has failed

"""
_BLACK_BOX = """\
- sim:
    robot: {id}
    seed: {seed}
    scenario: shuttle
    orders: {orders}
"""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a robot lives: its folder, the file that breaks its machine, what its box prints."""

    id: str
    folder: Path
    orders: Path
    log: Path


def place_of(robot: str, folder: Path) -> Place:
    """Say where a robot lives below a folder of the demonstration."""
    return Place(robot, folder / robot, folder / f"{robot}.orders", folder / f"{robot}.log")


def write_folder(place: Place, line: JoinLine) -> None:
    """Write a robot's folder: what is recorded, monitored and known of it, and its server."""
    place.folder.mkdir(parents=True)
    for path in (path for kind in ("*.yaml", "*.pl") for path in KNOWLEDGE.rglob(kind)):
        target = place.folder / path.relative_to(KNOWLEDGE)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    orders = json.dumps(str(place.orders))  # a path is written in quotes, as YAML takes JSON
    box = _BLACK_BOX.format(id=place.id, seed=SEEDS[place.id], orders=orders)
    (place.folder / "black_box.yaml").write_text(box)
    write_key(place.folder, line.key)
    write_robot_file(place.folder, with_server(_ROBOT.format(id=place.id), {"url": line.url}))


class DemoRobot:
    """A robot that runs; it ends when this process does.

    Make it on the thread that lives longest: a child ends with the thread that began it.
    """

    def __init__(self, place: Place) -> None:
        self.place = place
        with place.log.open("ab") as file:
            self._box = start_tied(("amberbox", "run", str(place.folder)), output=file)

    def order(self, line: str) -> None:
        """Tell the machine something: ``fault NAME``, ``heal NAME``."""
        with self.place.orders.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    def stop(self) -> None:
        """Ask it to end."""
        if self._box.poll() is None:
            self._box.send_signal(signal.SIGTERM)

    def wait(self) -> None:
        """Wait until it has ended; what does not end within seconds is ended."""
        try:
            self._box.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._box.kill()
            self._box.wait()
