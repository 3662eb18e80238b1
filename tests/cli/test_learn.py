"""``amberbox learn``: a model file of nominal missions, and monitors with the limits."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.query.record import open as open_record
from amberbox.cli.main import main
from amberbox.detection.missions import missions_of, shared_out
from amberbox.detection.model_file import load_model

OPTIONS = """\
residual:
  variables: [sim_battery.*]
  pairs: [{output: sim_battery.voltage, inputs: [sim_battery.current]}]
state_flow:
  window: 2 s
bank:
  sensors: [sim_battery.voltage]
  models:
    holds: {F: [[1]], H: [[1]], Q: [[1e-4 * dt]], R: [[0.01]]}
    falls: {F: [[1]], H: [[1]], Q: [[1 * dt]], R: [[0.01]]}
redundant:
  groups:
    battery: {members: {one: [sim_battery.voltage], other: [sim_battery.voltage]}}
"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a robot folder with a minute of the simulated robot."""
    folder = tmp_path_factory.mktemp("learn") / "r1"
    folder.mkdir()
    (folder / "robot.yaml").write_text('id: "r1"\nstore: {path: store}\n')
    (folder / "black_box.yaml").write_text(
        "- sim:\n    {seed: 3, speed: max, duration_s: 60, topics: [{topic: {name: battery}}, "
        "{topic: {name: localisation}}, {topic: {name: host}}]}\n"
    )
    assert main(["record", str(folder), "--quiet"]) == 0
    return folder


def test_a_record_is_one_mission_in_the_order_of_arrival(robot: Path) -> None:
    with open_record(robot) as record:
        (mission,) = missions_of(record)
        rows = list(mission)
        assert {row.item for row in rows} == {"sim_battery", "sim_localisation", "sim_host"}
        assert [row.at_ns for row in rows] == sorted(row.at_ns for row in rows)
        assert mission.span[0] == rows[0].at_ns and mission.span[1] == rows[-1].at_ns + 1
        battery = next(row for row in rows if row.item == "sim_battery")
        assert battery.values["voltage"] == pytest.approx(28, abs=2)
        assert not [name for name in battery.values if "stamp" in name]
        assert 0 <= battery.at_ns - battery.stamp_ns < 10**9
        (first,), (second,) = shared_out([mission])
        assert [*first, *second] == rows
        assert first.span[1] - first.span[0] == pytest.approx(36e9, rel=0.05)


def test_learn_writes_a_model_and_says_what_it_cannot_promise(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "r1.model"
    assert main(["learn", str(robot), "-o", str(file)]) == 0
    out = capsys.readouterr().out
    assert f"of {robot.name}" in out and "asked for 1 false alarm per hour" in out
    assert "no rate below" in out and "calibrate on more nominal missions, 1.0 h or more" in out
    model = load_model(file)
    assert {*model.detectors} == {"event_timing", "guard"}
    assert model.origin["missions"] == [robot.name]
    with open_record(robot) as record:
        (mission,) = missions_of(record)
        assert len(model.detectors["guard"].score(mission)) > 1000


def test_the_monitors_pass_the_check_and_are_ok_on_what_was_learnt(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["learn", str(robot), "--monitors", str(robot), "--json"]) == 0
    written = json.loads(capsys.readouterr().out)["files"]
    assert "components/sim_battery/range_voltage.yaml" in written
    assert "components/sim_localisation/topics.yaml" in written
    assert all((robot / name).is_file() for name in written)
    assert main(["check", str(robot)]) == 0
    assert "note" not in capsys.readouterr().out
    assert main(["watch", str(robot), "--replay", "--json"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    levels = {line["level"] for line in lines if "level" in line}
    assert "ok" in levels
    assert not levels & {"warn", "error"}
    assert main(["learn", str(robot), "--monitors", str(robot)]) == 2
    assert "has components already" in capsys.readouterr().err


def test_mistakes_are_explained(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["-o", str(tmp_path / "x.model")]
    for arguments, status, text in (
        ([str(robot)], 2, "nothing to write"),
        ([str(robot), "--missions", "lunch", *out], 2, "no mission 'lunch'"),
        ([str(robot), "--detectors", "gard", *out], 2, "did you mean 'guard'"),
        ([str(robot), "--false-alarms", "0", *out], 2, "a number above 0"),
        ([str(robot), "-o", str(tmp_path / "no" / "x.model")], 2, "cannot write"),
    ):
        assert main(["learn", *arguments]) == status
        shown = capsys.readouterr().err
        assert text in shown and "Traceback" not in shown


def test_detectors_of_the_options_are_learnt_and_score_what_was_recorded(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options, file = tmp_path / "detectors.yaml", tmp_path / "r1.model"
    options.write_text(OPTIONS)
    assert main(["learn", str(robot), "-o", str(file), "--options", str(options)]) == 0
    assert "redundant: calibrated on" in capsys.readouterr().out
    model = load_model(file)
    assert {"residual", "state_flow", "bank", "redundant"} < {*model.detectors}
    with open_record(robot) as record:
        (mission,) = missions_of(record)
        for name in ("residual", "state_flow", "bank", "redundant"):
            assert len(model.detectors[name].score(mission)) > 20, name


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("residual: {lag: 2}\n", "detectors.yaml:1: residual: unknown key 'lag'"),
        ("residuals: {}\n", "detectors.yaml:1: residuals: no detector; did you mean 'residual'?"),
        ("bank: {sensors: [a.b]}\n", "detectors.yaml:1: bank: give 'models' or 'factory'"),
        ("- residual\n", "expected a mapping by detector, got a list"),
    ],
)
def test_a_mistake_in_the_options_is_told_with_its_line(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, what: str
) -> None:
    options = tmp_path / "detectors.yaml"
    options.write_text(text)
    assert main(["learn", str(robot), "-o", "x.model", "--options", str(options)]) == 2
    assert what in capsys.readouterr().err


@pytest.mark.parametrize("name", ["bank", "redundant"])
def test_a_detector_that_needs_options_says_so(
    robot: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert main(["learn", str(robot), "-o", "x.model", "--detectors", name]) == 2
    assert f"the detector '{name}' needs options" in capsys.readouterr().err
