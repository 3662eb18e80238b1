"""Robots behind bad networks and their server, each a process that may be killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.agent.doctor.processes import LINK_STATE_FILE
from amberbox.agent.join import write_key
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.users import add_user
from amberbox.server.database import FILE, ServerDatabase
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.fault_proxy import Faults, FrameFaults, Proxy
from tests.support.processes import free_port, wait_for_listener

ROOT = Path(__file__).parents[3]
BLACK_BOX = "- ros: {topics: [{name: /count}]}\n"
NETWORK = Faults(
    after_bytes=(500, 25_000), stall_s=1.0, rate=60_000,
    frames=FrameFaults(duplicate=0.03, reorder=0.01, corrupt=0.005, hold=0.01),
)  # fmt: skip


def start(*command: str, log: Path) -> subprocess.Popen[bytes]:
    """Start Python on something."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'src'}"}
    with log.open("ab") as said:
        return subprocess.Popen(
            [sys.executable, "-m", *command], cwd=ROOT, env=environment, stdin=subprocess.DEVNULL,
            stdout=said, stderr=said,
        )  # fmt: skip


def kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a process without a word."""
    process.send_signal(signal.SIGKILL)
    process.wait()


@dataclass
class Robot:
    """One robot: a process that writes, its link, and its network."""

    name: str
    folder: Path
    proxy: Proxy
    lives: int = 0
    boot: str = field(default_factory=lambda: str(uuid.uuid4()))
    box: subprocess.Popen[bytes] | None = None
    link: subprocess.Popen[bytes] | None = None
    old: list[Path] = field(default_factory=list)
    """Stores that it had before."""
    written: set[Path] = field(default_factory=set)
    """What its watcher had written before this life."""

    @property
    def store(self) -> Path:
        return self.folder / "store"

    @property
    def log(self) -> Path:
        return self.folder.parent / f"{self.name}.log"

    def start_box(self) -> None:
        """Begin to write."""
        self.lives += 1
        self.written = set(self.store.glob("watch/*.mcap"))
        words = (str(self.store), self.name, self.boot, str(self.lives))
        self.box = start("tests.server.endtoend.robotprocess", *words, log=self.log)

    def start_link(self) -> None:
        """Begin to link."""
        self.link = start("amberbox", "link", str(self.folder), log=self.log)

    @property
    def is_linked(self) -> bool:
        """Return whether its link reports a connection."""
        try:
            return bool(json.loads((self.store / LINK_STATE_FILE).read_text())["connected"])
        except (OSError, ValueError):
            return False

    def lose_power(self) -> None:
        """Kill everything at once; the next start is another boot."""
        for process in (self.box, self.link):
            if process is not None:
                kill(process)
        self.boot = str(uuid.uuid4())

    def start(self) -> None:
        """Begin with everything."""
        self.start_box()
        self.start_link()

    def wait(self) -> None:
        """Wait until it writes in this life."""
        end_s = time.monotonic() + PATIENCE_S
        while not set(self.store.glob("watch/*.mcap")) - self.written:
            assert time.monotonic() < end_s, self.log.read_text()[-3000:]
            time.sleep(0.05)


@dataclass
class World:
    """All of it; a context manager that leaves no process behind."""

    folder: Path
    count: int
    seed: int
    faults: Faults = NETWORK
    robots: list[Robot] = field(default_factory=list)
    server: subprocess.Popen[bytes] | None = None
    port: int = 0

    @property
    def data(self) -> Path:
        """Folder of the server."""
        return self.folder / "server"

    def __enter__(self) -> World:
        self.port = free_port()
        self.data.mkdir()
        database = ServerDatabase(self.data / FILE)
        with database.begin() as connection:  # robots are let in once there is an admin
            hashed = Passwords(HashCost(1, 8, 1)).hash("a long enough passphrase")
            add_user(connection, time.time_ns(), "admin", Role.ADMIN, hashed)
        for number in range(self.count):
            self.robots.append(self._robot(f"r{number}", database))
        database.close()
        self.start_server()
        return self

    def __exit__(self, *_: object) -> None:
        for robot in self.robots:
            for process in (robot.box, robot.link):
                if process is not None and process.poll() is None:
                    kill(process)
            robot.proxy.__exit__()
        if self.server is not None:
            kill(self.server)

    def start_server(self) -> None:
        """Start the server."""
        words = ("--data", str(self.data), "--port", str(self.port), "--quiet")
        self.server = start("amberbox", "serve", *words, log=self.folder / "server.log")

    def wait_for_server(self) -> None:
        """Wait until the server listens."""
        assert self.server is not None
        wait_for_listener(self.port, self.server, self.folder / "server.log")

    def wait_for_link(self) -> None:
        """Wait for a while until a robot is linked, so that there is something to be cut."""
        end_s = time.monotonic() + 5
        while time.monotonic() < end_s and not any(robot.is_linked for robot in self.robots):
            time.sleep(0.1)

    def kill_server(self) -> None:
        """Kill the server without a word."""
        assert self.server is not None
        kill(self.server)

    def clear_networks(self) -> None:
        """Let all networks be good from now on."""
        for robot in self.robots:
            robot.proxy.faults = Faults(kinds=("none",))
            robot.proxy.cut()

    def _robot(self, name: str, database: ServerDatabase) -> Robot:
        proxy = Proxy(self.port, self.faults, self.seed * 100 + len(self.robots))
        proxy.__enter__()
        folder = self.folder / name
        folder.mkdir()
        server = f"server: {{url: 'http://127.0.0.1:{proxy.port}'}}\n"
        (folder / "robot.yaml").write_text(f"id: {name}\n{server}")
        (folder / "black_box.yaml").write_text(BLACK_BOX)
        with database.begin() as connection:
            write_key(folder, add_robot(connection, time.time_ns(), name, ()).text)
        return Robot(name, folder, proxy)
