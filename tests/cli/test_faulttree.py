"""The verb faulttree."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.diagnosis.faulttree.analysis import analyse
from amberbox.diagnosis.faulttree.open_psa import read_mef, write_mef
from amberbox.diagnosis.faulttree.tree import all_of, any_of, at_least, fault_tree, none_of
from benchmarks.fault_tree_plants import PlantShape, plant

GATES = {
    "stranded": any_of("no_drive", "power"),
    "no_drive": at_least(2, "left", "right", "rear"),
}
CHANCES = {"power": 0.001, "left": 0.1, "right": 0.1, "rear": 0.2}
TREE = fault_tree("robot", "stranded", GATES, CHANCES)
DRIVE = 0.1 * 0.1 * 0.8 + 2 * 0.1 * 0.9 * 0.2 + 0.1 * 0.1 * 0.2
EXACT = 1 - (1 - 0.001) * (1 - DRIVE)


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "tree.xml"
    path.write_text(write_mef(TREE), encoding="utf-8")
    return str(path)


def test_json_has_all_numbers(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faulttree", file, "--json", "--importance", "--cut-sets", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["minimal_cut_sets"] == 4 and found["by_order"] == [0, 1, 3]
    assert found["top_probability"] == pytest.approx(EXACT, rel=1e-12)
    assert found["rare_event_sum"] == pytest.approx(0.001 + 0.01 + 0.02 + 0.02)
    assert found["min_cut_upper_bound"] == pytest.approx(1 - 0.999 * 0.99 * 0.98**2)
    assert found["incomplete"] is False and found["truncated_at"] is None and found["coherent"]
    assert found["cut_sets"][0] == ["power"] and len(found["cut_sets"]) == 2
    power = found["importance"]["power"]
    assert power["mif"] == pytest.approx(1 - DRIVE)
    assert power["raw"] == pytest.approx(1 / EXACT)
    assert next(iter(found["importance"])) == "rear"


def test_text_names_what_is_exact_and_what_is_a_bound(
    file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faulttree", file, "--importance", "--cut-sets", "9"]) == 0
    text = capsys.readouterr().out
    assert "stranded: 2 gates, 4 basic events" in text
    assert f"probability: {EXACT:.10g} (exact)" in text
    assert "rare-event sum: 0.051 (an upper bound)" in text
    assert "minimal cut sets: 4\n  order 1: 1\n  order 2: 3\n  {power}" in text
    assert "{left, right}" in text and "MIF" in text


def test_an_order_limit_is_said(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faulttree", file, "--order", "1"]) == 0
    text = capsys.readouterr().out
    assert "minimal cut sets: 1, up to order 1: larger ones are not counted" in text
    assert "rare-event sum: 0.001 (of these cut sets only)" in text


def test_no_number_of_json_is_infinite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "all.xml"
    chances = {"a": 0.5, "b": 0.0}
    path.write_text(write_mef(fault_tree("t", "top", {"top": all_of("a", "b")}, chances)))
    assert main(["faulttree", str(path), "--importance", "--json"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["top_probability"] == 0.0
    assert found["importance"]["b"] == {
        "mif": 0.5, "cif": None, "dif": None, "raw": None, "rrw": None,
    }  # fmt: skip


def test_a_budget_that_ends_is_said_and_is_no_success(
    file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faulttree", file, "--nodes", "3", "--json"]) == 1
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["incomplete"] is True and found["minimal_cut_sets"] is None
    assert "more than" in found["incomplete_because"]
    assert "incomplete" in captured.err and "--nodes" in captured.err


def test_an_incoherent_tree_and_events_without_probability_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "not.xml"
    tree = fault_tree("t", "top", {"top": all_of("a", none_of("b"))}, {"a": 0.5, "b": None})
    path.write_text(write_mef(tree))
    assert main(["faulttree", str(path)]) == 0
    text = capsys.readouterr().out
    assert "not coherent" in text and "probability: none; without one: b, 1 in all" in text


def test_one_gate_of_many_and_export(
    file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.xml"
    arguments = ["faulttree", file, "--effect", "no_drive", "--export", str(out), "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["by_order"] == [0, 0, 3]
    assert read_mef(out, "stranded") == TREE


@pytest.mark.parametrize(
    ("more", "what"),
    [
        (["--order", "-1"], "--order must be 0 or more"),
        (["--cut-sets", "0"], "--cut-sets must be 1 or more"),
        (["--most-probable", "0"], "--most-probable must be 1 or more"),
        (["--seconds", "nan"], "--seconds must be a number, 0 or more"),
        (["--effect", "strandet"], "did you mean 'stranded'"),
        (["--exposure", "3"], "a file has its own probabilities"),
        (["--closest"], "only of a robot folder"),
    ],
)
def test_wrong_usage(
    file: str, more: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faulttree", file, *more]) == 2
    assert what in capsys.readouterr().err


def test_a_file_that_is_wrong_is_refused_with_the_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.xml"
    path.write_text('<opsa-mef>\n<define-fault-tree name="t">\n<define-gate name="g"/>\n'
                    "</define-fault-tree>\n</opsa-mef>")  # fmt: skip
    assert main(["faulttree", str(path)]) == 2
    assert f"{path}:3: g: the gate has no input" in capsys.readouterr().err


def test_a_model_may_be_spread_over_files(
    tmp_path: Path, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = Path(file).read_text(encoding="utf-8")
    begin, end = whole.index("<model-data>"), whole.index("</model-data>") + len("</model-data>")
    gates, events = tmp_path / "gates.xml", tmp_path / "events.xml"
    gates.write_text(whole[:begin] + whole[end:], encoding="utf-8")
    events.write_text(f"<opsa-mef>{whole[begin:end]}</opsa-mef>", encoding="utf-8")
    assert main(["faulttree", str(gates), "--json", str(events)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["top_probability"] == pytest.approx(EXACT, rel=1e-12)
    assert found["files"] == [str(gates), str(events)]
    assert main(["faulttree", str(gates)]) == 2
    assert "amberbox faulttree A.xml B.xml" in capsys.readouterr().err
    assert main(["faulttree", str(tmp_path), str(events)]) == 2
    assert "several can be given of FILE.xml only" in capsys.readouterr().err


def test_the_most_probable_cut_sets_with_their_share(
    file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faulttree", file, "--json", "--most-probable", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    best = found["most_probable"]
    assert [entry["events"] for entry in best["cut_sets"]] in (
        [["left", "rear"], ["rear", "right"]], [["rear", "right"], ["left", "rear"]]
    )  # fmt: skip
    assert best["certain"] == 2 and found["probability_bounds"] == [found["top_probability"]] * 2
    both = 0.2 * (1 - 0.9 * 0.9)
    low, high = best["share"]
    assert low - 1e-12 <= both / EXACT <= high and high - low < 0.1
    assert main(["faulttree", file, "--most-probable", "1"]) == 0
    assert "most probable minimal cut sets: 1, " in capsys.readouterr().out


def test_a_tree_that_is_too_large_gets_bounds_and_its_best_cut_sets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = plant(PlantShape(12, 3, 2, 2, 8), 3)
    exact = analyse(tree).top_probability
    assert exact is not None
    path = tmp_path / "plant.xml"
    path.write_text(write_mef(tree), encoding="utf-8")
    few = ["faulttree", str(path), "--nodes", "8000", "--seconds", "600"]
    assert main([*few, "--json", "--cut-sets", "3"]) == 1
    found = json.loads(capsys.readouterr().out)
    low, high = found["probability_bounds"]
    assert low <= exact <= high < 1.2 * low
    assert found["top_probability"] is None and found["minimal_cut_sets"] is None
    best = found["most_probable"]
    assert len(best["cut_sets"]) == best["certain"] == 10 and best["share"][0] > 0.5
    assert found["incomplete"] is True and found["cut_sets"] == []
    assert main(few) == 1
    captured = capsys.readouterr()
    assert f"probability: between {low:.10g} and " in captured.out
    assert "most probable minimal cut sets: 10, " in captured.out
    assert "incomplete: probability and cut sets: more than" in captured.err
