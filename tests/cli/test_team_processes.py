"""docs/robot/teams.md with everything running: two simulated robots and their team, diagnosed."""

from __future__ import annotations

import json
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from amberbox.blackbox.store.store import is_store, open_store
from amberbox.cli.main import main
from amberbox.core.types import Diagnosis
from amberbox.monitoring.current_state import findings_until
from amberbox.testing.clock import PATIENCE_S
from tests.monitoring.test_teams import files_of_the_page, write
from tests.support.processes import command

SILENT, LOST = "laser_rear#silent", "ropod_001:carry_carts#lost"
DEADLINE_S = 90.0
"""Long enough for a computer with other work to do; it takes a fifth of that."""
SIDES = ("front", "rear")
FMEA = """\
instances: {laser: {laser_front: {side: front}, laser_rear: {side: rear}}}
types:
  laser:
    description: the <side> laser
    failure_modes:
      silent:
        description: the <side> laser has no power
        rate: 2.0e-5
        severity: critical
        symptoms: [<component>/alive/alive]
        tests: {lamp: "no"}
      stopped:
        description: the driver of the <side> laser has ended
        rate: 2.0e-6
        symptoms: [<component>/alive/alive]
    tests:
      lamp: {question: Does the lamp of the <side> laser burn?, outcomes: ["yes", "no"]}
functions:
  carry_carts:
    description: carry carts from place to place
    needs: [laser_front, laser_rear]
    system: true
    severity: critical
"""
COMPONENT = "component_name: laser_{side}\nmodes: [laser_{side}/alive.yaml]\n"
ALIVE = """\
name: alive
monitor: heartbeat
mappings:
  - mapping: {{inputs: [sim_scan_{side}], outputs: [{{output: {{name: alive, type: bool}}}}]}}
arguments: {{max_age: 1 s}}
"""


class Page(BaseHTTPRequestHandler):
    """A page with an empty answer."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, *arguments: object) -> None:
        """Keep quiet."""


@contextmanager
def page() -> Iterator[int]:
    """Serve the page, and give its port."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def running(folders: Sequence[Path]) -> Iterator[None]:
    """Record and watch each folder, in processes of their own."""
    started = [start(verb, folder) for folder in folders for verb in ("record", "watch")]
    try:
        yield
        assert [process.poll() for process in started] == [None] * len(started)
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait(PATIENCE_S)


def start(verb: str, folder: Path) -> subprocess.Popen[bytes]:
    """Start a verb; its output goes to a file beside the folder."""
    with folder.with_name(f"{folder.name}.{verb}").open("w") as file:
        return subprocess.Popen(command(verb, folder), stdout=file, stderr=file)


def robot(number: int) -> dict[str, str]:
    """Make a robot with two lasers, of which the rear one of the first loses its power."""
    faults = "[{id: laser_rear_silent, at_s: 4}]" if number == 1 else "[]"
    topics = "[{topic: {name: scan_front}}, {topic: {name: scan_rear}}]"
    return {
        "robot.yaml": f"id: ropod_00{number}\n",
        "black_box.yaml": f"- sim: {{seed: {6 + number}, faults: {faults}, topics: {topics}}}\n",
        "fmea.yaml": FMEA,
        **{f"components/laser_{side}.yaml": COMPONENT.format(side=side) for side in SIDES},
        **{f"components/laser_{side}/alive.yaml": ALIVE.format(side=side) for side in SIDES},
    }


def world(root: Path, port: int) -> None:
    """Make two robots, and the team of the page with its server and staff interface here."""
    for number in (1, 2):
        write(root / f"ropod_00{number}", robot(number))
    for name, text in files_of_the_page().items():
        if name.startswith("transport_team/"):
            here = re.sub(r"localhost:\d+", f"127.0.0.1:{port}", text)
            write(root, {name: here})


def standing(folder: Path) -> Diagnosis | None:
    """Return the last diagnosis that the watcher of a folder has written."""
    path = folder / "store"
    found = findings_until(open_store(path), 1 << 62).diagnoses if is_store(path) else ()
    return found[-1] if found else None


def wait_for(folder: Path, is_it: Callable[[Diagnosis], bool]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while (found := standing(folder)) is None or not is_it(found):
        assert time.monotonic() < deadline_s, f"{folder.name}: {found}"
        time.sleep(0.5)


def names(fault: str) -> Callable[[Diagnosis], bool]:
    """Return a function that checks whether a diagnosis names exactly one fault."""
    return lambda found: found.state == "open" and found.hypotheses[0].faults == {fault}


def test_the_team_names_the_robot_and_the_robot_the_laser(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robots, team = [tmp_path / f"ropod_00{n}" for n in (1, 2)], tmp_path / "transport_team"
    with ExitStack() as stack:
        world(tmp_path, stack.enter_context(page()))
        stack.enter_context(running((*robots, team)))
        wait_for(robots[0], names(SILENT))
        wait_for(team, names(LOST))
        capsys.readouterr()
        assert main(["diagnose", str(team)]) == 1
        text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("The robot ropod_001 cannot: carry carts from place to place. Almost")
    assert "ropod_001 says: One of: the rear laser has no power; or" in text
    assert f"more: amberbox diagnose {robots[0]}" in text
    assert main(["diagnose", str(team), "--json"]) == 1
    made = json.loads(capsys.readouterr().out)
    assert made["origin"] == "watcher" and made["hypotheses"][0]["faults"] == [LOST]
    (member,) = made["explanation"]["members"]
    own = standing(robots[0])
    assert own is not None and member["diagnosis"] == own.id and member["state"] == "open"
    assert member["next"] == "Does the lamp of the rear laser burn?"
    assert main(["watch", str(team), "--replay"]) == 0
    assert f": {LOST} (" in capsys.readouterr().out
    judge(team, capsys)


def judge(team: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """See that the verbs for failure modes take the folder of a team."""
    for verb in ("check", "table", "criticality", "coverage"):
        assert main(["fmea", verb, str(team), "--json"]) == 0, verb
    capsys.readouterr()
    assert main(["faulttree", str(team), "--effect", "carts_get_there", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["minimal_cut_sets"] == 5 and found["by_order"] == [0, 1, 4]
