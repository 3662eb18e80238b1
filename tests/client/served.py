"""A server for the client's tests: a process, with the record and the findings of a robot."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.tls import fingerprint
from amberbox.monitoring.findings import encoded
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import find_user
from amberbox.server.schema import STATUS
from tests.cli.test_consistency import POWER
from tests.cli.test_structure import WHEEL
from tests.server.archive.recordings import Robot
from tests.server.data.filled import fill
from tests.server.house import House, house
from tests.server.knowledge import robot as sim
from tests.server.state import lives
from tests.support.processes import free_port, running, wait_for_listener


@dataclass
class Served:
    """A server that listens; ``robot`` is the folder whose record it has a copy of."""

    data: Path
    robot: Robot
    port: int
    pin: str
    tokens: dict[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"https://localhost:{self.port}"

    @property
    def where(self) -> str:
        """The page of the robot, with whom to trust."""
        return f"{self.url}/robots/ropod_001#ca=sha256:{self.pin}"

    @property
    def store(self) -> str:
        return str(self.robot.store)


@contextmanager
def served(folder: Path) -> Iterator[Served]:
    """Fill a server's folder, start the server on it, and end it afterwards."""
    data = folder / "server"
    with house(data) as home:
        robot = fill(home, folder)
        home.services.archive.commit(0)
        _say(home)
        tokens = {name: _token(home, *words) for name, words in _TOKENS.items()}
    assert main(["serve", "cert", "--data", str(data), "--host", "localhost"]) == 0
    pin = fingerprint((data / "tls" / "ca.pem").read_bytes())
    found = Served(data, robot, free_port(), pin, tokens)
    log, words = folder / "server.log", ("--data", data, "--port", found.port, "--quiet")
    with running("serve", *words, log=log) as found.process:
        wait_for_listener(found.port, found.process, log)
        yield found


_TOKENS: dict[str, tuple[str, ...]] = {
    "admin": ("admin",),
    "technician": ("technician",),
    "viewer": ("viewer",),
    "scope": ("technician", "read:status"),
}


def _token(home: House, owner: str, *scopes: str) -> str:
    from amberbox.server.accounts.permissions import SCOPES

    with home.services.database.begin() as connection:
        now_ns = time.time_ns()
        user = find_user(connection, owner)
        return add_token(connection, now_ns, user, "tests", scopes or tuple(SCOPES)).text


def _say(home: House) -> None:
    """Let the robot's watcher have found a laser without scans, and the server have an alarm."""
    at_ns = sim.AT_NS
    more = {"models/wheel.yaml": WHEEL.encode(), "models/power.yaml": POWER.encode()}
    sim.hand_in(home, more=more)
    sim.state(home)
    silent = sim.symptom(sim.NO_SCANS, at_ns)
    sim.say(home, [
        (at_ns - 5 * NS, sim.status("laser_front", at_ns - 5 * NS)),
        (at_ns, silent), (at_ns, sim.diagnosis(at_ns, silent)),
        (at_ns + NS, sim.status("laser_front", at_ns + NS)),
    ])  # fmt: skip
    rows = []
    for mode in ("", "heartbeat"):
        _, data = encoded(sim.status("laser_front", at_ns + 2 * NS, mode, alive=False))
        rows.append(
            {"robot": "ropod_001", "component": "laser_front", "mode": mode, "level": "error",
             "store_id": sim.STORE, "run": 1, "seq": 10, "log_ns": at_ns + 2 * NS,
             "received_ns": at_ns + 2 * NS, "data": data}
        )  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(STATUS.insert(), rows)
    lives.put_alarm(home, 7, "ropod_001")
