"""The verb diagnose without a watcher: with given symptoms, and with those of a record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from amberbox.cli.main import main
from tests.cli.diagnosed import FMEA, Bench, write_folder

HOT, TURNS = "motor/temperature/cool", "fan/speed/turns"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Make a robot folder without a record."""
    return write_folder(tmp_path / "robot")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a robot that is well, hot for three seconds, and well again."""
    bench = Bench(write_folder(tmp_path_factory.mktemp("diagnose") / "robot"))
    bench.run(4)
    bench.run(3, temperature=90, speed=0)
    bench.run(6)
    bench.box.close()
    return bench.folder


def found(
    capsys: pytest.CaptureFixture[str], *arguments: str | Path, status: int = 1
) -> dict[str, Any]:
    """Diagnose, and return the object."""
    capsys.readouterr()
    assert main(["diagnose", *map(str, arguments), "--json"]) == status
    made: dict[str, Any] = json.loads(capsys.readouterr().out)
    return made


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Diagnose with wrong arguments, and return the error message."""
    capsys.readouterr()
    assert main(["diagnose", *map(str, arguments)]) == 2
    return capsys.readouterr().err


def leading(made: dict[str, Any]) -> list[str]:
    faults: list[str] = made["hypotheses"][0]["faults"]
    return faults


def test_given_symptoms_are_all_there_is_without_a_record(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert leading(found(capsys, folder, "--symptom", TURNS)) == ["fan#stuck"]
    made = found(capsys, folder, "--symptom", TURNS, "--symptom", HOT)
    assert leading(made) == ["motor#worn"]
    assert made["groups"][0]["faults"] == [["motor#worn"], ["motor#short"]]
    assert made["groups"][0]["split_by"] == "read:noisy", "no watcher reads it"
    assert made["origin"] == "given" and made["engine"] == "covering" and made["state"] == "open"
    assert made["explanation"]["headline"]
    assert {s["id"]: (s["state"], s["counted"]) for s in made["symptoms"]} == {
        TURNS: ("present", True),
        HOT: ("present", True),
    }
    made = found(capsys, folder, "--symptom", TURNS, "--symptom", f"{HOT}=absent")
    assert leading(made) == ["fan#stuck"] and made["hypotheses"][0]["probability"] > 0.9


def test_every_key_is_documented_and_every_number_finite(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "robot" / "diagnosing.md").read_text()
    made = found(capsys, folder, "--symptom", TURNS, "--symptom", HOT)
    parts = (made, made["hypotheses"][0], made["groups"][0], made["next_tests"][0])
    keys = {key for part in (*parts, made["symptoms"][0], made["explanation"]) for key in part}
    alone = {"diagnosis", "config_hash", "at_ns"}
    missing = {key for key in keys - alone if f"`{key}`" not in page}
    assert not missing, "of the explanation: id and time stand beside it, too"
    assert "NaN" not in json.dumps(made) and "Infinity" not in json.dumps(made)


def test_an_id_may_be_the_end_of_only_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert leading(found(capsys, folder, "--symptom", "turns")) == ["fan#stuck"]
    assert found(capsys, folder, "--symptom", "speed/turns=absent", status=0)["state"] == "none"
    assert "did you mean 'fan/speed/turns'?" in refused(capsys, folder, "--symptom", "speed/turn")
    text = FMEA.replace("[fan/speed/turns]", "[fan/speed/turns, motor/speed/turns]")
    (folder / "fmea.yaml").write_text(text)
    said = refused(capsys, folder, "--symptom", "turns")
    assert "there is no symptom 'motor/speed/turns'" in said, "monitors are compared"


def test_what_is_wrong_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--symptom ID" in refused(capsys, folder)
    assert "--symptom ID" in refused(capsys, folder, "--at", "-1m")
    assert "is not 'gone'" in refused(capsys, folder, "--symptom", f"{HOT}=gone")
    given = (folder, "--symptom", HOT)
    assert "no test 'motor.sond'; did you mean" in refused(
        capsys, *given, "--answer", "motor.sond=x"
    )
    assert "it gives smooth, rough" in refused(capsys, *given, "--answer", "motor.sound=loud")
    assert "TEST=VALUE" in refused(capsys, *given, "--answer", "motor.sound")
    assert "cannot be" in refused(capsys, *given, "--exposure", "-1")
    assert "leave out" in refused(capsys, *given, "--follow")
    assert "--folder" in refused(capsys, folder / "components")
    (folder / "fmea.yaml").write_text(FMEA.replace("rate: 2.0e-4", "rate: much"))
    assert f"{folder / 'fmea.yaml'}:8: " in refused(capsys, *given)
    (folder / "fmea.yaml").unlink()
    assert "docs/robot/fmea.md" in refused(capsys, *given)


def test_answers_rank_anew(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = (folder, "--symptom", TURNS, "--symptom", HOT)
    asked = found(capsys, *given)["next_tests"][0]["id"]
    made = found(capsys, *given, "--answer", "motor.sound=smooth", "--answer", "ohms=low")
    assert leading(made) == ["motor#short"] and made["hypotheses"][0]["probability"] > 0.95
    assert made["answers"] == {"motor.sound": "smooth", "motor.ohms": "low"}
    before, after = found(capsys, *given), found(capsys, *given, "--answer", f"{asked}=cannot")
    assert [h["probability"] for h in before["hypotheses"]] == [
        h["probability"] for h in after["hypotheses"]
    ]
    assert asked not in {test["id"] for test in after["next_tests"]}
    read = found(capsys, folder, "--symptom", TURNS, "--answer", "read:cool=present")
    assert leading(read) == ["motor#worn"]


def test_exposure_makes_faults_more_probable(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short, long = (
        {h["id"]: h["probability"] for h in made["hypotheses"]}
        for made in (
            found(capsys, folder, "--symptom", TURNS, "--exposure", hours) for hours in ("1", "999")
        )
    )
    assert short["fan#stuck"] < long["fan#stuck"]


def test_a_record_is_evaluated_up_to_the_time_asked_for(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = found(capsys, recorded, "--at", "2023-11-14T22:13:26.5Z")
    assert made["origin"] == "record" and made["state"] == "open"
    assert leading(made) == ["motor#worn"] and made["id"] == "robot-20231114t221324"
    present = {s["id"] for s in made["symptoms"] if s["state"] == "present"}
    assert present == {HOT, TURNS}
    assert found(capsys, recorded, "--at", "2023-11-14T22:13:23Z", status=0)["state"] == "none"
    assert main(["diagnose", str(recorded), "--at", "2023-11-14T22:13:23Z"]) == 0
    assert "nothing is wrong at 2023-11-14T22:13:" in capsys.readouterr().out


def test_what_is_over_is_told_as_over(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["diagnose", str(recorded)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("nothing is wrong now; the last diagnosis ended ")
    assert "the bearing of the motor is worn" in text.lower()
    made = found(capsys, recorded, status=0)
    assert made["state"] == "healed" and leading(made) == ["motor#worn"]
    again = found(capsys, recorded, "--answer", "sound=smooth", status=0)
    assert again["state"] == "healed" and again["id"] == made["id"]
    assert leading(again) == ["motor#short"]


def test_what_is_said_counts_before_what_was_read(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    during = (recorded, "--at", "2023-11-14T22:13:26.5Z")
    made = found(capsys, *during, "--symptom", f"{HOT}=absent")
    assert leading(made) == ["fan#stuck"]
    made = found(capsys, *during, "--symptom", "noisy")
    assert {s["id"]: s["source"] for s in made["symptoms"]}["noisy"] == "given"
    assert made["hypotheses"][0]["explains"] == sorted([HOT, TURNS, "noisy"])
    now = found(capsys, recorded, "--symptom", TURNS)
    assert now["state"] == "open" and now["id"] != found(capsys, recorded, status=0)["id"]


def test_a_store_needs_the_folder_beside_it(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = recorded / "store"
    assert "--folder" in refused(capsys, store)
    whole = found(capsys, store, "--folder", recorded, "--at", "-6.5s")
    journal = next((store / "journal").glob("*.mcap"))
    alone = found(capsys, journal, "--folder", recorded, "--at", "-6.5s")
    assert leading(whole) == leading(alone) == ["motor#worn"]


def test_little_lookback_sees_little(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert found(capsys, recorded, "--lookback", "1s", status=0)["state"] in ("none", "healed")
    assert "too short" in refused(capsys, recorded, "--lookback", "0s")


def test_where_nothing_was_recorded_nothing_is_known(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(capsys, recorded, "--at", "2023-11-14T23:13:20Z")
    assert "nothing was recorded in the 10 min before 2023-11-14T23:13:20" in said
    early = refused(capsys, recorded, "--at", "1970-01-01")
    assert "nothing was recorded in" in early and "the record goes from 2023-11-14T22:13" in early
    assert "error: --at: not a time: 'noon'" in refused(capsys, recorded, "--at", "noon")
    assert main(["diagnose", str(recorded), "--at", "2023-11-14T22:14Z"]) == 0
    assert "nothing was recorded after 2023-11-14T22:13:3" in capsys.readouterr().err


def test_it_is_drawn(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    target = tmp_path / "why.svg"
    given = ["diagnose", str(folder), "--symptom", TURNS]
    assert main([*given, "--svg", str(target)]) == 1
    assert "the fan is stuck" in capsys.readouterr().out.lower()
    assert target.read_text().startswith("<svg") and "fan#stuck" in target.read_text()
    assert main([*given, "--svg", "-"]) == 1
    assert capsys.readouterr().out.startswith("<svg")
    assert "both print" in refused(capsys, folder, "--symptom", TURNS, "--svg", "-", "--json")


RULES = "installed(motor, 2009).\nold(M) :- installed(M, Year), Year < 2015.\n"
FINDINGS = 'findings:\n  - {rule: old(M), maps_to: ["<M>#short"], detects: 0.9, leak: 0.001}\n'


@pytest.fixture
def ruled(folder: Path) -> Path:
    """Make a robot folder with a rule that indicates a failure mode."""
    (folder / "rules").mkdir()
    (folder / "rules" / "age.pl").write_text(RULES)
    (folder / "fmea.yaml").write_text(FMEA + FINDINGS)
    return folder


def test_what_rules_find_is_weighed_with_all_else(
    ruled: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = found(capsys, ruled, "--symptom", TURNS, "--symptom", HOT)
    assert leading(made) == ["motor#short"]
    rule = next(s for s in made["symptoms"] if s["source"] == "rules")
    assert rule["id"] == "rule:old(motor)" and rule["counted"]
    (ruled / "fmea.yaml").write_text(FMEA)
    made = found(capsys, ruled, "--symptom", TURNS, "--symptom", HOT)
    assert leading(made) == ["motor#worn"], "nobody said what the rule speaks for"
    alone = found(capsys, ruled, "--symptom", TURNS, "--engine", "rules")
    assert alone["hypotheses"] == [] and alone["findings"] == ["rule:old(motor)"]


def test_rules_alone_conclude_with_proof(ruled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = (ruled, "--symptom", TURNS, "--symptom", HOT, "--engine", "rules")
    made = found(capsys, *given)
    assert made["engine"] == "rules" and leading(made) == ["motor#short"]
    assert "installed(motor,2009)" in made["hypotheses"][0]["proof"]
    assert main(["diagnose", *map(str, given)]) == 1
    assert capsys.readouterr().out.startswith("By the rules alone")
    (ruled / "rules" / "age.pl").write_text("old(M) :- instaled(M, 2009).\ninstalled(a, 1).\n")
    assert "age.pl:1" in refused(capsys, *given)
    (ruled / "rules" / "age.pl").unlink()
    (ruled / "fmea.yaml").write_text(FMEA)
    assert "no rules/*.pl" in refused(capsys, *given)


def test_fault_trees_alone_conclude_with_cut_sets(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = (folder, "--symptom", TURNS, "--symptom", HOT, "--engine", "faulttree")
    made = found(capsys, *given)
    sets = [h["faults"] for h in made["hypotheses"]]
    assert sets[:2] == [["motor#worn"], ["motor#short"]] and [] not in sets
    assert made["engine"] == "faulttree" and made["hypotheses"][0]["proof"]
    assert sum(h["probability"] for h in made["hypotheses"]) == pytest.approx(1.0)
    answered = found(capsys, *given, "--answer", "sound=smooth", "--answer", "ohms=low")
    assert leading(answered) == ["motor#short"]
    assert main(["diagnose", *map(str, given)]) == 1
    assert capsys.readouterr().out.startswith("By the fault trees alone")
    nothing = (folder, "--symptom", f"{HOT}=absent", "--engine", "faulttree")
    assert found(capsys, *nothing, status=0)["state"] == "none"
