"""The fleet of the demonstration: simulated robots, their accounts, faults and lost connections.

Each robot takes commands that the technician has signed, whose key lies beside the robots.

A relay between robot and server can be cut; the offered faults are those of the simulator that show
quickly. All processes end with the demonstration, however it ends.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from amberbox.agent import launcher
from amberbox.agent.join import with_server, write_key, write_robot_file
from amberbox.client.signing_key import SigningKey
from amberbox.core import ed25519
from amberbox.core.clock import SystemClock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import write_private
from amberbox.demo.people import PlayedTechnician, confirm_motion, waiting_motion
from amberbox.demo.recorder import copy_knowledge
from amberbox.link.join_line import JoinLine, join_line
from amberbox.server.accounts.passwords import Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_group, add_robot
from amberbox.server.accounts.signin import SignInCodes
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.commands import server_id
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.start import make_folder


def start_tied(
    words: Sequence[str], *, stdin: int = subprocess.DEVNULL, output: IO[bytes] | None = None
) -> subprocess.Popen[bytes]:
    """Start a module of Amberbox; it gets SIGTERM when this process has ended.

    Call it on the main thread: a child ends with the thread that started it.
    """
    tied = [sys.executable, "-I", "-S", launcher.__file__, str(os.getpid()), "0"]
    return subprocess.Popen(
        [*tied, sys.executable, "-m", *words], stdin=stdin, stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        process_group=0,  # Ctrl-C in a terminal is for the demonstration only
    )  # fmt: skip


IDS = ("ropod_001", "ropod_002", "ropod_003")
SEEDS: Mapping[str, int] = {"ropod_001": 7, "ropod_002": 11, "ropod_003": 5}
GROUPS: Mapping[str, str] = {"ropod_001": "ward", "ropod_002": "ward", "ropod_003": "kitchen"}
SOMETIMES_AWAY = "ropod_003"  # its connection to the server is cut repeatedly
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
    commands: {commands}
"""
# where the simulated robot takes requests, as its actions have it
_ADDRESS = "tcp://127.0.0.1:5557"
_TRUST = """\
# Who may command this robot from the server
server: {server}
confirm: code
people:
  {person}: {{key: "{key}", risk: moves}}
"""


@dataclass(frozen=True, slots=True)
class RobotPaths:
    """Paths of a robot: its folder, the file of orders for its simulator, its log.

    ``trust`` is its trust file, ``key`` the key of the person named there, in the form of
    ``amberbox sign``.
    """

    id: str
    folder: Path
    orders: Path
    log: Path
    trust: Path
    key: Path

    @property
    def store(self) -> Path:
        """Return its store, where the socket of its command process is."""
        return self.folder / "store"

    @property
    def commands(self) -> str:
        """Return the address of its simulator, one that no other robot has."""
        name = hashlib.sha256(str(self.folder.absolute()).encode()).hexdigest()[:16]
        return f"ipc://@amberbox-{name}"


def robot_paths(robot: str, folder: Path) -> RobotPaths:
    """Return the paths of a robot below the folder of the demonstration."""
    return RobotPaths(
        robot, folder / robot, folder / f"{robot}.orders", folder / f"{robot}.log",
        folder / f"{robot}.trust.yaml", folder / "keys" / f"{Role.TECHNICIAN}.key",
    )  # fmt: skip


def write_folder(place: RobotPaths, line: JoinLine) -> None:
    """Write a robot's folder: sources, monitors, failure modes, actions, experiments and tests, and
    its server."""
    place.folder.mkdir(parents=True)
    robot = _ROBOT.format(id=place.id)
    if place.trust.exists():
        robot += f"commands: {json.dumps(str(place.trust.absolute()))}\n\n"
    copy_knowledge(place.folder, _ADDRESS, place.commands)
    orders, commands = json.dumps(str(place.orders)), json.dumps(place.commands)  # as YAML quotes
    box = _BLACK_BOX.format(id=place.id, seed=SEEDS[place.id], orders=orders, commands=commands)
    (place.folder / "black_box.yaml").write_text(box)
    write_key(place.folder, line.key)
    write_robot_file(place.folder, with_server(robot, {"url": line.url}))


def write_trust(places: Sequence[RobotPaths], server: str) -> SigningKey:
    """Make the technician's key, and have robots trust it for a server; return it."""
    private = ed25519.new_private_key()
    key = SigningKey(str(Role.TECHNICIAN), ed25519.public_key_of(private), private)
    for place in places:
        place.key.parent.mkdir(mode=0o700, exist_ok=True)
        stored = {"public": key.text, "private": base64.b64encode(private).decode()}
        write_private(place.key, json.dumps(stored) + "\n")
        trust = _TRUST.format(server=server, person=Role.TECHNICIAN, key=key.text)
        write_private(place.trust, trust)
    return key


class SimulatedRobot:
    """A running robot; it ends with this process.

    Create it on the thread that lives longest: a child ends with the thread that started it.
    """

    def __init__(self, place: RobotPaths) -> None:
        self.place = place
        with place.log.open("ab") as file:
            self._box = start_tied(("amberbox", "run", str(place.folder)), output=file)

    def order(self, line: str) -> None:
        """Send the simulator a command: ``fault NAME``, ``heal NAME``."""
        with self.place.orders.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    def stop(self) -> None:
        """Terminate it."""
        if self._box.poll() is None:
            self._box.send_signal(signal.SIGTERM)

    def wait(self) -> None:
        """Wait until it has ended; kill it after some seconds."""
        try:
            self._box.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._box.kill()
            self._box.wait()


@dataclass(frozen=True, slots=True)
class OfferedFault:
    """A fault that is offered: the component that shows it first, and its failure mode."""

    component: str
    failure_mode: str


# by the fault's name in the simulator's catalogue
OFFERED_FAULTS: Mapping[str, OfferedFault] = {
    "wheel_front_left_motor_weak": OfferedFault("wheel_front_left", "wheel_front_left#motor_weak"),
    "wheel_rear_right_power_stage_trips": OfferedFault(
        "wheel_rear_right", "wheel_rear_right#power_stage_trips"
    ),
    "wheel_front_left_bus_disconnected": OfferedFault("bus", "wheel_front_left#bus_disconnected"),
    "laser_rear_motor_slow": OfferedFault("laser_rear", "laser_rear#motor_slow"),
    "laser_front_driver_crash": OfferedFault("laser_front", "laser_front#driver_crash"),
    "imu_stuck": OfferedFault("imu", "imu#stuck"),
    "localisation_crash": OfferedFault("localisation", "localisation#crash"),
    "bumper_switch_closed": OfferedFault("safety", "safety#bumper_switch_closed"),
}


_PIECE = 1 << 16


class Relay:
    """Forwards connections to a local port; while it is cut, none gets through."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])
        self.is_cut = False
        self._is_used = False
        self._open: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None
        self._to = 0

    async def begin(self, port: int) -> None:
        """Begin to forward to a port."""
        self._to = port
        self._server = await asyncio.start_server(self._pass_on, sock=self._socket)

    def was_used(self) -> bool:
        """Return whether a connection came through."""
        return self._is_used

    def cut(self) -> None:
        """Abort open connections and refuse new ones."""
        self.is_cut = True
        for writer in tuple(self._open):
            writer.transport.abort()

    def mend(self) -> None:
        """Accept connections again."""
        self.is_cut = False

    def close(self) -> None:
        """Close all connections and the socket."""
        self.cut()
        if self._server is not None:
            self._server.close()
        self._socket.close()

    async def _pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.is_cut:
            writer.transport.abort()
            return
        self._open.add(writer)
        self._is_used = True
        with contextlib.suppress(OSError):
            there = await asyncio.open_connection("127.0.0.1", self._to)
            self._open.add(there[1])
            try:
                await asyncio.gather(_copy(reader, there[1]), _copy(there[0], writer))
            finally:
                self._end(there[1])
        self._end(writer)

    def _end(self, writer: asyncio.StreamWriter) -> None:
        self._open.discard(writer)
        writer.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copy until one end closes, then close the other."""
    try:
        while piece := await reader.read(_PIECE):
            writer.write(piece)
            await writer.drain()
    finally:
        writer.close()


@dataclass(frozen=True, slots=True)
class EnrolledFleet:
    """What robots and people need of a new server: join lines by robot, the server's id, and an
    API token of the technician.
    """

    lines: Mapping[str, JoinLine]
    server: str
    token: str = field(repr=False)


def enrol(data: Path, urls: Mapping[str, str]) -> EnrolledFleet:
    """Create a data folder with people and robots.

    ``urls`` are the server's URLs for the robots. The people have random passwords, since they sign
    in by links.
    """
    make_folder(data)
    passwords = Passwords()
    hashed = passwords.hash(secrets.token_urlsafe())
    passwords.close()
    database = ServerDatabase(data / FILE)
    try:
        with database.begin() as connection:
            now_ns = SystemClock().wall_ns()
            for role in Role:
                add_user(connection, now_ns, str(role), role, hashed)
            for group in sorted(set(GROUPS.values())):
                add_group(connection, now_ns, group)
            keys = {robot: add_robot(connection, now_ns, robot, [GROUPS[robot]]) for robot in IDS}
            lines = {robot: join_line(urls[robot], robot, key.text) for robot, key in keys.items()}
            owner = find_user(connection, str(Role.TECHNICIAN))
            assert owner is not None, "it was added"
            token = add_token(connection, now_ns, owner, "signs in the demonstration", _SCOPES)
            return EnrolledFleet(lines, server_id(connection, now_ns), token.text)
    finally:
        database.close()


DATA = "server"  # the server's data folder, below that of the demonstration
_LOOK_S = 0.2
# of the token that belongs to the technician's computer
_SCOPES = ("read:status", "read:commands", "write:commands", "read:experiments")


@dataclass(frozen=True, slots=True)
class OutagePlan:
    """Seconds until a robot's connection is first cut, its outages, and the times between them."""

    first_s: float
    away_s: float
    there_s: float


class LiveDemo:
    """The server's ``Demonstration``; created before the server, ended after it."""

    def __init__(self, folder: Path, port: int) -> None:
        self.codes = SignInCodes(SystemClock())
        self.relay = Relay()
        self._folder, self._port = folder, port
        self._running: dict[str, SimulatedRobot] = {}
        self._broken: dict[str, str] = {}
        self._lock = threading.Lock()
        self._token = ""
        self._key: SigningKey | None = None

    @property
    def data(self) -> Path:
        """Return the server's data folder."""
        return self._folder / DATA

    @property
    def robots(self) -> Sequence[str]:
        """Return the ids of the robots."""
        return IDS

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults that are offered."""
        return tuple(OFFERED_FAULTS)

    def prepare(self) -> None:
        """Create the server's data folder and the robots' folders."""
        ports = dict.fromkeys(IDS, self._port) | {SOMETIMES_AWAY: self.relay.port}
        urls = {robot: f"http://127.0.0.1:{p}" for robot, p in ports.items()}
        enrolled = enrol(self.data, urls)
        self._token = enrolled.token
        self._key = write_trust([self.paths(robot) for robot in IDS], enrolled.server)
        for robot, line in enrolled.lines.items():
            write_folder(self.paths(robot), line)

    def begin(self) -> None:
        """Start the robots; they retry until the server answers.

        Call it on the main thread: its children live as long as it does.
        """
        for robot in IDS:
            self._running[robot] = SimulatedRobot(self.paths(robot))

    def sign(self, url: str) -> None:
        """Begin to sign what the robots are to do; the server answers at its URL."""
        assert self._key is not None, "the folders are prepared first"
        for robot in IDS:
            store = self.paths(robot).store
            PlayedTechnician(url, self._token, robot, store, self._key)

    def broken(self) -> Mapping[str, str]:
        """Return the present fault of each faulty robot."""
        with self._lock:
            return dict(self._broken)

    def paths(self, robot: str) -> RobotPaths:
        """Return the paths of a robot, such as those of its trust file and the key to it."""
        return robot_paths(robot, self._folder)

    def damage(self, robot: str, fault: str) -> None:
        """Inject a fault into a robot, replacing an earlier one."""
        if fault not in OFFERED_FAULTS:
            raise UsageError(
                f"no fault '{fault}' is offered", f"one of {', '.join(OFFERED_FAULTS)}"
            )
        with self._lock:
            self._heal(robot)
            self._robot(robot).order(f"fault {fault}")
            self._broken[robot] = fault

    def repair(self, robot: str) -> None:
        """Remove the fault of a robot."""
        with self._lock:
            self._heal(robot)

    def codes_at_robots(self) -> Mapping[str, str]:
        """Return the code that is shown at each robot where a motion waits for confirmation."""
        shown = {}
        for robot in self._running:
            with contextlib.suppress(AmberboxError):  # it begins or ends
                motion = waiting_motion(self.paths(robot).store)
                if motion is not None:
                    shown[robot] = motion.code
        return shown

    def confirm(self, robot: str) -> None:
        """Confirm the motion that waits at a robot."""
        self._robot(robot)
        confirm_motion(self.paths(robot).store)

    async def cycle_outages(
        self, plan: OutagePlan, emit: Callable[[str], None], begins: Callable[[], object]
    ) -> None:
        """Cut the connection of one robot repeatedly, once ``begins`` returns true."""
        await self.relay.begin(self._port)
        while not begins():
            await asyncio.sleep(_LOOK_S)
        await asyncio.sleep(plan.first_s)
        while True:
            self.relay.cut()
            emit(
                f"{SOMETIMES_AWAY} has no way to the server for {plan.away_s:.0f} s; it records on"
            )
            await asyncio.sleep(plan.away_s)
            self.relay.mend()
            emit(f"{SOMETIMES_AWAY} has its way to the server again")
            await asyncio.sleep(plan.there_s)

    def end(self) -> None:
        """Terminate the robots."""
        for robot in self._running.values():
            robot.stop()

    def close(self) -> None:
        """End the robots, and wait for them."""
        self.end()
        self.relay.close()
        for robot in self._running.values():
            robot.wait()

    def _heal(self, robot: str) -> None:
        fault = self._broken.pop(robot, None)
        if fault is not None:
            self._robot(robot).order(f"heal {fault}")

    def _robot(self, robot: str) -> SimulatedRobot:
        if robot not in self._running:
            raise UsageError(f"{robot} does not run (yet)", "wait a moment")
        return self._running[robot]
