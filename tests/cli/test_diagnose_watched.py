"""The verb diagnose beside a watcher: from its journal, at any time; each revision."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import Store, open_store
from amberbox.cli.diagnose import revisions
from amberbox.cli.main import main
from amberbox.consult import context
from amberbox.consult.context import situation_at
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.current_state import RecordedFindings, findings_until
from amberbox.monitoring.plan_loader import load_plan
from tests.cli.diagnosed import Bench, write_folder
from tests.cli.test_diagnose import HOT, TURNS, found, leading

DURING = "2023-11-14T22:13:26.5Z"


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Watch a robot that is well, hot for three seconds, and well again."""
    bench = Bench(write_folder(tmp_path_factory.mktemp("watched") / "robot"))
    with bench.watched():
        bench.run(4)
        bench.run(3, temperature=90, speed=0)
        bench.run(6)
    bench.box.close()
    return bench.folder


@pytest.fixture
def no_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make it an error to evaluate the record."""

    def refuse(*arguments: Any) -> None:
        raise AssertionError("the record was evaluated")

    monkeypatch.setattr(context, "context_by_evaluation", refuse)


def store_of(folder: Path) -> Store:
    return open_store(load_folder(folder).store_path)


@pytest.mark.usefixtures("no_evaluation")
def test_the_diagnosis_that_stood_is_told(
    watched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = found(capsys, watched, "--at", DURING)
    assert made["origin"] == "watcher" and made["state"] == "open"
    written = [d for d in findings_until(store_of(watched), 1 << 62).diagnoses if d.state == "open"]
    assert (made["id"], made["revision"]) in {(d.id, d.revision) for d in written}
    assert leading(made) == ["motor#worn"]
    healed = found(capsys, watched, status=0)
    assert healed["state"] == "healed" and healed["id"] == made["id"]
    assert healed["revision"] > made["revision"]
    assert found(capsys, watched, "--at", "2023-11-14T22:13:23Z", status=0)["state"] == "none"


@pytest.mark.usefixtures("no_evaluation")
def test_answers_and_symptoms_are_added_to_what_the_watcher_saw(
    watched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    during = (watched, "--at", DURING)
    assert leading(found(capsys, *during, "--answer", "sound=smooth")) == ["motor#short"]
    assert leading(found(capsys, *during, "--symptom", f"{HOT}=absent")) == ["fan#stuck"]
    again = found(capsys, watched, "--answer", "sound=smooth", status=0)
    assert again["state"] == "healed" and leading(again) == ["motor#short"]


def test_the_record_evaluated_says_the_same(
    watched: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What counts, and so every probability, is the same by the journal and by evaluation."""
    for options in (("--at", DURING), ("--at", DURING, "--symptom", "noisy"), ()):
        status = 1 if options else 0
        journal = found(capsys, watched, *options, status=status)
        with monkeypatch.context() as patch:
            patch.setattr("amberbox.consult.context.was_watched", lambda *_: False)
            record = found(capsys, watched, *options, status=status)
        assert record["origin"] == "record" and journal["origin"] == "watcher"
        assert record["hypotheses"] == journal["hypotheses"]
        states = [{s["id"]: s["state"] for s in made["symptoms"]} for made in (record, journal)]
        assert states[0] == states[1]


def test_what_counts_is_what_the_tracker_counts(watched: Path) -> None:
    folder = load_folder(watched)
    knowledge, _ = load_knowledge(folder, load_plan(folder)[0])
    assert knowledge is not None
    symptoms = findings_until(store_of(watched), 1 << 62).symptoms
    first = min(s.confirmed_ns or 0 for s in symptoms)
    for tenth in range(1, 150, 7):
        at_ns = first + tenth * NS // 10
        told = [s for s in symptoms if (s.confirmed_ns or 0) <= at_ns]
        tracker = FaultTracker(knowledge)
        tracker.begin(first - 1)
        tracker.advance(told, at_ns)
        expected = {s.id: s.state for s in tracker.situation().symptoms}
        assert {s.id: s.state for s in situation_at(knowledge, told, at_ns).symptoms} == expected


def test_symptoms_of_deleted_files_are_there_still(
    watched: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    during = (watched, "--at", DURING)
    asked = (*during, "--answer", "sound=smooth")
    before = found(capsys, *asked)

    def left(store: Store, at_ns: int) -> RecordedFindings:
        said = findings_until(store, at_ns)
        return replace(said, symptoms=[s for s in said.symptoms if s.id not in gone])

    monkeypatch.setattr(context, "findings_until", left)
    gone = {HOT}
    after = found(capsys, *asked)
    assert after["origin"] == "watcher" and after["hypotheses"] == before["hypotheses"]
    gone = {HOT, TURNS, "noisy"}
    assert found(capsys, *during)["origin"] == "record", "such a watcher told of no symptom"


def test_other_monitors_say_nothing_of_these(
    watched: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With another configuration the journal counts for nothing: the record is evaluated."""
    path = watched / "components" / "motor" / "temperature.yaml"
    text = path.read_text()
    path.write_text(text.replace("max: 80", "max: 99"))
    try:
        made = found(capsys, watched, "--at", DURING)
        assert made["origin"] == "record" and leading(made) == ["fan#stuck"]
    finally:
        path.write_text(text)


def test_each_revision_is_given_as_it_is_written(tmp_path: Path) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    given: list[Diagnosis] = []
    moves = iter([(2.0, {"speed": 0.0}), (2.0, {"temperature": 90.0, "speed": 0.0}), (6.0, {})])

    def wait(_: float) -> None:
        seconds, values = next(moves, (0.0, {}))
        if not seconds:
            raise KeyboardInterrupt
        bench.run(seconds, **values)

    with bench.watched():
        bench.run(2)
        with pytest.raises(KeyboardInterrupt):
            for diagnosis, symptoms in revisions(store_of(bench.folder), wait):
                given.append(diagnosis)
                assert set(diagnosis.symptoms) <= set(symptoms)
    assert [d.revision for d in given] == list(range(1, len(given) + 1))
    assert given[0].hypotheses[0].faults == {"fan#stuck"} and given[0].symptoms == (TURNS,)
    assert given[-1].state == "healed"
    assert given[-1].hypotheses[0].faults == {"motor#worn"}


def test_what_stands_is_given_first_and_once(tmp_path: Path) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    with bench.watched():
        bench.run(2)
        bench.run(3, speed=0)
    with bench.watched():  # a new file, which begins with what stands
        bench.run(1, speed=0)
    bench.box.close()

    def wait(_: float) -> None:
        raise KeyboardInterrupt

    given = []
    with pytest.raises(KeyboardInterrupt):
        for diagnosis, _ in revisions(store_of(bench.folder), wait):
            given.append(replace(diagnosis, live_only=False))
    newest = findings_until(store_of(bench.folder), 1 << 62).diagnoses[-1]
    assert given == [replace(newest, live_only=False)]


def test_following_prints_until_it_is_stopped(
    watched: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (standing,) = (
        d for d in findings_until(store_of(watched), 1 << 62).diagnoses if d.revision == 1
    )

    def one(store: Store) -> Any:
        yield standing, {}
        raise KeyboardInterrupt

    monkeypatch.setattr("amberbox.cli.diagnose.revisions", one)
    assert main(["diagnose", str(watched), "--follow"]) == 130
    printed = capsys.readouterr()
    assert f"{standing.id}, revision 1" in printed.out
    assert "nobody watches" in printed.err and f"amberbox watch {watched}" in printed.err
    assert main(["diagnose", str(watched), "--follow", "--json"]) == 130
    (line,) = capsys.readouterr().out.splitlines()
    assert json.loads(line)["id"] == standing.id
