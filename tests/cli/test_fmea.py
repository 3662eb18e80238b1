"""The verb fmea: check, table, criticality, coverage; sheets in and out."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.cli.main import main
from tests.diagnosis.fmea.small import TEXT


def printed(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> Any:
    assert main(["fmea", *arguments, "--json"]) == status
    return json.loads(capsys.readouterr().out)


def test_a_new_robot_folder_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "robot")
    assert main(["new", folder]) == 0
    capsys.readouterr()
    report = printed(capsys, "check", folder)
    assert report["ok"] and report["problems"] == []
    assert report["written_once"] >= 60 and report["system_functions"] >= 6
    assert main(["fmea", "check", folder]) == 0
    assert "fine: 26 components" in capsys.readouterr().out


def test_symptoms_are_compared_with_the_monitors_of_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "robot"
    main(["new", str(folder)])
    path = folder / "fmea.yaml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("{symptom: battery/cells/even,", "{symptom: battery/cells/evn,"))
    capsys.readouterr()
    assert main(["fmea", "check", str(folder)]) == 2
    out = capsys.readouterr().out
    assert "did you mean 'battery/cells/even'?" in out and out.endswith("1 error\n")
    assert main(["fmea", "table", str(folder)]) == 2
    assert "there is no symptom 'battery/cells/evn'" in capsys.readouterr().err


def test_a_file_alone_is_checked_too(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmea", "check", str(small)]) == 0
    text = capsys.readouterr()
    assert "fine: 4 components, 10 failure modes (6 written once)" in text.out
    assert "symptoms are not compared with monitors" in text.err


def test_the_table_shows_the_highest_number_first(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = printed(capsys, "table", str(small))
    numbers = [int(row["RPN"] or 0) for row in rows]
    assert numbers == sorted(numbers, reverse=True) and len(rows) == 10
    assert main(["fmea", "table", str(small)]) == 0
    assert "failure mode" in capsys.readouterr().out


def test_priorities_of_the_user_are_shown(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "priorities.csv"
    table.write_text("S,O,D,priority\n8,,,act now\n,,,later\n", encoding="utf-8")
    rows = printed(capsys, "table", str(small), "--priorities", str(table))
    assert {row["Priority"] for row in rows if row["S"] == "8"} == {"act now"}
    modes = printed(capsys, "criticality", str(small), "--priorities", str(table))["modes"]
    assert {mode["priority"] for mode in modes} == {"act now", "later"}
    assert main(["fmea", "criticality", str(small), "--priorities", str(table)]) == 0
    assert "act now" in capsys.readouterr().out
    table.write_text("S,O\n", encoding="utf-8")
    assert main(["fmea", "table", str(small), "--priorities", str(table)]) == 2


def test_criticality_by_component_mode_and_cell(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = printed(capsys, "criticality", str(small), "--exposure", "200")
    values = {mode["mode"]: mode["C_m"] for mode in report["modes"]}
    assert values["laser_front#dead"] == pytest.approx(0.02)
    sums = {entry["component"]: entry["C_r"] for entry in report["components"]}
    own = [value for mode, value in values.items() if mode.startswith("laser_front#")]
    assert sums["laser_front"] == pytest.approx(sum(own))
    assert sum(len(cell["modes"]) for cell in report["matrix"]) == 10
    assert main(["fmea", "criticality", str(small)]) == 0
    assert "A frequent" in capsys.readouterr().out
    assert main(["fmea", "criticality", str(small), "--exposure", "-1"]) == 2


def test_coverage_says_what_looks_the_same(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = printed(capsys, "coverage", str(small))
    assert report["modes"] == 10 and len(report["alike"]) == 2
    assert main(["fmea", "coverage", str(small)]) == 0
    out = capsys.readouterr().out
    assert "laser_front#dirty, laser_front#wet: told apart by laser_front.look" in out


def test_a_sheet_goes_out_and_comes_in(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small.write_text(TEXT.replace("symptoms: [hot]", "unobservable: far away"), encoding="utf-8")
    assert main(["fmea", "table", str(small), "--csv", "-"]) == 0
    text = capsys.readouterr().out
    sheet = tmp_path / "sheet.csv"
    assert main(["fmea", "table", str(small), "--csv", str(sheet)]) == 0
    assert sheet.read_text(encoding="utf-8") == text
    assert len(list(csv.DictReader(io.StringIO(text)))) == 10
    other = tmp_path / "other"
    other.mkdir()
    capsys.readouterr()
    report = printed(capsys, "check", str(other), "--import", str(sheet))
    assert report["ok"] and report["failure_modes"] == 10
    assert main(["fmea", "check", str(other), "--import", str(sheet)]) == 2
    assert "nothing was written" in capsys.readouterr().err


def test_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmea", "chekc", str(tmp_path)]) == 2
    assert "did you mean 'check'?" in capsys.readouterr().err
    assert main(["fmea", "check", str(tmp_path)]) == 2
    assert "there is no" in capsys.readouterr().err
    bad = tmp_path / "bad.csv"
    bad.write_text("x,y\n", encoding="utf-8")
    assert main(["fmea", "check", str(tmp_path), "--import", str(bad)]) == 2
    assert not (tmp_path / "fmea.yaml").exists()
