"""A server, a robot that takes commands, and people with keys, each in a process of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.agent.command_socket import SiteAsks, SiteConnection, SiteState
from amberbox.agent.join import write_key
from amberbox.client.fleet import Fleet
from amberbox.core.errors import AmberboxError
from amberbox.server import commands
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import SCOPES, Role
from amberbox.server.accounts.robots import add_group, add_robot
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.database import FILE, ServerDatabase
from amberbox.testing.fault_proxy import Faults, Proxy
from tests.support.commands import ANNA, Person
from tests.support.processes import free_port, running, wait_for, wait_for_listener
from tests.support.zmq_robot import ACTIONS

ROBOT = "ropod_001"
_PEOPLE = {
    "admin": Role.ADMIN, "anna": Role.TECHNICIAN, "ben": Role.TECHNICIAN, "olga": Role.OPERATOR,
}  # fmt: skip


class Processes:
    """Processes of ``amberbox`` by their verb, which can be killed and started again."""

    def __init__(self) -> None:
        self._words: dict[str, tuple[tuple[object, ...], Path]] = {}
        self._running: dict[str, tuple[subprocess.Popen[bytes], ExitStack]] = {}

    def start(self, verb: str, *words: object, log: Path) -> subprocess.Popen[bytes]:
        """Start a process."""
        ends = ExitStack()
        self._words[verb] = words, log
        self._running[verb] = ends.enter_context(running(verb, *words, log=log)), ends
        return self._running[verb][0]

    def kill(self, verb: str) -> None:
        """Kill a process at once."""
        process, ends = self._running.pop(verb)
        process.kill()
        process.wait()
        with contextlib.suppress(AssertionError):  # it was killed: that is no orderly end
            ends.close()

    def again(self, verb: str) -> subprocess.Popen[bytes]:
        """Start a process that was killed again."""
        words, log = self._words[verb]
        return self.start(verb, *words, log=log)

    def close(self) -> None:
        """End all of them in order, the last first."""
        with ExitStack() as ends:
            for _, end in self._running.values():
                ends.push(end)


@dataclass
class Commanded:
    """``where`` is the robot's page; ``proxy`` is the network between robot and server."""

    folder: Path
    data: Path
    port: int
    proxy: Proxy
    server_id: str
    tokens: dict[str, str] = field(default_factory=dict)
    processes: Processes = field(default_factory=lambda: Processes())

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @property
    def where(self) -> str:
        return f"{self.url}/robots/{ROBOT}"

    def fleet(self, name: str = "anna") -> Fleet:
        """Return the client of a person."""
        return Fleet(self.url, self.tokens[name])

    def site(self) -> SiteState:
        """Return what concerns commands at the robot now."""
        connection = SiteConnection(self.folder / "store")
        try:
            return connection.ask(SiteAsks())
        finally:
            connection.close()

    def code(self, command_id: str = "") -> str:
        """Wait until a motion waits for its confirmation, as the server knows; return the code."""

        def shown() -> str:
            waiting = self.site().waiting
            if waiting is None or command_id not in ("", waiting.id):
                return ""
            return waiting.code if fleet.actions(ROBOT).waiting == waiting.id else ""

        with self.fleet() as fleet:
            return wait_for(shown, "a code at the robot")

    def wait_for_state(self, command_id: str, *states: str) -> str:
        """Wait until a command has one of these states; return its reason."""
        with self.fleet() as fleet:
            found = wait_for(
                lambda: (
                    line if (line := fleet.command(ROBOT, command_id)).state in states else None
                ),
                f"{command_id} {states}",
            )
        return found.reason


def trust_text(server_id: str, people: Sequence[Person]) -> str:
    """Return a trust file in which these people may order everything."""
    lines = [f'  {one.name}: {{key: "{one.trusted("moves").key}", risk: moves}}' for one in people]
    return f"server: {server_id}\nconfirm: code\npeople:\n" + "\n".join(lines) + "\n"


@contextmanager
def commanded(
    folder: Path, endpoint: str, actions: str = ACTIONS, people: Sequence[Person] = (ANNA,),
    files: Mapping[str, str] | None = None, robot_yaml: str = "",
) -> Iterator[Commanded]:  # fmt: skip
    """Start a server and a robot whose actions are at an endpoint; wait until it takes commands.

    ``files`` are more files of the robot's folder, by name, ``robot_yaml`` more lines of that file.
    """
    data, robot = folder / "server", folder / "robot"
    data.mkdir()
    database = ServerDatabase(data / FILE)
    tokens, server_id, key = _settle(database)
    database.close()
    port, log = free_port(), folder / "server.log"
    _write_robot(robot, actions.replace("ENDPOINT", endpoint), server_id, people)
    for name, text in (files or {}).items():
        (robot / name).parent.mkdir(parents=True, exist_ok=True)
        (robot / name).write_text(text)
    words = ("--data", data, "--port", port, "--quiet")
    with ExitStack() as ends:
        processes = Processes()
        ends.callback(processes.close)
        server = processes.start("serve", *words, log=log)
        wait_for_listener(port, server, log)
        proxy = ends.enter_context(Proxy(port, Faults(kinds=("none",))))
        server_at = f"server: {{url: 'http://127.0.0.1:{proxy.port}'}}\n{robot_yaml}"
        with (robot / "robot.yaml").open("a") as file:
            file.write(server_at)
        write_key(robot, key)
        found = Commanded(robot, data, port, proxy, server_id, tokens, processes)
        processes.start("act", robot, log=folder / "act.log")
        wait_for(lambda: _answers(found), "the command process")
        processes.start("link", robot, log=folder / "link.log")
        with found.fleet() as fleet:
            wait_for(lambda: fleet.actions(ROBOT).takes_commands, "a challenge of the robot")
            wait_for(lambda: fleet.actions(ROBOT).actions, "what the robot can do")
        yield found


def _answers(world: Commanded) -> bool:
    with contextlib.suppress(AmberboxError):
        return bool(world.site())
    return False


def _settle(database: ServerDatabase) -> tuple[dict[str, str], str, str]:
    """Add people and the robot; return tokens by name, the server's id, the robot's key."""
    now_ns = time.time_ns()
    hashed = Passwords(HashCost(1, 8, 1)).hash("a long enough passphrase")
    with database.begin() as connection:
        add_group(connection, now_ns, "ward")
        for name, role in _PEOPLE.items():
            add_user(connection, now_ns, name, role, hashed)
        tokens = {
            name: add_token(
                connection, now_ns, find_user(connection, name), "tests", tuple(SCOPES)
            ).text
            for name in _PEOPLE
        }
        key = add_robot(connection, now_ns, ROBOT, ("ward",)).text
        return tokens, commands.server_id(connection, now_ns), key


def _write_robot(folder: Path, actions: str, server_id: str, people: Sequence[Person]) -> None:
    (folder / "actions").mkdir(parents=True)
    (folder / "actions" / "all.yaml").write_text(actions)
    trust = folder.parent / "trust.yaml"
    trust.write_text(trust_text(server_id, people))
    trust.chmod(0o600)
    (folder / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    (folder / "robot.yaml").write_text(f"id: {ROBOT}\ncommands: {trust}\n")


@contextmanager
def simulated_robot(folder: Path) -> Iterator[str]:
    """Run a simulated robot that drives on command; yield the address of its requests."""
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    words = ("--zmq", "tcp://127.0.0.1:*", "--commands", endpoint, "--scenario", "standing")
    with (folder / "sim.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "amberbox.sim", *words], stdin=subprocess.PIPE, stdout=log,
            stderr=log, env=dict(os.environ),
        )  # fmt: skip
    try:
        yield endpoint
    finally:
        process.kill()
        process.wait()
