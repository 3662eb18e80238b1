"""``amberbox evaluate``: the simulated robot with a planted fault, against labels."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.detection.model_file import load_model

SIM = """\
- sim:
    {{seed: {seed}, speed: max, duration_s: {seconds}, topics: [{{topic: {{name: battery}}}}],
     faults: [{faults}]}}
"""


def recorded(path: Path, seconds: int, faults: str = "") -> str:
    path.mkdir()
    (path / "robot.yaml").write_text("id: r1\nstore: {path: store}\n")
    (path / "black_box.yaml").write_text(SIM.format(seed=3, seconds=seconds, faults=faults))
    assert main(["record", str(path), "--quiet"]) == 0
    return str(path)


def test_a_planted_fault_is_found_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, labels = str(tmp_path / "r1.model"), tmp_path / "labels.yaml"
    nominal = recorded(tmp_path / "nominal", 120)
    tested = recorded(tmp_path / "r1", 100, "{id: battery_overheats, at_s: 60}")
    assert main(["learn", nominal, "-o", model, "--false-alarms", "60"]) == 0
    labels.write_text("- {from: 2026-01-05T08:01:00Z, to: 2026-01-05T08:02:00Z, source: sim}\n")
    capsys.readouterr()
    assert main(["evaluate", model, tested, "--labels", str(labels), "--json"]) == 0
    rows = {row["detector"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert rows["guard"]["recall"] == 1 and rows["guard"]["isolated"] == 1
    assert rows["guard"]["delay_median_s"] < 20
    assert rows["guard"]["f1"] > rows["always-on alarm"]["f1"]
    assert main(["evaluate", model, tested, "--labels", str(labels)]) == 0
    shown = capsys.readouterr().out
    assert "random score" in shown and "no rate of false alarms below" in shown
    assert load_model(Path(model)).detectors["guard"].detects == 0.5  # nobody has evaluated it
    assert main(["evaluate", model, tested, "--labels", str(labels), "--keep"]) == 0
    kept = load_model(Path(model)).detectors["guard"]
    assert kept.found == (1, 1) and kept.detects == pytest.approx(2 / 3)
    page, image = tmp_path / "plot.html", tmp_path / "plot.png"
    for file in (page, image):
        assert main(["evaluate", model, tested, "--labels", str(labels), "--plot", str(file)]) == 0
    assert image.read_bytes().startswith(b"\x89PNG")
    text = page.read_text()
    assert text.count("<svg") == 3 and "scores of guard" in text and "http://www.w3" in text
    assert text.count('class="fault"') == 3 and 'class="alarm"' in text
    assert "guard.range.sim_battery.temperature" in text and "always-on alarm" in text
    assert "<script" not in text and 'src="' not in text
    wrong = ["evaluate", model, tested, "--labels", str(labels), "--plot", "plot.doc"]
    assert main(wrong) == 2
    labels.write_text("- {from: noon}\n")
    assert main(["evaluate", model, tested, "--labels", str(labels)]) == 2
    assert f"{labels}:1: from: not a time" in capsys.readouterr().err
    assert main(["evaluate", model, tested, "--labels", str(labels), "--tail", "-3"]) == 2
