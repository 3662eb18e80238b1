"""The verb faulttree with trees that are compiled from failure modes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.cli.main import main
from amberbox.diagnosis.faulttree.analysis import analyse
from amberbox.diagnosis.faulttree.open_psa import read_mef
from tests.cli.diagnosed import FMEA, Bench, write_folder
from tests.diagnosis.fmea.small import TEXT

PAGE = Path(__file__).resolve().parents[2] / "docs" / "robot" / "faulttrees.md"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "ropod_001"
    assert main(["new", str(path)]) == 0
    return path


def printed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    """Run the verb and return its object."""
    capsys.readouterr()
    assert main(["faulttree", *map(str, arguments), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run the verb with wrong arguments, and return the error message."""
    capsys.readouterr()
    assert main(["faulttree", *map(str, arguments)]) == 2
    return capsys.readouterr().err


def test_the_simulated_robot_has_trees_with_redundancy(
    simulated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = printed(capsys, simulated)
    redundant = [e["effect"] for e in found["effects"] if any(e["by_order"][2:])]
    alone = [e["effect"] for e in found["effects"] if not any(e["by_order"][:2])]
    assert len(redundant) >= 6 and len(alone) >= 5
    assert all(0.0 < effect["top_probability"] < 0.05 for effect in found["effects"])
    assert found["incomplete"] is False and found["exposure_h"] == 24


def test_the_page_shows_what_is_printed(
    simulated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = PAGE.read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["faulttree", str(simulated)]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    shown = {" ".join(line.split()) for line in page.splitlines()}
    assert len(lines) == 12 and set(lines[2:]) <= shown


def test_a_table_of_all_effects(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faulttree", str(small)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[2][:1] + rows[2][2:8] == ["see", "2", "1:", "1,", "2:", "1", "1"]
    assert rows[3][0] == "carry" and rows[3][2] == "3"


def test_all_effects_with_details(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faulttree", str(small), "--importance", "--cut-sets", "1"]) == 0
    text = capsys.readouterr().out
    assert "see: 4 gates, 3 basic events\n" in text and "\n\ncarry: 6 gates" in text
    assert text.count("MIF") == 2 and text.count("\n  {") == 2
    found = printed(capsys, small, "--importance", "--cut-sets", "9")
    see, carry = found["effects"]
    assert see["cut_sets"] == [["host#off"], ["laser_front#dead", "laser_rear#dead"]]
    assert carry["importance"]["hook#bent"]["raw"] > 20
    assert carry["severity"] == "urgent"


def test_one_effect_is_like_a_tree_of_a_file(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "see.xml"
    one = printed(capsys, small, "--effect", "see", "--export", out)
    assert one["by_order"] == [0, 1, 1] and one["minimal_cut_sets"] == 2
    assert one["incomplete"] is False and one["importance"] is None
    assert analyse(read_mef(out)).top_probability == one["top_probability"]
    short = printed(capsys, small, "--effect", "see", "--exposure", "1")
    assert short["top_probability"] < one["top_probability"]
    component = printed(capsys, small, "--effect", "laser_rear")
    assert component["minimal_cut_sets"] == 2


def test_an_order_limit_is_said(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faulttree", str(small), "--order", "1"]) == 0
    assert "up to order 1: larger ones are not counted" in capsys.readouterr().out


def test_a_budget_that_ends_is_no_success(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faulttree", str(small), "--nodes", "2"]) == 1
    captured = capsys.readouterr()
    assert "incomplete" in captured.err and " - " in captured.out


def test_a_file_without_functions_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "fmea.yaml"
    path.write_text("types: {a: {failure_modes: {off: {probability: 0.1, unobservable: x}}}}\n")
    assert main(["faulttree", str(path)]) == 0
    assert "no functions that could be lost" in capsys.readouterr().err


def test_a_circle_of_needs_is_refused_with_the_line(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TEXT.replace("    needs: [see, hook]\n", "    needs: [see, hook, park]\n")
    text += "  park: {needs: [carry]}\n"
    small.write_text(text, encoding="utf-8")
    said = refused(capsys, small)
    assert (
        "needs itself: carry -> park -> carry" in said and f"{small}:{text.count(chr(10))}" in said
    )
    small.write_text(TEXT.replace("{any: [laser_front, laser_rear]}", "{any: []}"))
    assert "a gate without input" in refused(capsys, small)


def test_wrong_usage(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, small, "--effect", "sea")
    assert "no effect 'sea'; did you mean 'see'?" in said and "see, carry" in said
    assert "name it: --effect NAME" in refused(capsys, small, "--export", "out.xml")
    assert "--at is for --closest" in refused(capsys, small, "--at", "-1m")
    assert "there is no record" in refused(capsys, small, "--closest", "--at", "-1m")
    assert "shows no importance" in refused(capsys, small, "--closest", "--importance")
    assert "--mission-time is for" in refused(capsys, small, "--mission-time", "9")
    assert "--exposure must be a number" in refused(capsys, small, "--exposure", "nan")
    assert "there is no" in refused(capsys, tmp_path / "nowhere")


def test_what_is_closest_without_a_record_is_what_is_most_probable(
    small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = printed(capsys, small, "--closest")
    assert found["diagnosis"] is None and found["at_ns"] is None
    carry, see = found["effects"]
    assert (carry["effect"], see["effect"]) == ("carry", "see")
    assert carry["closest"][0]["missing"] == ["hook#bent"]
    assert [near["probability"] for near in see["closest"]] == pytest.approx(
        [1e-3, 9.9e-5], rel=0.01
    )
    capsys.readouterr()
    assert main(["faulttree", str(small), "--closest", "--order", "1"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("nothing is recorded") and "up to order 1" in text


@pytest.mark.parametrize("watched", [True, False])
def test_a_diagnosis_brings_cut_sets_close(
    tmp_path: Path,
    watched: bool,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    (bench.folder / "fmea.yaml").write_text(FMEA.replace("[motor]", "{any: [motor, fan]}"))
    if watched:
        with bench.watched():
            bench.run(4)
            bench.run(4, speed=0)
    else:
        bench.run(4)
        bench.run(4, speed=0)
    bench.box.close()
    found = printed(capsys, bench.folder, "--closest")
    assert found["diagnosis"].startswith("robot-")
    (drive,) = found["effects"]
    first = drive["closest"][0]
    assert first["happened"] == ["fan#stuck"] and first["missing"] == ["motor#worn"]
    assert first["events"]["fan#stuck"] > 0.9
    assert first["probability"] == pytest.approx(first["events"]["motor#worn"], rel=0.2)
    capsys.readouterr()
    assert main(["faulttree", str(bench.folder), "--closest"]) == 0
    text = capsys.readouterr().out
    assert "\ndrive\n" in text and "happened: fan#stuck (0.9" in text
    assert "; missing: motor#worn (0.00" in text
    with monkeypatch.context() as patch:
        patch.setattr("amberbox.consult.context.context_from_journal", lambda *_: None)
        assert printed(capsys, bench.folder, "--closest")["diagnosis"] == found["diagnosis"]
    before = printed(capsys, bench.folder, "--closest", "--at", "-6s")
    assert before["diagnosis"] is None and before["effects"][0]["closest"][0]["happened"] == []
