"""FMEA sheets as CSV: out, in again, and as others write them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from amberbox.core.errors import Problem
from amberbox.diagnosis.fmea.criticality import mode_criticality
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.fmea.sheet import COLUMNS, read_sheet, write_sheet
from tests.diagnosis.fmea.small import small


def from_sheet(path: Path, text: str) -> tuple[Fmea | None, list[Problem]]:
    path.write_text(text, encoding="utf-8")
    problems: list[Problem] = []
    made = read_sheet(path, problems)
    fmea, more = read_fmea(made) if made else (None, [])
    return fmea, problems + more


def rows(text: str) -> dict[str, dict[str, str]]:
    found = csv.DictReader(io.StringIO(text))
    return {f"{row['Item']}#{row['Failure mode']}": row for row in found}


def test_a_sheet_has_the_usual_columns() -> None:
    row = rows(write_sheet(small()))["laser_front#dead"]
    assert tuple(row) == COLUMNS
    assert (row["S"], row["O"], row["D"], row["RPN"]) == ("8", "5", "3", "120")
    assert row["Function"] == "see" and row["End effect"] == "see; carry"
    assert row["Detection"] == "laser_front/heartbeat/alive" and row["Cm"] == "0.01"


def test_out_and_in_again_gives_the_same_sheet(tmp_path: Path) -> None:
    text = write_sheet(small("[hot]", "[host/heartbeat/alive]"))
    fmea, problems = from_sheet(tmp_path / "sheet.csv", text)
    assert fmea is not None and not [problem for problem in problems if problem.is_error]
    kept = [name for name in COLUMNS if name not in ("Function", "Next effect", "End effect")]
    before, after = rows(text), rows(write_sheet(fmea))
    assert list(before) == list(after)
    for mode, row in before.items():
        assert {name: after[mode][name] for name in kept} == {name: row[name] for name in kept}


def test_a_sheet_of_others_is_read(tmp_path: Path) -> None:
    text = (
        "Item / Function;Item/Function;Potential Failure Mode;Potential Effect(s);Sev;"
        "Potential Cause(s);Occ;Current Controls;Det;RPN;Recommended Action(s)\n"
        ";Left Pump;does not start;no coolant;8;fuse;4;pump/flow/moves;3;96;'=fit a fuse\n"
        ";Left Pump;leaks;puddle;4;seal;5;look every week;7;140;replace seal\n"
    )
    fmea, problems = from_sheet(tmp_path / "sheet.csv", text)
    assert fmea is not None
    assert [str(p.where) for p in problems] == ["columns", "O"]
    mode = fmea.modes["left_pump#does_not_start"]
    assert mode.ranks.number == 96 and mode.rate == pytest.approx(1e-7)
    assert mode.description == "does not start" and mode.remedy == "=fit a fuse"
    assert mode.symptoms[0].symptom == "pump/flow/moves" and mode.effects.local == "no coolant"
    assert fmea.modes["left_pump#leaks"].unobservable == "look every week"


def test_ranks_under_the_words_that_many_sheets_have(tmp_path: Path) -> None:
    text = "Item,Failure Mode,Severity,Occurrence,Detection,RPN\npump,leaks,8,3,5,120\n"
    fmea, problems = from_sheet(tmp_path / "a.csv", text)
    assert fmea is not None
    ranks = fmea.modes["pump#leaks"].ranks
    assert (ranks.severity, ranks.occurrence, ranks.detection) == (8, 3, 5)
    assert not [problem for problem in problems if problem.is_error]


def test_a_criticality_sheet_with_ratios_of_the_components_rate(tmp_path: Path) -> None:
    text = (
        "Item,Failure mode,Mode ratio,Failure rate,Effect probability,Operating time (h)\n"
        "pump,leaks,0.3,1e-4,0.5,100\npump,seized,0.7,1e-4,1,100\n"
    )
    fmea, _ = from_sheet(tmp_path / "a.csv", text)
    assert fmea is not None
    of = {mode.name: mode_criticality(mode) for mode in fmea.modes.values()}
    assert of == pytest.approx({"leaks": 0.5 * 0.3 * 1e-4 * 100, "seized": 0.7 * 1e-4 * 100})


def test_a_text_that_looks_like_a_formula_is_kept_from_spreadsheets() -> None:
    fmea = small("    description: the <side> laser\n", "    description: =1+1\n")
    assert "'=1+1" in write_sheet(fmea)


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("Part,Failure mode,O\n,breaks,3\n", 2, "a line needs an item and a failure mode"),
        ("Part,Failure mode,O\na,breaks,3\na,breaks,4\n", 3, "a has 'breaks' twice"),
        ("Part,Failure mode,O\na,breaks,often\n", 2, "'often' is no number"),
        ("Part,Failure mode,O\na,breaks,nan\n", 2, "'nan' is no number"),
        ("Part,Failure mode,O\na,breaks,2.5\n", 2, "2.5 is no whole number"),
        ("Part,Failure mode,Rate,Alpha\na,breaks,1e-4,3\n", 2, "3 is no share from 0 to 1"),
        ("Part,Failure mode,O\na,breaks,\n", 2, "how probable is it?"),
        ("Part,Failure mode,O,Severity\na,b,3,bad\n", 2, "'bad' is none of warning"),
        ("Part,O\na,3\n", 1, "the first line must name at least the columns Item"),
        ("", 1, "the first line must name at least the columns Item"),
    ],
)
def test_wrong_sheets_are_told_with_their_line(
    tmp_path: Path, text: str, line: int, what: str
) -> None:
    _, problems = from_sheet(tmp_path / "sheet.csv", text)
    told = [(problem.line, problem.what) for problem in problems if problem.is_error]
    assert any(what in said and at == line for at, said in told), told


def test_end_effects_become_functions_that_need_every_component(tmp_path: Path) -> None:
    text = "Item,Failure mode,O,End effect\na,x,3,No motion\nb,y,3,No motion\n"
    fmea, problems = from_sheet(tmp_path / "sheet.csv", text)
    assert fmea is not None and not [problem for problem in problems if problem.is_error]
    function = fmea.functions["no_motion"]
    assert str(function.needs) == "a and b" and function.system
