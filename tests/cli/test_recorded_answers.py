"""Answers of people that the robot's own diagnosis counts: recorded, evaluated, and replayed."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import Store, open_store
from amberbox.cli.main import main
from amberbox.consult.context import load_diagnoser
from amberbox.core.types import Diagnosis
from amberbox.monitoring.current_state import findings_until
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from tests.cli.diagnosed import Bench, write_folder
from tests.cli.test_diagnose import found, leading


def store_of(folder: Path) -> Store:
    return open_store(load_folder(folder).store_path)


def replayed(folder: Path) -> list[Diagnosis]:
    """Return the revisions that a replay finds."""
    plan, _ = load_plan(load_folder(folder))
    make, _ = load_diagnoser(load_folder(folder), plan)
    found = replay(plan, store_of(folder), diagnoser=make)
    return [one for one in found if isinstance(one, Diagnosis)]


def written(folder: Path) -> list[Diagnosis]:
    """Return the revisions that the watcher wrote, each once."""
    found = findings_until(store_of(folder), 1 << 62).diagnoses
    return list({(one.id, one.revision, one.state): one for one in found}.values())


def test_an_answer_counts_until_the_diagnosis_ends_and_a_replay_counts_it_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    folder = bench.folder
    with bench.watched():
        bench.run(4)
        bench.run(3, temperature=90, speed=0)
        before = written(folder)[-1]
        assert leading(found(capsys, folder)) == ["motor#worn"]
        words = ("--answer", "sound=smooth", "--record", "--who", "anna")
        assert main(["diagnose", str(folder), *words]) == 0
        assert before.id in capsys.readouterr().out
        bench.run(2, temperature=90, speed=0)
    with bench.watched():  # it goes on from its checkpoint
        bench.run(2, temperature=90, speed=0)
        now = found(capsys, folder)
        assert leading(now) == ["motor#short"] and now["revision"] > before.revision
        again = found(capsys, folder, "--symptom", "motor/temperature/cool=present")
        assert leading(again) == ["motor#short"], "with what is added, too"
        bench.run(6)
        bench.run(3, temperature=90, speed=0)
        assert leading(found(capsys, folder)) == ["motor#worn"], "of another diagnosis"
    bench.box.close()
    answers = findings_until(store_of(folder), 1 << 62).answers
    assert [(one.test, one.answer, one.who) for one in answers] == [
        ("motor.sound", "smooth", "anna")
    ]
    found_again = {(d.id, d.revision, d.state): d.hypotheses for d in replayed(folder)}
    live = {(d.id, d.revision, d.state): d.hypotheses for d in written(folder)}
    assert found_again == live


def test_what_is_no_answer_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    with bench.watched():
        bench.run(4)
        words = ["diagnose", str(bench.folder), "--record"]
        assert main(words) == 2
        assert main([*words, "--answer", "sound=smooth"]) == 2
        assert "no watcher has an open diagnosis" in capsys.readouterr().err
        bench.run(3, temperature=90, speed=0)
        assert main([*words, "--answer", "sound=blue"]) == 2
        assert "blue" in capsys.readouterr().err
    assert not list((store_of(bench.folder).path / "requests").glob("*.json"))
    bench.box.close()
