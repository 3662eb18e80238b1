"""Sizes from a record, on the command line: the watcher's answer is that of diagnose afterwards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.cli.main import main
from tests.cli.diagnosed import Bench, write_folder

FMEA = """\
defaults: {within_s: 1, hold_s: 1, exclusive: true}
symptoms:
  motor/temperature/cool: {edges: [10, 40]}
types:
  motor:
    description: the motor
    failure_modes:
      hot:
        description: the motor is too hot
        probability: 1.0e-2
        symptoms: [{symptom: motor/temperature/cool, size: {uniform: [0, 30]}}]
        leads_to: {fan#stuck: {p: 0.3, after_s: [0, 30]}}
      sensor:
        description: the motor's temperature is sent in Fahrenheit
        probability: 1.0e-3
        symptoms: [{symptom: motor/temperature/cool, size: {normal: [80, 20]}}]
  fan:
    description: the fan
    failure_modes:
      stuck: {description: the fan is stuck, probability: 1.0e-5, symptoms: [fan/speed/turns]}
"""


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    folder = write_folder(tmp_path / "robot")
    (folder / "fmea.yaml").write_text(FMEA)
    return Bench(folder)


def answer(capsys: pytest.CaptureFixture[str], folder: Path) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["diagnose", str(folder), "--json"]) == 1
    made: dict[str, Any] = json.loads(capsys.readouterr().out)
    return made


def shares(made: dict[str, Any]) -> list[tuple[list[str], float]]:
    return [(one["faults"], one["probability"]) for one in made["hypotheses"]]


@pytest.mark.parametrize(("temperature", "cause"), [(95.0, "motor#hot"), (176.0, "motor#sensor")])
def test_live_and_afterwards_the_size_decides(
    bench: Bench, capsys: pytest.CaptureFixture[str], temperature: float, cause: str
) -> None:
    with bench.watched():
        bench.run(3)
        bench.run(4, temperature=temperature)
    live = answer(capsys, bench.folder)
    assert live["hypotheses"][0]["faults"] == [cause]
    (symptom,) = [one for one in live["symptoms"] if one["id"] == "motor/temperature/cool"]
    assert symptom["size"] == temperature - 80
    bench.box.close()
    other = Bench(write_folder(bench.folder.parent / "unwatched"))
    (other.folder / "fmea.yaml").write_text(FMEA)
    other.run(3)
    other.run(4, temperature=temperature)
    other.box.close()
    replayed = answer(capsys, other.folder)
    shares = [
        [(h["faults"], h["probability"]) for h in of["hypotheses"]] for of in (live, replayed)
    ]
    assert shares[0] == shares[1]


def test_what_follows_is_said(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.run(3)
    bench.run(3, temperature=95)
    bench.run(3, temperature=95, speed=0)
    bench.box.close()
    made = answer(capsys, bench.folder)
    assert made["hypotheses"][0]["follows"] == ["fan#stuck"]
    assert "and from it" in made["explanation"]["headline"] + json.dumps(made["explanation"])
