"""The verb structure."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main

WHEEL = """\
kind: equations
unknowns: [torque, speed, acceleration, current]
known: [encoder, ammeter, voltage]
equations:
  motor:   {variables: [torque, current], faults: [weak]}
  winding: {variables: [voltage, current, speed]}
  wheel:   {variables: [torque, acceleration], faults: [drags]}
  turning: {state: speed, derivative: acceleration}
  encoder: {variables: [encoder, speed], faults: [encoder]}
  ammeter: {variables: [ammeter, current], faults: [ammeter]}
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "wheel.yaml"
    path.write_text(WHEEL)
    return path


def test_which_faults_can_be_told_apart(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["structure", str(model)]) == 0
    assert capsys.readouterr().out.splitlines()[2:] == [
        "weak     yes         drags",
        "drags    yes         weak",
        "encoder  yes         none",
        "ammeter  yes         none",
    ]
    assert main(["structure", str(model), "--json", "--isolability", "der"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["redundancy"] == 2
    assert found["not_told_from"]["weak"] == ["weak", "drags"]


def test_sets(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["structure", str(model), "--mso", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["count"] == 4 and not made["incomplete"]
    assert made["mso"][0] == ["ammeter", "encoder", "winding"]
    assert main(["structure", str(model), "--mtes"]) == 0
    assert "ammeter, encoder, winding" in capsys.readouterr().out
    assert main(["structure", str(model), "--sensors", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sensor_sets"] == [["torque"]]
    chosen = ["--sensors", "--measurable", "current", "speed"]
    assert main(["structure", str(model), *chosen]) == 0
    assert "none: nothing needs to be added" in capsys.readouterr().out


def test_a_search_that_is_ended_says_so(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for what in ("--mtes", "--sensors", "--mso"):
        assert main(["structure", str(model), what, "--seconds", "0"]) == 1
    assert "incomplete: time was up after 0 sets; --seconds allows more" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[torque, current]", "[torque, curent]", "wheel.yaml:5: equations.motor: there is no "
         "variable 'curent'; did you mean 'current'?"),
        ("[drags]", "[weak]", "equations.wheel: has the fault 'weak', as 'motor' has"),
        ("{state: speed, derivative: acceleration}", "{state: speed}", "is no equation of a"),
        ("state: speed", "state: encoder", "is the derivative of a known variable"),
        ("[encoder, speed]", "[]", "equations.encoder: has no variables"),
        ("known: [", "known: [torque, ", "known: 'torque' is listed twice"),
        ("unknowns", "unknown", "did you mean 'unknowns'?"),
        ("kind: equations", "kind: components", "kind"),
    ],
)  # fmt: skip
def test_mistakes_are_said_by_their_place(
    model: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    model.write_text(WHEEL.replace(old, new))
    assert main(["structure", str(model)]) == 2
    assert said in capsys.readouterr().err


def test_options_that_do_not_fit(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["structure", str(model), "--measurable", "speed"]) == 2
    assert main(["structure", str(model), "--seconds", "nan"]) == 2
    assert main(["structure", str(model), "--sensors", "--measurable", "sped"]) == 2
    assert "there is no unknown 'sped'; did you mean 'speed'?" in capsys.readouterr().err
