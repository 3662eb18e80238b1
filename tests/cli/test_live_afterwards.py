"""A watched robot with all kinds of evidence: live, in a replay and diagnosed afterwards."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec
import pytest

from amberbox.blackbox.journal import channels
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import Store, open_store, submit
from amberbox.cli.main import main
from amberbox.consult.context import context_by_evaluation, load_diagnoser
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.given_findings import KIND as FINDING
from amberbox.core.given_findings import RecordedFinding
from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.diagnose import diagnose_context
from amberbox.diagnosis.evidence import rules
from amberbox.monitoring.current_state import findings_until
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from amberbox.monitoring.watcher import ANSWER_KIND
from tests.cli.diagnosed import FMEA, Bench, write_folder

FINDINGS = """\
findings:
  - {rule: whines(X), maps_to: ['<X>#worn'], detects: 0.6, leak: 0.01}
  - {rule: stands(X), maps_to: ['<X>#worn', '<X>#short'], proves: true}
  - {rule: fails(X), maps_to: ['<X>#short'], detects: 0.5, leak: 0.01}
  - {finding: state_flow.unlikely.ros_speed, maps_to: ['motor#short'], detects: 0.7}
  - {finding: groups.odd_one_out.fans, maps_to: ['fan#stuck', 'motor#worn'], proves: true}
"""
RULES = """\
whines(motor) :- holds('ros_temperature.data > 60', _, To), now(Now), To > Now - 3000000000.
fails(motor) :- now(Now), status(motor, error, Now, Now).
stands(motor) :- present('motor/temperature/cool'), present('fan/speed/turns').
"""
IDS = ("state_flow.unlikely.ros_speed", "groups.odd_one_out.fans")


def store_of(folder: Path) -> Store:
    return open_store(load_folder(folder).store_path)


def written(folder: Path) -> list[Diagnosis]:
    """Return the revisions that the watchers wrote, each once."""
    found = findings_until(store_of(folder), 1 << 62).diagnoses
    return list({(one.id, one.revision): one for one in found if not one.live_only}.values())


def lived(place: Path, seed: int) -> Path:
    """Return the folder of a robot that was watched through random faults, with restarts."""
    folder = write_folder(place / "robot")
    (folder / "fmea.yaml").write_text(FMEA + FINDINGS)
    (folder / "rules").mkdir()
    (folder / "rules" / "motor.pl").write_text(RULES)
    bench, chance = Bench(folder), random.Random(seed)
    for _ in range(3):
        with bench.watched():
            bench.run(2)
            for _ in range(4):
                _say(folder, chance)
                hot, still = chance.choice((50, 70, 90)), chance.choice((0, 10, 200))
                bench.run(chance.uniform(0.3, 2.5), temperature=hot, speed=still)
        if chance.random() < 0.5:  # recorded while nobody watches
            bench.run(1, temperature=90, speed=0)
    with bench.watched():
        bench.run(1)
    bench.box.close()
    return folder


def _say(folder: Path, chance: random.Random) -> None:
    """Let a detector find something, or a person answer a test of the open diagnosis."""
    store = store_of(folder)
    if chance.random() < 0.6:
        states: tuple[Literal["present", "absent"], ...] = ("present", "absent")
        found = RecordedFinding(chance.choice(IDS), chance.choice(states))
        submit(store, FINDING, msgspec.to_builtins(found))
    made = written(folder)
    if made and made[-1].state == "open" and chance.random() < 0.5:
        answer = RecordedAnswer(made[-1].id, "motor.ohms", chance.choice(("good", "low")))
        submit(store, ANSWER_KIND, msgspec.to_builtins(answer))


def shares(made: Diagnosis | None) -> dict[str, float]:
    assert made is not None
    return {one.id: one.probability for one in made.hypotheses}


@pytest.mark.parametrize("seed", [1, 2])
def test_live_equals_afterwards_at_every_revision(
    tmp_path: Path, seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lived(tmp_path, seed)
    live, loaded, store = written(folder), load_folder(folder), store_of(folder)
    plan, _ = load_plan(loaded)
    make, _ = load_diagnoser(loaded, plan)
    again = [one for one in replay(plan, store, diagnoser=make) if isinstance(one, Diagnosis)]
    assert again == live, "a replay finds the same revisions, to the last bit"
    assert len(live) > 8 and all(one.asked == ("rules",) for one in live)
    knowledge, _ = load_knowledge(loaded, plan)
    assert knowledge is not None
    for one in live[:: max(1, len(live) // 3)]:
        case = context_by_evaluation(knowledge, plan, store, one.at_ns, 60, folder)
        assert shares(diagnose_context(knowledge, case)) == pytest.approx(shares(one), abs=1e-9)
    for one in live[:: max(1, len(live) // 5)]:
        capsys.readouterr()
        assert main(["diagnose", str(folder), "--at", format_time(one.at_ns), "--json"]) in (0, 1)
        shown = json.loads(capsys.readouterr().out)
        assert (shown["origin"], shown["id"], shown["revision"]) == (
            "watcher",
            one.id,
            one.revision,
        )
        found = {h["id"]: h["probability"] for h in shown["hypotheses"]}
        assert found == pytest.approx(shares(one), abs=1e-9)
    counted = _counted(live)
    assert {"rule:whines(motor)", "rule:fails(motor)"} <= counted and counted & {*IDS}


def _counted(live: Sequence[Diagnosis]) -> set[str]:
    return {name for one in live for name in one.symptoms}


def test_another_exposure_is_answered_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(write_folder(tmp_path / "robot"))
    with bench.watched():
        bench.run(3)
        bench.run(3, temperature=90, speed=0)
    bench.box.close()
    found = []
    for hours in ("1", "999"):
        capsys.readouterr()
        assert main(["diagnose", str(bench.folder), "--exposure", hours, "--json"]) == 1
        shown = json.loads(capsys.readouterr().out)
        assert shown["origin"] == "watcher"
        found.append({h["id"]: h["probability"] for h in shown["hypotheses"]})
    assert found[0]["motor#worn"] != pytest.approx(found[1]["motor#worn"], abs=1e-3)


def test_rules_that_fail_stop_no_alarm_and_are_asked_afterwards(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> object:
        raise ValueError("a bug in it")

    folder = write_folder(tmp_path / "robot")
    (folder / "fmea.yaml").write_text(FMEA + FINDINGS)
    (folder / "rules").mkdir()
    (folder / "rules" / "motor.pl").write_text(RULES)
    bench = Bench(folder)
    with monkeypatch.context() as patch, bench.watched():
        patch.setattr(rules, "provide", fails)
        bench.run(2)
        bench.run(3, temperature=90, speed=0)
    bench.box.close()
    (last,) = {one.id: one for one in written(folder)}.values()
    assert last.asked == () and set(last.symptoms) == {"motor/temperature/cool", "fan/speed/turns"}
    written_events = OwnRecords(store_of(folder), "watch", (channels.EVENT, channels.ALARM)).step()
    records = [(record.channel, record.values) for record in written_events]
    said = [values["text"] for _, values in records if values.get("kind") == "evidence_failed"]
    assert said == ["the diagnosis goes on without its rules: ValueError: a bug in it"]
    assert any(channel == channels.ALARM for channel, _ in records)
    capsys.readouterr()
    assert main(["diagnose", str(folder), "--json"]) == 1
    shown = json.loads(capsys.readouterr().out)
    assert "rule:stands(motor)" in {symptom["id"] for symptom in shown["symptoms"]}
