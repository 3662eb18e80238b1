"""Every provider of evidence gives the same answer on the robot, in a replay and on the server."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store, submit
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.given_findings import KIND, RecordedFinding
from amberbox.core.plugins import find
from amberbox.core.timestamps import format_time
from amberbox.core.types import Status
from amberbox.diagnosis.diagnose import EVIDENCE
from amberbox.link.folders import pack
from amberbox.monitoring.current_state import findings_until
from amberbox.monitoring.findings import Finding
from tests.cli.diagnosed import FMEA, Bench, write_folder
from tests.server.house import House, house
from tests.server.knowledge import robot as server_robot

ROBOT = "ropod_001"
RULES = "short_circuit(X) :- absent(noisy), component(X), X == motor.\n"
FLOW = "state_flow.unlikely.ros_speed"
FINDINGS = f"""\
findings:
  - {{rule: short_circuit(X), maps_to: ['<X>#short'], detects: 0.9, leak: 0.01}}
  - {{finding: {FLOW}, maps_to: ['fan#stuck'], detects: 0.7}}
"""

EQUATIONS = """\
kind: equations
unknowns: []
known: {speed: ros_speed.data, wanted: ros_speed.data}
equations:
  turns: {residual: speed - wanted, component: motor}
residuals:
  turns: {equations: [turns], threshold: 1, shown_by: motor/temperature/cool}
"""
COMPONENTS = """\
kind: components
types:
  motor:
    ports: {power: [on, off], speed: [turns, stands]}
    modes:
      ok: {nominal: true, constraints: ["power == on and speed == turns or power == off"]}
      worn: {}
      short: {}
  relay:
    ports: {out: [on, off]}
    modes: {ok: {nominal: true, constraints: ["out == on"]}}
components: {motor: motor, relay: relay}
connections: [[relay.out, motor.power]]
observe:
  motor.speed: {value: ros_speed.data > 0, values: {true: turns, false: stands}, max_age: 2}
"""
PROVEN = "one of motor#short or motor#worn"

CASES: dict[str, tuple[float, Sequence[str], str]] = {
    "monitors": (2.5, (), "motor/temperature/cool"),
    "conditions": (6.5, (), "noisy"),
    "user": (2.5, ("--symptom", "noisy", "--answer", "sound=smooth"), "noisy"),
    "rules": (2.5, (), "rule:short_circuit(motor)"),
    "residuals": (2.5, (), "one of motor#short or motor#worn or unknown#other"),
    "detectors": (10.5, (), FLOW),
    "consistency": (2.5, (), PROVEN),
    "faulttree": (2.5, ("--engine", "faulttree"), "motor/temperature/cool"),
}
"""By provider: the time of the diagnosis, its options, and a symptom that results."""
SAME = ("hypotheses", "groups", "next_tests", "findings", "make_safe", "symptoms", "answers")


@pytest.fixture(scope="module")
def start_ns() -> list[int]:
    return []


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory, start_ns: list[int]) -> Path:
    """Watch a robot that is well, hot and standing, well, noisy, and strange to a detector."""
    place = write_folder(tmp_path_factory.mktemp("same") / "robot")
    (place / "fmea.yaml").write_text(FMEA + FINDINGS)
    (place / "robot.yaml").write_text(f"id: {ROBOT}\n")
    (place / "models").mkdir()
    (place / "models" / "motor.yaml").write_text(EQUATIONS)
    (place / "models" / "drive.yaml").write_text(COMPONENTS)
    (place / "rules").mkdir()
    (place / "rules" / "motor.pl").write_text(RULES)
    bench = Bench(place)
    with bench.watched():
        bench.run(4)
        start_ns.append(bench.clock.wall_ns())
        bench.run(3, temperature=90, speed=0)
        bench.run(3)
        bench.run(3, speed=200)
        found = RecordedFinding(FLOW, measured=("ros_speed.data",))
        submit(open_store(load_folder(place).store_path), KIND, msgspec.to_builtins(found))
        bench.run(3)
    bench.box.close()
    return place


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, robot: Path) -> Iterator[House]:
    """Bring the folder, and what the watcher found, to a server."""
    folder = load_folder(robot)
    found = findings_until(open_store(folder.store_path), 1 << 62)
    lines: list[tuple[int, Finding]] = [(s.confirmed_ns or 0, s) for s in found.symptoms]
    lines += [(made.at_ns, made) for made in found.diagnoses]
    status = Status(ROBOT, "motor", "", "ok", "nominal", {}, (), 0, 0, "", folder.config_hash)
    times = sorted({at_ns for at_ns, _ in lines})
    lines += [(at, replace(status, measured_ns=at, since_ns=at)) for at in times]
    files = {
        path.relative_to(robot).as_posix(): path.read_bytes()
        for path in robot.rglob("*")
        if path.is_file() and not path.is_relative_to(folder.store_path)
    }
    with house(tmp_path_factory.mktemp("house")) as home:
        home.services.folders.keep(ROBOT, folder.config_hash, pack(files))
        server_robot.state(home, ROBOT, folder.config_hash)
        server_robot.say(home, sorted(lines, key=lambda line: line[0]), ROBOT)
        yield home


def test_every_provider_has_a_case() -> None:
    assert find(EVIDENCE).keys() == CASES.keys()


@pytest.mark.parametrize("provider", CASES)
def test_robot_replay_and_server_agree(
    robot: Path, server: House, start_ns: list[int], provider: str,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    after_s, options, symptom = CASES[provider]
    at = format_time(start_ns[0] + round(after_s * NS))
    by_journal = _diagnosed(capsys, robot, "--at", at, *options)
    assert by_journal["origin"] == "watcher"
    with monkeypatch.context() as patch:
        patch.setattr("amberbox.consult.context.was_watched", lambda *_: False)
        replayed = _diagnosed(capsys, robot, "--at", at, *options)
    assert replayed["origin"] == "record"
    answer = server.client("operator").post(
        f"/api/v1/robots/{ROBOT}/diagnose", json={"at": at, **_asked(options)}
    )
    assert answer.status_code == 200, answer.text
    by_server = answer.json()
    assert by_server["notes"] == []
    assert {key: by_server[key] for key in SAME} == {key: by_journal[key] for key in SAME}
    assert replayed["hypotheses"] == by_journal["hypotheses"]
    explained = {name for h in by_journal["hypotheses"] for name in (*h["explains"],)}
    assert symptom in {*explained, *(s["id"] for s in by_journal["symptoms"] if s["counted"])}


def _diagnosed(capsys: pytest.CaptureFixture[str], *arguments: Any) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["diagnose", *map(str, arguments), "--json"]) in (0, 1)
    made: dict[str, Any] = json.loads(capsys.readouterr().out)
    return made


def _asked(options: Sequence[str]) -> dict[str, Any]:
    """Return options of the command line as a request."""
    asked: dict[str, Any] = {}
    for name, text in zip(options[::2], options[1::2], strict=True):
        key, _, value = text.partition("=")
        if name == "--engine":
            asked["engine"] = text
        elif name == "--symptom":
            asked.setdefault("symptoms", {})[key] = value or "present"
        else:
            asked.setdefault("answers", {})[key] = value
    return asked
