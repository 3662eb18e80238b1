"""A server, a recorder, its watcher, the link and the command process: they agree on the record."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.agent.doctor.processes import SUPERVISOR_STATE_FILE
from amberbox.blackbox.retention.notes import load_notes
from amberbox.blackbox.store.incident import StoredIncident, load_all
from amberbox.blackbox.store.store import Store, open_store
from amberbox.cli.alarm import newest
from amberbox.cli.main import main
from amberbox.client.fleet import Fleet
from amberbox.client.models import AlarmLine
from amberbox.core.timestamps import NS, format_time
from amberbox.core.types import Diagnosis
from amberbox.monitoring.current_state import findings_until
from amberbox.server import process
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import SCOPES, Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.config import ServerSettings
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.schema import UPLOAD
from tests.support.processes import free_port, running, wait_for, wait_for_listener

SIM = "- sim:\n    seed: 1\n    topics: [{name: odom}, {name: scan_rear, keep: ring}]\n"
BASE = "component_name: base\nmodes: [base/driving.yaml]\n"
# it drives, which is called a fault here
DRIVING = """\
name: driving
monitor: range
mappings:
  - mapping:
      inputs: [sim_odom.twist_linear_x]
      outputs:
        - output: {name: slow, type: bool, expected: true}
arguments: {max: -80}
"""
FMEA = """\
types:
  base:
    description: the base
    failure_modes:
      worn: {description: worn, rate: 2.0e-4, symptoms: [base/driving/slow], tests: {sound: rough}}
      short: {description: short, rate: 1.0e-4, symptoms: [base/driving/slow], tests: {ohms: low}}
    tests:
      sound: {check: Listen to the motor., outcomes: [smooth, rough]}
      ohms: {check: Measure the winding., outcomes: [good, low]}
functions:
  drive: {needs: [base], system: true}
"""


@dataclass
class Site:
    """A server and a robot, all of its processes running."""

    folder: Path
    data: Path
    fleet: Fleet

    @property
    def store(self) -> Store:
        return open_store(self.folder / "store")

    def alarm(self) -> AlarmLine | None:
        return next(iter(self.fleet.alarms("r", state=("open", "acknowledged", "shelved"))), None)

    def own_state(self) -> tuple[str, str, str]:
        """Return state, person and note of the robot's own alarm."""
        row = newest(str(self.folder))[-1]
        return row["state"], str(row["who"]).rpartition(" ")[2], row["note"]

    def diagnosis(self) -> Diagnosis:
        return findings_until(self.store, 1 << 62).diagnoses[-1]

    def uploads(self) -> dict[str, tuple[str, Path]]:
        """Return state and file of each journal that the server holds."""
        database = ServerDatabase(self.data / FILE)
        try:
            with database.reading() as connection:
                rows = connection.execute(select(UPLOAD)).all()
        finally:
            database.close()
        return {row.journal: (row.state, self.data / row.path) for row in rows}

    def done(self, action: str) -> bool:
        """Return whether the newest command of an action is done."""
        found = [one for one in self.fleet.commands("r") if one.action == action]
        assert not found or found[0].state not in ("refused", "failed"), found[0].reason
        return bool(found) and found[0].state == "done"


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    data, folder, port = tmp_path / "server", tmp_path / "robot", free_port()
    data.mkdir()
    services = process.make_services(
        data, ServerSettings(f"http://127.0.0.1:{port}"), passwords=Passwords(HashCost(1, 8, 1))
    )
    with services.database.begin() as connection:
        key = add_robot(connection, time.time_ns(), "r", ()).text
        hashed = services.passwords.hash("a long enough passphrase")
        add_user(connection, time.time_ns(), "tess", Role.ADMIN, hashed)
        user = find_user(connection, "tess")
        token = add_token(connection, time.time_ns(), user, "tests", tuple(SCOPES)).text
    process.close(services)
    (folder / "components" / "base").mkdir(parents=True)
    (folder / "robot.yaml").write_text(
        "id: r\ncommands: ../trust.yaml\nstore: {min_free: 0, quota_percent: 100}\n"
    )
    trust = tmp_path / "trust.yaml"
    trust.write_text(f"server: {'5e' * 16}\npeople: {{}}\n")
    trust.chmod(0o600)
    (folder / "black_box.yaml").write_text(SIM)
    (folder / "components" / "base.yaml").write_text(BASE)
    (folder / "components" / "base" / "driving.yaml").write_text(DRIVING)
    (folder / "fmea.yaml").write_text(FMEA)
    with ExitStack() as stack:
        log = tmp_path / "server.log"
        words = ("--data", data, "--port", port, "--quiet")
        server = stack.enter_context(running("serve", *words, log=log))
        wait_for_listener(port, server, log)
        line = f"amberbox+http://r:{key}@127.0.0.1:{port}/"
        wait_for(lambda: main(["join", str(folder), line]) == 0, "the server has time for it")
        stack.enter_context(running("run", "--quiet", folder, log=tmp_path / "run.log"))
        state = folder / "store" / SUPERVISOR_STATE_FILE
        wait_for(state.is_file, "the robot runs")
        found = stack.enter_context(Fleet(f"http://127.0.0.1:{port}", token))
        wait_for(lambda: found.actions("r").takes_commands, "the robot takes commands")
        yield Site(folder, data, found)


def eventually(holds: Callable[[], object], what: str) -> None:
    wait_for(holds, what, 0.2)


@pytest.mark.timeout(240)
def test_server_and_robot_agree_on_the_record(site: Site) -> None:
    alarm = wait_for(site.alarm, "the alarm is on the server")
    _alarms(site, alarm.id)
    _answers(site)
    _incidents(site)
    _notes(site)
    _journals(site)


def _alarms(site: Site, number: int) -> None:
    fleet, folder = site.fleet, str(site.folder)
    fleet.acknowledge(number, fleet.alarm(number).alarm.revision, "I look at it")
    eventually(lambda: site.own_state() == ("acknowledged", "tess", "I look at it"), "acknowledged")
    words = ["alarm", "shelve", folder, "base", "--for", "2h", "--note", "a part", "--who", "anna"]
    assert main(words) == 0
    eventually(lambda: fleet.alarm(number).alarm.state == "shelved", "shelved on the server")
    said = [(one.what, one.who) for one in fleet.alarm(number).history if one.who]
    assert [what for what, _ in said] == ["acknowledged", "shelved"]
    assert said[1][1] == "anna at the robot"
    fleet.unshelve(number, fleet.alarm(number).alarm.revision)
    eventually(lambda: site.own_state()[:2] == ("acknowledged", "tess"), "not shelved")


def _answers(site: Site) -> None:
    fleet, before = site.fleet, site.diagnosis()
    fleet.answer("r", before.id, "base.sound", "smooth")
    eventually(lambda: site.diagnosis().revision > before.revision, "the robot counts the answer")
    assert site.diagnosis().hypotheses[0].faults == {"base#short"}
    words = ["--answer", "ohms=good", "--record", "--who", "anna"]
    assert main(["diagnose", str(site.folder), *words]) == 0

    def given() -> bool:
        answers = fleet.diagnosis("r", before.id)["answers"]
        found = {(one["test"], one["answer"], one["who"]) for one in answers}
        return ("base.ohms", "good", "anna at the robot") in found

    eventually(given, "the server has the answer that was given at the robot")


def _incidents(site: Site) -> None:
    now_ns = time.time_ns()
    span = format_time(now_ns - 3 * NS), format_time(now_ns)
    marked = site.fleet.mark_incident("r", *span, "it jerked")

    def pinned() -> StoredIncident | None:
        found = (one for one in load_all(site.store) if one.text == "it jerked")
        return next(found, None)

    incident = wait_for(pinned, "the window is pinned on the robot", 0.2)
    assert abs(incident.from_ns - (now_ns - 3 * NS)) < 2 * NS
    assert list((site.store.path / "incidents" / incident.id / "ring").glob("*.mcap"))
    eventually(lambda: site.fleet.incidents("r")[-1].on_robot == "pinned", "it is shown")
    site.fleet.release_incident("r", marked.id)
    eventually(lambda: not any(one.is_pinned for one in load_all(site.store)), "it is released")


def _notes(site: Site) -> None:
    """Notes of both sides are in both records, once, with their last text."""
    fleet, folder = site.fleet, str(site.folder)
    made = fleet.annotate("r", "wet floor", at="now-3s", to="now-1s", about="base")
    assert main(["annotate", folder, "it squeaks", "--who", "anna", "--about", "base"]) == 0

    def on_robot() -> list[tuple[str, str]]:
        found = load_notes(site.store.path).values()
        return sorted((note.text, note.who) for note in found if not note.withdrawn)

    def on_server() -> list[tuple[str, str]]:
        return sorted((note.text, note.who) for note in fleet.notes("r"))

    own = "anna"
    eventually(lambda: on_robot() == [("it squeaks", own), ("wet floor", made.who)], "robot: both")
    theirs = [("it squeaks", "anna at the robot"), ("wet floor", made.who)]
    eventually(lambda: on_server() == theirs, "server: both")
    squeaks = next(note for note in fleet.notes("r") if note.about == "base" and note.to is None)
    fleet.change_note("r", squeaks.note, "the left wheel squeaks")
    eventually(lambda: ("the left wheel squeaks", made.who) in on_robot(), "changed on the robot")
    assert main(["annotate", "withdraw", folder, made.note, "--who", "anna"]) == 0
    last = [("the left wheel squeaks", made.who)]
    eventually(lambda: on_server() == on_robot() == last, "withdrawn on the server")
    eventually(lambda: site.done("note.write"), "the robot's answers have come")
    assert main(["annotate", folder, "once more", "--who", "anna"]) == 0
    eventually(lambda: len(on_server()) == 2, "what came later has come, the rest not twice")
    assert [len(on_robot()), len(on_server())] == [2, 2]


def _journals(site: Site) -> None:
    count = len(site.store.journal_files("main"))
    site.fleet.rotate("r")
    eventually(lambda: len(site.store.journal_files("main")) > count, "new files begin")
    name = f"journal/{site.store.journal_files('main')[0].name}"
    eventually(lambda: site.uploads().get(name, ("",))[0] == "verified", "a journal is copied")
    path = site.uploads()[name][1]
    sound = path.read_bytes()
    path.chmod(0o640)
    path.write_bytes(sound[:-20] + bytes(20))
    site.fleet.copy_again("r", name)
    eventually(lambda: path.read_bytes() == sound, "a sound copy has come")
    assert site.done("journal.copy")
