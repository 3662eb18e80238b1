"""The scoring of diagnoses: what counts as right, and the figures made of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import pytest

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import UNKNOWN_FAULT, AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.sim.faults import catalogue
from amberbox.sim.missions import SCENARIOS
from amberbox.sim.random_disturbances import Variable
from amberbox.sim.robot import START_NS
from benchmarks import diagnosis
from benchmarks.accuracy import (
    Outcome,
    count_interval,
    interval,
    measured,
    rows,
    with_figures,
)
from benchmarks.diagnosis import counts_of, jobs, judge, kept, main
from benchmarks.missions import NOMINAL, Mission, Planted, disturbed, live, nominal
from tools.findings import ROOT


def revision(
    at_s: float,
    *sets: Sequence[str],
    group: int = 1,
    probability: float = 0.7,
    state: Literal["open", "healed"] = "open",
    name: str = "d1",
) -> Diagnosis:
    """Return a revision whose hypotheses are these sets, the first ``group`` of them as one."""
    made = tuple(
        Hypothesis(f"h{n}", frozenset(faults), probability if n == 0 else 0.1)
        for n, faults in enumerate(sets)
    )
    first = AmbiguityGroup(tuple(h.id for h in made[:group]), probability)
    at_ns = START_NS + round(at_s * NS)
    return Diagnosis(name, 1, "r", at_ns, "", made, 1.0, groups=(first,), state=state)


def judged(monkeypatch: pytest.MonkeyPatch, *made: Diagnosis, truth: str = "base#x") -> Outcome:
    """Judge a mission with a fault from 30 s on that was diagnosed like this."""
    monkeypatch.setattr(diagnosis, "diagnoses", lambda _: iter(made))
    fault = Planted(catalogue()["wifi_weak"], 20.0, 30.0)
    return judge("single", Mission(1, "transport", False, (fault,), 120.0), [truth])


def test_times_count_from_the_onset(monkeypatch: pytest.MonkeyPatch) -> None:
    found = judged(
        monkeypatch,
        revision(32.0, ["base#y"]),
        revision(35.0, ["base#y"], ["base#x"], group=2),
        revision(37.0, ["base#x"], ["base#y"], group=2),
    )
    assert (found.symptom_s, found.named_s, found.led_s) == pytest.approx((2.0, 5.0, 7.0))
    assert found.is_right and found.leads and found.early == 0 and found.misled == 0.7
    assert found.faults == ["wifi_weak=20@30.0s"]


def test_an_answer_that_has_ended_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    found = judged(
        monkeypatch,
        revision(35.0, ["base#x"]),
        revision(60.0, ["base#x"], state="healed"),
    )
    assert found.shows and not found.stands and not found.is_right
    assert found.ended_group == [["base#x"]] and found.named_s == pytest.approx(5.0)
    assert found.misled == 0.0


def test_the_latest_diagnosis_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    found = judged(
        monkeypatch,
        revision(20.0, ["base#z"], name="d0"),
        revision(25.0, ["base#z"], name="d0", state="healed"),
        revision(35.0, ["base#x"]),
        revision(60.0, ["base#x"], state="healed"),
        revision(70.0, ["base#y"], ["base#x"], name="d2", probability=0.9),
    )
    assert found.group == [["base#y"]] and found.misleads and not found.is_right
    assert found.early == 1 and found.diagnoses == 3


def test_nothing_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    found = judged(monkeypatch, revision(20.0, ["base#x"], name="d0"))
    assert not found.shows and not found.stands and not found.leads


def outcome(kind: str, group: list[list[str]], probability: float, right: str) -> Outcome:
    return Outcome(
        kind, 1, ["offset:a.b=1@30s"], [right], group=group, probability=probability, symptom_s=1.0
    )


def test_unknown_faults_count_in_the_calibration_and_apart_from_those_without_answer() -> None:
    other = UNKNOWN_FAULT
    found = [
        outcome("drawn", [["base#x"]], 0.95, other),
        outcome("drawn", [["base#x"]], 0.75, other),
        outcome("drawn", [[other], ["base#x"]], 0.95, other),
        outcome("drawn", [["base#x"], [other]], 0.6, other),
        outcome("drawn", [[]], 0.99, other),
        Outcome("drawn", 2, ["drop:a@30s"], [other]),
        outcome("single", [["base#x"]], 0.92, "base#x"),
    ]
    by = {row.name: row for row in rows(found)}
    assert by["disturbance: no answer"].note.startswith("1 of 6")
    assert by["disturbance: said so"].note.startswith("1 of 5")
    assert by["disturbance: in the first group"].note.startswith("2 of 5")
    assert by["disturbance: nothing is broken"].note.startswith("1 of 6")
    assert by["disturbance: wrong mode"].note.startswith("3 of 6")
    assert by["disturbance: wrong mode, above 80 %"].note.startswith("1 of 6")
    assert "disturbance: that at any time" not in by
    since = [replace(each, misled=0.9 if each.probability == 0.75 else 0.0) for each in found]
    assert {row.name: row for row in rows(since)}["disturbance: that at any time"].note[
        :6
    ] == "1 of 6"
    assert by["right where 90-100 % is said"].note.startswith("2 of 4; 95 % interval 15-85 %")
    assert by["right where 70-80 % is said"].value == 0
    assert by["one fault, first member"].value == 100
    assert "| 90-100 % | 4 | 95 % | 50 % | 15-85 % | 1 of 1 | 1 of 3 |\n" in measured(found, "")


def test_false_diagnoses_are_counted_by_drive_and_hour() -> None:
    found = [
        Outcome("nominal", 1, [], [], "shift", 900.0, diagnoses=1),
        Outcome("nominal", 2, [], [], "shuttle", 900.0),
    ]
    (row,) = rows(found)
    assert row.value == 2.0
    assert "1 in 0.5 h (shift 1, shuttle 0); 95 % interval 0.051-11" in row.note


@pytest.mark.parametrize(
    ("right", "count", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (85, 90, 0.8765, 0.9761), (0, 0, 0.0, 1.0)],
)
def test_intervals_of_shares(right: int, count: int, low: float, high: float) -> None:
    assert interval(right, count) == pytest.approx((low, high), abs=2e-4)


@pytest.mark.parametrize(("count", "low", "high"), [(0, 0, 3.6889), (1, 0.0253, 5.5716),
                                                    (10, 4.7954, 18.3904)])  # fmt: skip
def test_intervals_of_counts(count: int, low: float, high: float) -> None:
    assert count_interval(count) == pytest.approx((low, high), abs=1e-3)


def test_an_interrupted_experiment_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "kept.jsonl"
    asked: list[tuple[str, int]] = []

    def run(wanted, tell, processes):  # type: ignore[no-untyped-def]  # as work_all
        asked.extend((job.kind, job.seed) for job in wanted)
        made = [Outcome(job.kind, job.seed, ["f"], ["base#x"]) for job in wanted]
        for each in made:
            tell(each)
        return made

    monkeypatch.setattr(diagnosis, "run", run)
    size = ["--unknown", "1", "--knobs", "0", "--hours", "0", "--first-seed", "7"]
    assert main([*size, "--single", "2", "--double", "1", "--keep", str(path)]) == 0
    assert sorted(asked) == [("double", 7), ("drawn", 7), ("single", 7), ("single", 8)]
    with path.open("a") as file:
        file.write('{"kind": "sing')  # as after a power cut
    asked.clear()
    assert main([*size, "--single", "3", "--double", "1", "--keep", str(path)]) == 0
    assert asked == [("single", 9)]
    assert len(kept(path)) == 5
    assert "one fault, in the first group" in capsys.readouterr().out
    path.write_text(json.dumps({"kind": "single", "ended_s": 1.0}) + "\n")
    assert main([*size, "--single", "3", "--keep", str(path)]) == 2
    assert f"{path}:1" in capsys.readouterr().err


def test_the_page_is_renewed_between_its_marks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, path = tmp_path / "page.md", tmp_path / "kept.jsonl"
    page.write_text("before\n<!-- measured -->\nold\n<!-- end of measured -->\nafter\n")
    wrong = outcome("drawn", [["base#x"]], 0.95, UNKNOWN_FAULT)
    path.write_text(json.dumps(asdict(wrong)) + "\n")
    assert main(["--keep", str(path), "--print", "--page", str(page), "--state", "today's"]) == 0
    text = page.read_text()
    assert text.startswith("before\n<!-- measured -->\nState of the code: today's. Seeds 1 to 1")
    assert text.endswith("<!-- end of measured -->\nafter\n") and "old" not in text
    assert "| drawn | `offset:a.b=1@30s` | base#x | 95.0 % |" in text
    assert "| offset | 1 | 0 | 0 | 0 | 1 | 1 |" in text
    capsys.readouterr()
    with pytest.raises(UsageError, match="no place"):
        with_figures("a page", measured([wrong], ""))


def test_the_page_of_the_documentation_has_its_marks() -> None:
    page = (ROOT / "docs" / "reference" / "accuracy.md").read_text()
    assert with_figures(page, "") != page


def test_nominal_hours_drive_all_drives() -> None:
    assert set(NOMINAL) == set(SCENARIOS)
    assert {nominal(seed, 900.0).scenario for seed in range(len(NOMINAL))} == set(SCENARIOS)


def test_the_revisions_of_one_mission_are_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(diagnosis, "diagnoses", lambda _: iter([revision(500.0, ["base#x"], [])]))
    assert main(["--show", "nominal:3"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "nothing is wrong",
        "-400.0 s  d1 open: ",
        "     70.0 %  base#x",
        "     10.0 %  nothing",
    ]
    with pytest.raises(SystemExit):
        main(["--show", "nominal"])


def test_old_options_and_a_fair_mixture() -> None:
    options = diagnosis._parser().parse_args(["--missions", "300", "--hours", "20"])
    assert (options.missions, options.single, options.double) == (300, None, None)
    counts = counts_of(20, 10, 10, 10, 2.0)
    assert counts["nominal"] == 8
    made = jobs(counts, 600_000)
    assert len(made) == len(set(made)) == 58
    assert {job.kind for job in made[:15]} == set(counts)


def test_a_disturbed_mission_differs_from_the_onset_on_only() -> None:
    variables = [Variable("battery", "voltage", "number", "V", 24.0, 28.0)]
    mission = disturbed(5, variables)
    assert mission == disturbed(5, variables) and mission.last_onset_s == mission.onset_s
    short = Mission(5, "transport", mission.cart, (), mission.onset_s + 5.0, mission.disturbances)
    clean = Mission(5, "transport", mission.cart, (), mission.onset_s + 5.0)
    said, usual = ([m for _, part in live(each) for m in part] for each in (short, clean))
    onset_ns = START_NS + round(mission.onset_s * NS)
    assert [m for m in said if m[1] < onset_ns] == [m for m in usual if m[1] < onset_ns]
    assert said != usual
