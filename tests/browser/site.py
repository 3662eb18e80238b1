"""A real server on loopback with three robots: one with a fault, one that is well, one away."""

from __future__ import annotations

import json
import subprocess
import time
import urllib.request
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fastapi import FastAPI
from sqlalchemy import update

from amberbox.core.clock import NS
from amberbox.core.command import Command
from amberbox.link.connection import LinkOptions
from amberbox.link.folders import pack
from amberbox.server import commands
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import find_user
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.experiments import runs
from amberbox.server.http.auth import COOKIE
from amberbox.server.schema import (
    ALARM,
    ALARM_ROBOT,
    COMMAND,
    COMMAND_ANSWER,
    COMMAND_ROBOT,
    HISTORY,
    ROBOT,
)
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.browser import hostile, record, story
from tests.browser.robot import Robot, RobotClock
from tests.server.archive.recordings import Robot as Recorded
from tests.server.house import House
from tests.server.knowledge import robot as sim
from tests.support.processes import command, free_port

MINUTE_NS = 60 * NS
HASH_2 = "bead" * 16
"""Hash of the folder of ``ropod_002``."""
AWAY_NS = 40 * MINUTE_NS
"""How long ``ropod_003`` has been away."""


@dataclass
class Site:
    """The server and its robots; ``now_ns`` is when the hour of their past ended."""

    folder: Path
    port: int
    now_ns: int
    keys: dict[str, str]
    robots: dict[str, Robot] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    _database: ServerDatabase | None = None

    @property
    def url(self) -> str:
        return f"http://localhost:{self.port}"

    @property
    def data(self) -> Path:
        """The server's data folder."""
        return self.folder / "server"

    def say(self, robot: str, component: str, level: Any = "ok", **more: Any) -> None:
        """Let a component of a robot go into another condition (see ``Robot.change``)."""
        self.robots[robot].change(component, level, more.pop("state", level), **more)

    def session(self, name: str) -> str:
        """Begin a session of a person; return the value of the cookie."""
        with self.database.begin() as connection:
            user = find_user(connection, name)
            began = begin_session(connection, time.time_ns(), user.user_id, "127.0.0.1", "tests")
        return began.secret

    def token(self, name: str, *scopes: str) -> str:
        """Make a token of a person."""
        with self.database.begin() as connection:
            user = find_user(connection, name)
            return add_token(connection, time.time_ns(), user, "tests", scopes).text

    def ask(self, path: str, name: str = "admin") -> Any:
        """Call the API as a person; return the answer."""
        headers = {"Cookie": f"{COOKIE}={self.session(name)}"}
        request = urllib.request.Request(f"{self.url}/api/v1{path}", headers=headers)
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return json.load(answer)

    @property
    def database(self) -> ServerDatabase:
        """The server's own database, which other processes may write, too."""
        self._database = self._database or ServerDatabase(self.data / FILE)
        return self._database

    def start(self) -> None:
        """Start the server on its port and wait until it answers."""
        self.launch()
        wait_until(self.answers, "the server answers")

    def launch(self) -> None:
        """Start the server without waiting for it."""
        words = ("--data", str(self.data), "--port", str(self.port), "--quiet")
        with (self.folder / "server.log").open("ab") as log:
            self.process = subprocess.Popen(
                command("serve", *words), stdin=subprocess.DEVNULL,
                stdout=log, stderr=log,
            )  # fmt: skip

    def kill(self) -> None:
        """End the server as a power cut does."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def restart(self) -> None:
        """Kill the server and start it on the same port; robots connect by themselves."""
        self.kill()
        self.start()

    def is_online(self, *robots: str) -> bool:
        """Return whether the server shows all these robots as online with a known status."""
        cards = {card["robot"]: card for card in self.ask("/robots")}
        return all(cards[r]["online"] and cards[r]["level"] != "unknown" for r in robots)

    def close(self) -> None:
        """End robots and server."""
        for robot in self.robots.values():
            robot.close()
        if self._database is not None:
            self._database.close()
        if self.process is not None:
            self.kill()

    def answers(self) -> bool:
        assert self.process is not None
        assert self.process.poll() is None, (self.folder / "server.log").read_text()[-4000:]
        try:
            with urllib.request.urlopen(f"{self.url}/api/v1/health", timeout=PATIENCE_S):
                return True
        except OSError:
            return False


@contextmanager
def made(folder: Path) -> Iterator[Site]:
    """Fill a server's folder, start it, connect the robots; end all of it afterwards."""
    now_ns = time.time_ns()
    (folder / "server").mkdir(parents=True)
    home = House(folder / "server", FastAPI(), now_ns)  # nobody asks this one
    try:
        site = Site(folder, free_port(), now_ns, home.keys)
        boot = "b0070000-0000-4000-8000-000000000001"
        _fill(home, folder, now_ns, boot)
    finally:
        home.close()
    try:
        site.launch()
        _let_happen(site, boot)
        wait_until(site.answers, "the server answers")
        _let_come(site)
        yield site
    finally:
        site.close()


@contextmanager
def fresh(folder: Path) -> Iterator[Site]:
    """Start a server without any account; end it afterwards."""
    (folder / "server").mkdir(parents=True)
    site = Site(folder, free_port(), time.time_ns(), {})
    try:
        site.start()
        yield site
    finally:
        site.close()


def _fill(home: House, folder: Path, now_ns: int, boot: str) -> None:
    """Put records, folders, a robot that is away and alarms of before into the server."""
    one = Recorded("ropod_001", folder)
    record.write_kept(one.store, now_ns, boot)
    record.write_record(one.store, now_ns, boot)
    *early, late = [path for path in one.files() if path.parent.name == "journal"]
    kept = [path for path in one.files() if path.parent.name != "journal"]
    _hand_in(home, one, [*early, *kept])
    _away(home, folder, now_ns)
    home.services.archive.commit(0)
    _hand_in(home, one, [late])
    model = {"robot.yaml": b"id: ropod_001\nmodel: Ropod 2\n", **hostile.model_files()}
    odd = {"robot.yaml": f"id: ropod_002\nmodel: {json.dumps(hostile.MODEL)}\n".encode()}
    for name, hash_, more in (("ropod_001", sim.HASH, model), ("ropod_002", HASH_2, odd)):
        assert home.services.folders.keep(name, hash_, pack({**sim.files(), **more}))
    _old_alarms(home, now_ns)
    _command(home, now_ns)
    _runs(home, now_ns)


def _runs(home: House, now_ns: int) -> None:
    """Let ``ropod_002`` have a run that was aborted, and another that waits for a person."""
    runner = home.services.runner
    found = runner.shelf.upload(hostile.EXPERIMENT, hostile.experiment_files(), "technician")
    order = runs.RunOrder("ropod_002", "experiment", found.name, found.title, found.sha256,
                          {"way_m": 1}, "technician")  # fmt: skip
    for run, is_over in ((hostile.EARLIER_RUN, True), (hostile.RUN, False)):
        with (
            patch.object(runs, "new_run_id", return_value=run),
            home.services.database.begin() as c,
        ):
            stored = runs.add(c, now_ns, order)
            runner.register.begin(c, stored, {"technician": "technician"}, "technician")
        runner.register.change(stored, lambda r, _, at: r.note(hostile.NOTE, "operator", at))
        if is_over:
            runner.register.change(stored, lambda r, _, at: r.abort("operator", hostile.NOTE, at))


def _command(home: House, now_ns: int) -> None:
    """Let ``ropod_001`` have announced actions, and have refused one of two orders."""
    actions = [
        {"name": "drive", "risk": "moves", "description": hostile.SCRIPT, "parameters": {
            "distance_m": {"type": "float", "unit": hostile.MARKUP, "min": -2, "max": 2},
            "to": {"type": "string", "choices": ["left", hostile.TEMPLATE], "default": "left"}}},
        {"name": "restart_driver", "risk": "state", "description": hostile.TEMPLATE * 20},
    ]  # fmt: skip
    row = {"robot": "ropod_001", "store_id": "s", "answered": 1, "lease": 3, "run": hostile.SCRIPT,
           "holder": "", "actions": json.dumps({"actions": actions}),
           "actions_ns": now_ns}  # fmt: skip
    orders = [
        Command(id_, "ropod_001", "drive", json.dumps({"to": hostile.MARKUP}), hostile.TEMPLATE,
                "moves", run=hostile.SCRIPT)
        for id_ in (hostile.COMMAND, "0" * 32)
    ]  # fmt: skip
    refusal = {"robot": "ropod_001", "store_id": "s", "command": hostile.COMMAND, "number": 1,
               "state": "refused", "reason": hostile.NOTE, "result": hostile.SCRIPT * 200,
               "at_ns": now_ns, "boot": "b", "mono_ns": 1, "received_ns": now_ns}  # fmt: skip
    over = update(COMMAND).where(COMMAND.c.id == hostile.COMMAND)
    with home.services.database.begin() as connection:
        connection.execute(COMMAND_ROBOT.insert(), [row])
        for one in orders:
            commands.intend(connection, now_ns, one, 3600 * NS)
        connection.execute(COMMAND_ANSWER.insert(), [refusal])
        connection.execute(over.values(state="refused", reason=hostile.NOTE, answered_ns=now_ns))
        commands.revoke(connection, now_ns, "ab" * 8, "technician", hostile.NOTE)


def _hand_in(home: House, robot: Recorded, paths: Iterable[Path]) -> None:
    for path in paths:
        robot.hand_in(home.services.archive, path)


def _away(home: House, folder: Path, now_ns: int) -> None:
    """Let ``ropod_003`` have been connected before, with a backlog to send."""
    other = Recorded("ropod_003", folder)
    other.record(0, files=1, at_ns=now_ns - AWAY_NS - MINUTE_NS)
    other.hand_in_all(home.services.archive)
    at_ns = now_ns - AWAY_NS
    row = {"robot": "ropod_003", "epoch": 1, "store_id": other.store_id, "boot_id": "b",
           "config_hash": "", "version": "0.6.0", "connected": False,
           "connected_ns": at_ns - 20 * MINUTE_NS, "last_seen_ns": at_ns, "backlog": 1234,
           "backlog_bytes": 56_000_000}  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ROBOT.insert(), [row])


def _old_alarms(home: House, now_ns: int) -> None:
    """Put alarms in that people have done something about: the numbers 1, 2 and 3."""
    hour_ns = 3600 * NS
    began = {1: now_ns - 3 * hour_ns, 2: now_ns - 5 * hour_ns, 3: now_ns - 30 * hour_ns}
    alarms = [
        Alarm(1, "robot", "ropod_002", "wifi", "warning", "warn", hostile.NOTE, began[1],
              began[1], state="acknowledged", acknowledged_by="operator", owner="technician",
              acknowledged_ns=began[1] + MINUTE_NS, revision=2),
        Alarm(2, "robot", "ropod_002", "battery", "urgent", "warn", "charge is 14 %", began[2],
              began[2], state="shelved", shelved_by="operator", revision=2,
              shelved_until_ns=now_ns + 2 * hour_ns, resolution=""),
        Alarm(3, "robot", "ropod_001", "imu", "critical", "error", "no data", began[3], began[3],
              active=False, cleared_ns=began[3] + hour_ns, state="resolved", revision=2,
              resolved_by="technician", resolved_ns=began[3] + hour_ns, resolution="cable"),
    ]  # fmt: skip
    history = [
        {"alarm": alarm.number, "at_ns": alarm.opened_ns + later_ns, "who": who, "what": what,
         "text": text}
        for alarm in alarms
        for later_ns, who, what, text in (
            (0, "", "opened", alarm.reason),
            (MINUTE_NS, "operator", alarm.state, "on my way"),
            (2 * MINUTE_NS, "operator", "note", hostile.NOTE),
        )
    ]  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(ALARM.insert(), [asdict(alarm) for alarm in alarms])
        about = [{"alarm": a.number, "robot": a.robot, "from_ns": a.opened_ns, "to_ns": None}
                 for a in alarms]  # fmt: skip
        connection.execute(ALARM_ROBOT.insert(), about)
        connection.execute(HISTORY.insert(), history)


def _let_happen(site: Site, boot: str) -> None:
    """Let two robots find what happened to them."""
    for name, hash_ in (("ropod_001", sim.HASH), ("ropod_002", HASH_2)):
        options = LinkOptions(site.url, name, site.keys[name], config_hash=hash_)
        site.robots[name] = Robot(site.folder / name, RobotClock(boot), options)
    story.past(site.robots["ropod_001"])
    story.laser_dies(site.robots["ropod_001"])
    story.hostile_past(site.robots["ropod_002"])


def _let_come(site: Site) -> None:
    """Connect the robots, and wait until the server has received their records."""
    for robot in site.robots.values():
        robot.come()
    wait_until(lambda: site.is_online(*site.robots), "the robots are here")
    wait_until(lambda: _has_alarm(site), "the alarm of the laser is there")


def _has_alarm(site: Site) -> bool:
    found = site.ask("/alarms?state=open&robot=ropod_001")
    return any(alarm["origin"] == "laser_front" for alarm in found)
