"""The verb mission, and --mission of the verbs that show a range."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.blackbox.retention.missions import load
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

TASK = FakeItem("task", [{"state": "IDLE", "speed": 0.5}])
RULES = """\
id: test
missions:
  - name: transport
    start: task.state == 'RUN'
    end: task.state != 'RUN'
    outcome: task.state
    failed: task.state == 'FAILED'
    parameters: {speed: task.speed}
"""
STATES = ("IDLE", "RUN", "RUN", "DONE", "RUN", "FAILED", "RUN", "RUN", "RUN", "FAILED")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    run = FakeRun(tmp_path / "store", items=[TASK])
    rows = [
        (T0_NS + n * NS, TASK, {"state": state, "speed": n / 2}) for n, state in enumerate(STATES)
    ]
    run.write(rows)
    run.close()
    (tmp_path / "robot.yaml").write_text(RULES)
    return tmp_path / "store"


@pytest.fixture
def detected(store: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert main(["mission", "detect", str(store), "--rules", str(store.parent / "robot.yaml")]) == 0
    capsys.readouterr()
    return store


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(list(arguments)) == 0
    return capsys.readouterr().out


def test_missions_are_found_and_listed(detected: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed = json.loads(printed(capsys, "mission", "list", str(detected), "--json"))
    assert [(m["outcome"], m["failed"]) for m in listed] == [
        ("DONE", False), ("FAILED", True), ("FAILED", True),
    ]  # fmt: skip
    assert listed[0]["from"] == "2026-09-21T14:13:21.000000000Z"
    assert listed[0]["parameters"] == {"speed": 0.5}
    text = printed(capsys, "mission", "list", str(detected), "--failed", "--last", "1")
    assert "transport-20260921t141326.000" in text
    assert "3.0s" in text
    assert "1.0s" not in text


def test_finding_again_finds_nothing_new(
    detected: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rules = str(detected.parent / "robot.yaml")
    assert "no new missions" in printed(
        capsys, "mission", "detect", str(detected), "--rules", rules
    )
    assert len(load(detected)) == 3


def test_a_dry_run_writes_nothing(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = str(store.parent / "robot.yaml")
    out = printed(capsys, "mission", "detect", str(store), "--rules", rules, "--dry-run", "--json")
    assert len(json.loads(out)) == 3
    assert printed(capsys, "mission", "list", str(store)) == "no missions\n"


def test_query_shows_the_rows_of_missions(
    detected: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    query = ("query", str(detected), "task", "state", "--format", "csv", "--mission")
    lines = printed(capsys, *query, "failed:2").splitlines()
    assert lines[0] == "timestamp,mission,state"
    assert [line.split(",")[2] for line in lines[1:]] == ["RUN"] * 4
    lines = printed(capsys, *query, "last").splitlines()
    assert lines[0] == "timestamp,state"
    assert len(lines) == 4


@pytest.mark.parametrize("verb", [["gaps"], ["events"]])
def test_other_verbs_take_missions(
    detected: Path, capsys: pytest.CaptureFixture[str], verb: list[str]
) -> None:
    printed(capsys, *verb, str(detected), "--mission", "last")


def test_export_takes_several_missions_and_plot_takes_one(
    detected: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where, target = str(detected), str(detected.parent / "x.csv")
    printed(capsys, "export", where, "--item", "task", "--mission", "failed:2", "-o", target)
    assert len(Path(target).read_text().splitlines()) == 5
    plot = ["plot", where, "task", "speed", "-o", str(detected.parent / "x.html"), "--mission"]
    assert "3 rows" in printed(capsys, *plot, "last")
    assert main([*plot, "last:2"]) == 2
    assert "name one" in capsys.readouterr().err


def test_a_mission_is_begun_and_ended(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begin = ("mission", "start", str(store), "drive", "--id", "d1", "--parameter", "load=2 kg")
    assert printed(capsys, *begin) == "d1\n"
    assert "lasts" in printed(capsys, "mission", "list", str(store))
    out = printed(capsys, "mission", "end", str(store), "--outcome", "aborted")
    assert out.startswith("d1: aborted after ")
    (mission,) = load(store)
    assert (mission.failed, mission.parameters) == (True, {"load": "2 kg"})


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["mission", "end", "STORE", "x"], "no mission 'x' lasts"),
        (["mission", "start", "STORE", "a b"], "no id"),
        (["mission", "start", "STORE", "a", "--parameter", "x"], "no parameter"),
        (["mission", "list", "STORE", "--last", "0"], "--last"),
        (["mission", "detect", "STORE"], "no rules"),
        (["query", "STORE", "task", "--mission", "last"], "no mission 'last'"),
        (["plot", "STORE", "task", "speed", "--mission", "x", "-o", "x.svg"], "no mission 'x'"),
        (["query", "STORE", "task", "--mission", "last", "--from", "-1s"], "its own window"),
        (["query", "STORE", "task", "--mission", "last", "--follow"], "--follow"),
    ],
)
def test_wrong_usage_is_said(
    store: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], what: str
) -> None:
    assert main([str(store) if a == "STORE" else a for a in arguments]) == 2
    assert what in capsys.readouterr().err


def test_rules_that_are_wrong_are_said(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = store.parent / "robot.yaml"
    rules.write_text("missions:\n  - {name: A b, start: x > 1, end: task.speed + 1, max: -1 s}\n")
    assert main(["mission", "detect", str(store), "--rules", str(rules)]) == 2
    error = capsys.readouterr().err
    for part in ("'A b' is no id", "item.variable", "is no condition", "must be above 0"):
        assert part in error
