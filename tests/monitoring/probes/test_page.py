"""The examples of ``docs/robot/probes.md`` work: its own probe, its block for the box."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.monitoring.probe_runner import load_probe

PAGE = (Path(__file__).parents[3] / "docs" / "robot" / "probes.md").read_text(encoding="utf-8")


def example(language: str) -> str:
    found = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.M | re.S)
    assert len(found) == 1
    return str(found[0])


def test_the_probe_of_the_page_runs_from_a_robots_folder(tmp_path: Path) -> None:
    code, inputs = example("python"), tmp_path / "gpio"
    (inputs / "di3").mkdir(parents=True)
    (tmp_path / "probes").mkdir()
    written = code.replace("/sys/class/gpio", str(inputs))
    assert written != code
    (tmp_path / "probes" / "emergency_stop.py").write_text(written)
    probe = load_probe("emergency_stop", [tmp_path / "probes"])
    (inputs / "di3" / "value").write_text("1\n")
    assert probe.measure_once("di3") == {"subject": "di3", "ok": True, "error": "", "raw": 1}
    assert probe.period_s == 0.5
    unknown = probe.measure_once("di4")
    assert (unknown["ok"], unknown["raw"]) == (None, None)
    assert "No such file" in unknown["error"]


def test_the_block_of_the_page_is_called_probe(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: cart\n")
    (tmp_path / "black_box.yaml").write_text(example("yaml"))
    folder = load_folder(tmp_path)
    assert [(block.plugin, block.name) for block in folder.blocks] == [("zmq", "probe")]
    assert list(folder.notes) == []


@pytest.mark.parametrize("option", ["--once", "--list", "--publish", "--json", "--probe"])
def test_every_option_is_described(option: str) -> None:
    assert option in PAGE
