"""``amberbox structure --residuals``: the example of the page, over a record."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.equations.model_file import load_model
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

PAGE = Path(__file__).parents[2] / "docs" / "robot" / "structure.md"
WHEEL = FakeItem("wheel", [{"rate": 1.5}])
ODOMETRY = FakeItem("odom", [{"speed": 1.5}])
IMU = FakeItem("imu", [{"ax": 1.5}])


def drive(store: Path, scale: float) -> Path:
    """Write a minute; in its second half odometry has a scale."""
    run = FakeRun(store, items=[WHEEL, ODOMETRY, IMU])
    run.start(T0_NS - 1)
    made: list[tuple[int, FakeItem, Any]] = []
    chance = np.random.default_rng(5)
    for at_s in np.arange(0, 60, 0.04).tolist():
        speed, noise = math.sin(0.5 * at_s), (0.01 * chance.standard_normal(3)).tolist()
        at_ns = T0_NS + round(at_s * NS)
        wrong = scale if at_s > 30 else 1.0
        made.append((at_ns, WHEEL, {"rate": 10 * speed + noise[0]}))
        made.append((at_ns + 1000, ODOMETRY, {"speed": wrong * speed + noise[1]}))
        made.append((at_ns + 2000, IMU, {"ax": 0.5 * math.cos(0.5 * at_s) + noise[2]}))
    run.write(made)
    run.close()
    return store


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(drive(tmp_path_factory.mktemp("nominal") / "store", 1.0))


@pytest.fixture(scope="module")
def scaled(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(drive(tmp_path_factory.mktemp("scaled") / "store", 1.3))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    (text,) = (t for t in re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.S) if "per:" in t)
    path = tmp_path / "base.yaml"
    path.write_text(f"# a comment\n{text}")
    return path


def test_violations_are_named(
    model: Path, nominal: str, scaled: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["structure", str(model), "--residuals", nominal]) == 0
    out = capsys.readouterr().out
    assert "  wheel: speed = 0.1 * encoder" in out and "  odometer: odometer - speed is 0" in out
    assert "  turning: acceleration = derivative of speed over 0.4 s" in out
    assert "sensitive to: wheel, odometry, encoder_slips, wrong_scale" in out
    assert "delay 0.2 s, threshold none yet" in out and "violations: 0" in out
    assert main(["structure", str(model), "--residuals", scaled, "--json"]) == 1
    scale, late, push = json.loads(capsys.readouterr().out)["residuals"]
    assert scale["violations"] == 1 and scale["listed"][0]["size"] == pytest.approx(0.3, abs=0.01)
    assert scale["delay_s"] == 0 and late["delay_s"] == push["delay_s"] == pytest.approx(0.2)
    assert late["violations"] == push["violations"] == 0
    assert scale["computes"] == [{"variable": "speed", "equation": "wheel"}]


def test_thresholds_are_learnt_and_written(
    model: Path, nominal: str, scaled: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = model.read_text()
    learn = ["structure", str(model), "--residuals", nominal, "--learn"]
    assert main([*learn, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert model.read_text() == before and "+++ base.yaml" in found["diff"]
    assert main([*learn, "--apply", "--margin", "2"]) == 0
    assert "# a comment" in model.read_text()
    residuals = load_model(model).residuals
    for one in found["residuals"]:
        threshold = residuals[one["name"]].threshold
        assert threshold == pytest.approx(2 * one["largest"], rel=0.02)
        assert one["learnt"] == pytest.approx(1.5 * one["largest"], rel=0.02)
    assert main(["structure", str(model), "--residuals", nominal]) == 0
    assert main(["structure", str(model), "--residuals", nominal, scaled]) == 1
    assert main([*learn, "--apply", "--margin", "2"]) == 0  # the same again changes nothing
    assert load_model(model).residuals == residuals


def test_without_residuals_each_minimal_set_is_tried(
    model: Path, nominal: str, scaled: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = model.read_text()
    model.write_text(text[: text.index("residuals:")].replace("window_s: 0.4", "window_s: 0"))
    assert main(["structure", str(model), "--residuals", nominal, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["equations"] for one in found["residuals"]] == [["wheel", "odometer"]]
    assert len(found["refused"]) == 2
    assert all("nothing computes 'acceleration'" in why for why in found["refused"].values())
    assert main(["structure", str(model), "--residuals", nominal, "--learn", "--apply"]) == 0
    assert list(load_model(model).residuals) == ["r1"]
    assert main(["structure", str(model), "--residuals", scaled]) == 1


def test_what_is_not_recorded_is_said(
    model: Path, nominal: str, capsys: pytest.CaptureFixture[str]
) -> None:
    model.write_text(model.read_text().replace("imu.ax", "imu.ay").replace("odom.", "odo."))
    assert main(["structure", str(model), "--residuals", nominal]) == 0
    out = capsys.readouterr().out
    assert "not recorded: odo.speed" in out and "not recorded: imu.ay" in out


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--learn"], "belong to --residuals"),
        (["--residuals", "R", "--apply"], "--apply belongs to --learn"),
        (["--residuals", "R", "--learn", "--quantile", "2"], "--quantile must lie"),
        (["--residuals", "R", "--learn", "--margin", "0.5"], "--margin must be"),
        (["--residuals", "R", "--missions", "none"], "there is no mission 'none'"),
        (["--residuals", "nowhere"], "nowhere"),
    ],
)
def test_wrong_usage(
    model: Path,
    nominal: str,
    words: list[str],
    wanted: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [nominal if word == "R" else word for word in words]
    assert main(["structure", str(model), *words]) == 2
    assert wanted in capsys.readouterr().err
