"""``amberbox check`` checks component and mode files, and shows what would be monitored."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from amberbox.cli.main import main

pytestmark = pytest.mark.usefixtures("no_sockets")

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "laser"
RULES = """\
of: laser/laser_heartbeat_monitor
tests:
  - test: scans come
    interval: 100 ms
    received: {/scan_front: 1x100}
    expect:
      - {at: 5, level: LEVEL}
"""


@pytest.fixture
def laser(tmp_path: Path) -> Path:
    """The paper's laser."""
    shutil.copytree(EXAMPLE, tmp_path / "laser")
    return tmp_path / "laser"


def test_what_would_be_monitored(laser: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(laser)]) == 0
    text = capsys.readouterr().out
    assert "would monitor: 1 component, 2 modes, 2 outputs, 1 probe\n" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["laser"] in lines
    assert ["laser_device_monitor", "device", "front_laser_working"] in lines
    assert ["laser_heartbeat_monitor", "heartbeat", "front_laser_working"] in lines
    assert text.endswith("laser: fine\n")


def test_many_modes_are_listed_when_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "robot")
    assert main(["new", folder]) == 0
    capsys.readouterr()
    assert main(["check", folder]) == 0
    short = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert any(line[:1] == ["battery"] and line[1].isdigit() for line in short)
    assert main(["check", folder, "--modes"]) == 0
    each = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert len(each) > len(short) + 50
    assert ["battery:", "needs", "host,", "bus"] in each


@pytest.mark.parametrize("more", [[], ["--modes"]])
def test_what_would_be_monitored_fits_the_terminal(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    more: list[str],
) -> None:
    folder = str(tmp_path / "robot")
    assert main(["new", folder, "--from", "sim"]) == 0
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["check", folder, *more]) == 0
    text = capsys.readouterr().out.partition("would monitor")[2]
    assert max(map(len, text.splitlines()[:-1])) <= 80
    assert "wheel_rear_right" in text
    assert ("  battery: needs host, bus\n    heartbeat " in text) == bool(more)


def test_as_data(laser: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(laser), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["monitoring"]
    assert found["counts"] == {
        "components": 1,
        "not_monitored": 0,
        "modes": 2,
        "broken": 0,
        "outputs": 2,
        "probes": 1,
    }
    assert found["probes"] == [
        {
            "kind": "path_exists",
            "subject": "/dev/front_laser",
            "item": "probe_path_exists_dev_front_laser",
        }
    ]
    (component,) = found["components"]
    device, heartbeat = component["modes"]
    assert (device["monitor"], heartbeat["monitor"]) == ("device", "heartbeat")
    assert heartbeat["inputs"][0]["item"] == "ros_scan_front"
    assert heartbeat["outputs"][0]["expected"] == "true"


def test_what_a_component_can_do_without_is_shown(
    laser: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("bus", "spare"):
        (laser / "components" / f"{name}.yaml").write_text(f"component_name: {name}\n")
    component = laser / "components" / "laser.yaml"
    component.write_text(component.read_text().replace("[]", "{any: [bus, spare]}"))
    assert main(["check", str(laser), "--modes"]) == 0
    assert "  laser: needs bus or spare\n" in capsys.readouterr().out
    assert main(["check", str(laser), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["monitoring"]["components"]
    assert {entry["id"]: entry["needs"] for entry in found} == {
        "laser": "bus or spare", "bus": "", "spare": "",
    }  # fmt: skip


def test_what_is_wrong(laser: Path, capsys: pytest.CaptureFixture[str]) -> None:
    heartbeat = laser / "components" / "laser" / "heartbeat.yaml"
    heartbeat.write_text(heartbeat.read_text().replace("expected: true", "expected: 0.9"))
    component = laser / "components" / "laser.yaml"
    component.write_text(component.read_text().replace("[]", "[power]"))
    assert main(["check", str(laser)]) == 2
    text = capsys.readouterr().out
    assert f"{heartbeat}:10: mappings[0].outputs[0].expected: a bool is true or false" in text
    assert f"{component}:4: dependencies: there is no component 'power'" in text
    assert "2 modes (1 that cannot run)" in text
    assert "would record:" in text, "the recording is not affected"
    assert text.endswith(f"{laser}: 2 errors, 0 notes\n")


def test_a_folder_without_components(laser: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(laser / "components")
    assert main(["check", str(laser)]) == 0
    assert "would monitor" not in capsys.readouterr().out


RECOVERY = """\
recovery_actions: [restart it, restart unit=laser.service, restart unit=laser, rstart unit=x]
"""
RESTART = """\
restart:
  kind: shell
  command: [systemctl, restart, "{unit}"]
  parameters: {unit: {choices: [laser.service, b.service]}}
  risk: state
move: {kind: shell, command: [move], safe_stop: [halt], risk: moves}
"""


@pytest.fixture
def recovered(laser: Path) -> Path:
    """Return a folder with recovery actions, and an action that two of them stand for."""
    component = laser / "components" / "laser.yaml"
    component.write_text(component.read_text() + RECOVERY)
    (laser / "components" / "recovery_config.yaml").write_text(
        "laser: {monitor: laser/heartbeat, restart: b.service, component_type: systemd}\n"
    )
    (laser / "actions").mkdir()
    (laser / "actions" / "all.yaml").write_text(RESTART)
    return laser


def test_recovery_actions_are_those_that_can_be_run_or_texts(
    recovered: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(recovered), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    run = f"amberbox action run {recovered} restart unit="
    commands = [one["command"] for one in found["recovery_actions"]]
    assert commands == ["", f"{run}laser.service", "", "", f"{run}b.service"]
    problems = [one["problem"] for one in found["recovery_actions"]]
    assert problems[:2] == ["", ""] and "is none of" in problems[2]
    assert "did you mean 'restart'" in problems[3]
    recovers = {action["name"]: action["recovers"] for action in found["actions"]}
    assert recovers == {"restart": ["laser"], "move": []}
    assert main(["check", str(recovered)]) == 0
    text = capsys.readouterr().out
    assert "  laser  restart unit=laser.service\n" in text
    assert "  laser  only a text: restart it\n" in text


def test_rules_of_recovery_name_what_there_is(
    recovered: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with (recovered / "robot.yaml").open("a") as file:
        file.write("""
recovery:
  - {when: laser, do: restart, with: {unit: b.service}, at_most: 3 per 1 h}
  - {when: lasr, do: restrt, at_most: 3 per 1 h}
  - {when: laser/heartbeet, do: move, at_most: 3 per 1 h}
  - {when: "laser#crash", do: restart, with: {unit: c}, at_most: 3 per 1 h}
""")
    assert main(["check", str(recovered)]) == 2
    text = capsys.readouterr().out
    for place, what in (
        ("recovery[1].do", "there is no action 'restrt'; did you mean 'restart'?"),
        ("recovery[1].when", "there is no component or mode 'lasr'; did you mean 'laser'?"),
        ("recovery[2].do", "move moves the robot"),
        ("recovery[2].when", "there is no component or mode 'laser/heartbeet'"),
        ("recovery[3].with", "unit: 'c' is none of"),
        ("recovery[3].when", "there is no failure mode 'laser#crash': there is no fmea.yaml"),
    ):
        assert any(f": {place}: " in row and what in row for row in text.splitlines()), place
    assert "recovery[0]" not in text


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("at_most: 3 per", "is no limit; write: 3 per 1 h"),
        ("at_most: 3 per 1 s", "must be per 1 min or longer"),
        ("at_most: 1000 per 1 h", "from 1 to 100"),
        ("at_most: 1 per 1 h, wait: 2 d", "from 0 to 1 d"),
        ("at_most: 1 per 1 h, if: battery >", "expression"),
        ("wait: 1 s", "at_most"),
        ("at_most: 1 per 1 h, with: {unit: .nan}", "must be numbers"),
    ],
)
def test_a_rule_of_recovery_has_limits(
    recovered: Path, capsys: pytest.CaptureFixture[str], line: str, what: str
) -> None:
    with (recovered / "robot.yaml").open("a") as file:
        file.write(f"\nrecovery: [{{when: laser, do: restart, {line}}}]\n")
    assert main(["check", str(recovered)]) == 2
    assert what in capsys.readouterr().out


@pytest.mark.parametrize(("level", "code"), [("ok", 0), ("error", 2)])
def test_rule_tests_run(
    laser: Path, capsys: pytest.CaptureFixture[str], level: str, code: int
) -> None:
    (laser / "components" / "laser.test.yaml").write_text(RULES.replace("LEVEL", level))
    assert main(["check", str(laser)]) == code
    text = capsys.readouterr().out
    assert ("laser.test.yaml:7: test 'scans come'" in text) == (code == 2)


def test_monitors_wait_for_the_black_box(laser: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (laser / "black_box.yaml").write_text("- rso: {}\n")
    assert main(["check", str(laser)]) == 2
    text = capsys.readouterr().out
    assert "components:1: note: file: is judged when robot.yaml and black_box.yaml are" in text


def test_triggers_on_outputs_and_statuses_are_resolved(
    laser: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = laser / "robot.yaml"
    device = "laser/laser_device_monitor"
    text = robot.read_text() + "triggers:\n"
    for number, when in enumerate((
        f"not {device}/front_laser_working", "status(laser) == 'error'",
        f"status({device}) != 'ok' for 5s",
    )):  # fmt: skip
        text += f'  - {{name: t{number}, when: "{when}"}}\n'
    robot.write_text(text)
    assert main(["check", str(laser)]) == 0
    assert capsys.readouterr().out.endswith("laser: fine\n")
    robot.write_text(text.replace("front_laser_w", "front_laser_v").replace("(laser)", "(lasr)"))
    assert main(["check", str(laser)]) == 2
    told = capsys.readouterr().out
    line = len(robot.read_text().splitlines())
    assert f"robot.yaml:{line - 2}: triggers[0].when: there is no output or status" in told
    assert f"did you mean '{device}/front_laser_working'?" in told
    assert "triggers[1].when: there is no output or status 'status(lasr)'; did you mean" in told
