"""Two levels: what a robot loses is a failure mode of its team."""

from __future__ import annotations

from pathlib import Path

from amberbox.diagnosis.fmea.loader import load_fmea
from amberbox.diagnosis.fmea.model import lost

TEAM = """\
types:
  staff_interface:
    failure_modes:
      down: {probability: 0.01, symptoms: [pages/http/answers]}
robots:
  ropod_001:
    where: ../ropod_001
    functions:
      carry: {probability: 0.02, severity: critical, symptoms: [ropod_001/state/works]}
  ropod_002:
    where: ../ropod_002/fmea.yaml
    functions:
      carry: {rate: 0.001, unobservable: it never says}
functions:
  carry_carts:
    needs: [staff_interface, {any: ["ropod_001:carry", "ropod_002:carry"]}]
    system: true
"""
ROBOT = """\
types: {hook: {failure_modes: {bent: {probability: 0.1, unobservable: x}}}}
functions: {carry: {needs: [hook], description: carry carts}}
"""


def team(folder: Path, text: str = TEAM) -> Path:
    (folder / "team").mkdir()
    (folder / "ropod_001").mkdir()
    (folder / "ropod_001/fmea.yaml").write_text(ROBOT, encoding="utf-8")
    (folder / "team/fmea.yaml").write_text(text, encoding="utf-8")
    return folder / "team/fmea.yaml"


def test_functions_of_robots_fail_one_level_up(tmp_path: Path) -> None:
    fmea, problems = load_fmea(team(tmp_path))
    assert fmea is not None
    assert [(p.line, p.is_error) for p in problems] == [(11, False)]
    assert "../ropod_002/fmea.yaml is not there yet" in problems[0].what
    first, second = "ropod_001:carry#lost", "ropod_002:carry#lost"
    assert fmea.modes[first].chance() == 0.02 and fmea.modes[second].rate == 0.001
    assert fmea.modes[first].effects.system == ("carry_carts",)
    assert "carry_carts" not in lost(fmea, [first])
    assert "carry_carts" in lost(fmea, [first, second])
    assert fmea.modes[first].description == "the robot ropod_001 cannot: carry carts"
    assert fmea.modes[second].description == "the robot ropod_002 cannot: carry"
    assert fmea.members == {name: str(tmp_path / name) for name in ("ropod_001", "ropod_002")}


def test_what_is_wrong_with_members_is_told(tmp_path: Path) -> None:
    text = TEAM.replace("      carry: {probability: 0.02", "      cary: {probability: 1.02")
    text = text.replace("rate: 0.001, unobservable: it never says", "severity: urgent")
    fmea, problems = load_fmea(team(tmp_path, text))
    assert fmea is None
    told = {(p.line, p.what) for p in problems if p.is_error}
    assert (9, "ropod_001 has no function 'cary'; did you mean 'carry'?") in told
    assert (9, "1.02 is above 1: expected a share from 0 to 1") in told
    assert (13, "how probable is it? give probability or rate") in told
    assert any("no component or function 'ropod_001:carry'" in what for _, what in told)
