"""Monitors and diagnosis together: however calls are split, wherever it is killed, the same."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.journal.writer import JournalOptions
from amberbox.blackbox.store.store import open_store, submit
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Symptom
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import AlarmChange, instant_of
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.record_evaluation import (
    PART,
    DiagnosedEngine,
    RecordEvaluation,
    ReplayOptions,
    blocks,
    end_of_record,
    replay,
)
from amberbox.monitoring.record_reader import RecordBlock
from amberbox.monitoring.watcher import RecordWatcher
from amberbox.monitoring.watcher_journal import RetainedFindings, retained_findings
from tests.monitoring.watcher.diagnoser import ITEM, NEGATIVE, PlainDiagnoser
from tests.monitoring.watcher.stand import (
    NUMBERS,
    Stand,
    component,
    kill,
    line_of,
    plan_of,
    positive,
    values_of,
    variable,
    written,
)
from tests.support.manual_recorder import events


def stand_of(path: Path, seed: int) -> Stand:
    return Stand(path / "store", seed, diagnoser=PlainDiagnoser)


def base_only(config_hash: str = "hash") -> MonitoringPlan:
    return MonitoringPlan("robot", config_hash, [component("base", positive, variable("ros_main"))])


def say(stand: Stand, ticks: int, main: float, bulk: float = 1.0) -> None:
    for _ in range(ticks):
        stand.box.hear(NUMBERS["main"], struct.pack("<d", main))
        stand.box.hear(NUMBERS["bulk"], struct.pack("<d", bulk))
        stand.box.write(0.1)


def live(stand: Stand, watcher: RecordWatcher, ticks: int, main: float) -> None:
    for _ in range(ticks):
        say(stand, 1, main)
        watcher.step()


def channel(stand: Stand, name: str, *, live_only: bool = False) -> Sequence[Mapping[str, Any]]:
    return values_of(written(stand.path, live_only=live_only), f"amberbox/{name}")


@pytest.mark.parametrize("seed", range(3))
def test_killed_at_any_moment_no_diagnosis_is_lost_or_doubled(tmp_path: Path, seed: int) -> None:
    """The recorder restarts, its clock is set; the watcher is killed amid all this."""
    stand = stand_of(tmp_path, 30 + seed)
    stand.watch_with_kills(120, [-3600, 2, 3600], killed=0.04, ended=0.02, measured=0.06)
    found, replayed = written(stand.path), stand.replayed()
    assert len(channel(stand, "diagnosis")) > 10
    assert any(symptom["id"] == NEGATIVE for symptom in channel(stand, "symptom"))
    assert any(alarm["cause"] for alarm in channel(stand, "alarm"))
    assert found == replayed


def test_items_that_only_conditions_read_are_read(tmp_path: Path) -> None:
    stand = stand_of(tmp_path, 1)
    say(stand, 10, 1.0, 1.0)
    say(stand, 10, 1.0, -1.0)
    stand.box.close()
    found = list(replay(base_only(), open_store(stand.path), diagnoser=PlainDiagnoser))
    assert ITEM not in Engine(base_only()).items
    (negative,) = [one for one in found if isinstance(one, Symptom) and one.id == NEGATIVE]
    assert negative.state == "present"
    assert list(map(instant_of, found)) == sorted(map(instant_of, found))
    last = end_of_record(base_only(), open_store(stand.path), PlainDiagnoser)
    assert last.diagnosis is not None
    assert last.diagnosis.symptoms == (NEGATIVE,)
    assert end_of_record(base_only(), open_store(stand.path)).diagnosis is None


def pieces_of(block: RecordBlock, stand: Stand) -> list[RecordBlock]:
    """Divide a block: all rows are in the first part."""
    cuts = sorted(stand.random.uniform(block.start_ns, block.until_ns) for _ in range(4))
    ends = [*(round(cut) for cut in cuts), block.until_ns]
    first, *others = ends
    head = RecordBlock(block.epoch, block.start_ns, block.batches, first)
    return [head, *(RecordBlock(block.epoch, block.start_ns, [], end) for end in others)]


@pytest.mark.parametrize("seed", range(3))
def test_how_calls_are_split_does_not_matter(tmp_path: Path, seed: int) -> None:
    stand = stand_of(tmp_path, 40 + seed)
    for _ in range(100):
        stand.tick()
    stand.box.close()
    store = open_store(stand.path)
    engine = DiagnosedEngine(Engine(plan_of()), PlainDiagnoser())
    evaluation, found = RecordEvaluation(engine), []
    for block in blocks(plan_of(), store, engine, ReplayOptions()):
        for piece in pieces_of(block, stand):
            found += [line_of(f) for new in evaluation.take(piece) for f in new]
    assert any(b"amberbox/diagnosis" in line for line in found)
    assert found == stand.replayed()


def test_an_alarm_gets_its_cause_and_loses_it_again(tmp_path: Path) -> None:
    stand = stand_of(tmp_path, 1)
    say(stand, 20, 1.0)
    say(stand, 20, -1.0)
    say(stand, 20, -1.0, -1.0)
    say(stand, 20, 1.0)
    stand.box.close()
    found = list(replay(base_only(), open_store(stand.path), diagnoser=PlainDiagnoser))
    alarms = [one for one in found if isinstance(one, AlarmChange)]
    diagnoses = [one for one in found if isinstance(one, Diagnosis)]
    assert [(a.state, a.cause) for a in alarms] == [
        ("open", ""),
        ("open", "base#broken (very likely)"),
        ("healed", "base#broken (very likely)"),
    ]
    assert {a.id for a in alarms} == {alarms[0].id}
    assert alarms[1].changed_ns == diagnoses[0].at_ns, "the second fault is not its own"
    assert {a.diagnosis for a in alarms[1:]} == {diagnoses[0].id}
    assert [d.state for d in diagnoses] == ["open", "open", "healed"]


def test_a_snapshot_without_diagnosis_begins_it_anew(tmp_path: Path) -> None:
    stand = stand_of(tmp_path, 1)
    say(stand, 20, -1.0)
    stand.box.close()
    engine = DiagnosedEngine(Engine(base_only()), PlainDiagnoser())
    evaluation = RecordEvaluation(engine)
    for block in blocks(base_only(), open_store(stand.path), engine, ReplayOptions()):
        assert list(evaluation.take(block))
    assert engine.diagnosis is not None
    held = engine.snapshot()
    again = DiagnosedEngine(Engine(base_only()), PlainDiagnoser())
    again.resume(held)
    assert again.snapshot() == held
    del held[PART]
    older = DiagnosedEngine(Engine(base_only()), PlainDiagnoser())
    older.resume(held)
    assert older.diagnosis is None
    assert [alarm.cause for alarm in older.alarms()] == [""]
    assert [alarm.cause for alarm in again.alarms()] == ["base#broken (very likely)"]


def test_other_monitors_close_what_the_ones_before_left_open(tmp_path: Path) -> None:
    """With a changed configuration the open diagnosis is not continued: it ends."""
    stand = stand_of(tmp_path, 1)
    say(stand, 1, 1.0)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 20, -1.0)
    watcher.close()
    (opened,) = channel(stand, "diagnosis")
    assert opened["state"] == "open"
    stand.diagnoser = None
    watcher = stand.watcher(base_only("other"))
    live(stand, watcher, 5, -1.0)
    watcher.close()
    (over,) = channel(stand, "diagnosis", live_only=True)
    assert (over["id"], over["state"], over["revision"]) == (opened["id"], "healed", 2)
    assert over["at_ns"] > opened["at_ns"]
    (alarm,) = retained_findings(open_store(stand.path)).alarms.values()
    assert (alarm.state, alarm.cause, alarm.diagnosis) == ("open", "", "")


def test_a_diagnosis_that_new_monitors_make_in_silence_is_written(tmp_path: Path) -> None:
    stand = stand_of(tmp_path, 1)
    stand.diagnoser = None
    say(stand, 1, 1.0)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 20, -1.0)
    watcher.close()
    stand.diagnoser = PlainDiagnoser
    watcher = stand.watcher(base_only())
    live(stand, watcher, 5, -1.0)
    watcher.close()
    *_, now = channel(stand, "diagnosis", live_only=True)
    assert now["state"] == "open"
    assert now["hypotheses"][0]["faults"] == ["base#broken"]
    (alarm,) = retained_findings(open_store(stand.path)).alarms.values()
    assert (alarm.state, alarm.diagnosis) == ("open", now["id"])


def test_each_file_begins_with_the_open_diagnosis_and_the_causes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = partial(JournalOptions, rotate_ns=2 * NS)
    monkeypatch.setattr("amberbox.blackbox.store.derived_journal.JournalOptions", options)
    stand = stand_of(tmp_path, 1)
    say(stand, 1, 1.0)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 60, -1.0)
    store = open_store(stand.path)
    *old, _ = store.journal_files("watch")
    assert len(old) > 1
    for path in old:
        path.unlink()
    before = retained_findings(store)
    (diagnosis,) = before.diagnoses.values()
    (alarm,) = before.alarms.values()
    assert (alarm.cause, alarm.diagnosis) == ("base#broken (very likely)", diagnosis.id)
    kill(watcher)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 5, -1.0)
    live(stand, watcher, 10, 1.0)
    watcher.close()
    assert retained_findings(store).diagnoses == {}
    assert channel(stand, "diagnosis")[-1]["state"] == "healed"


def test_what_people_said_stays_when_the_cause_comes(tmp_path: Path) -> None:
    stand = stand_of(tmp_path, 1)
    say(stand, 1, 1.0)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 20, -1.0)
    (known,) = retained_findings(open_store(stand.path)).alarms.values()
    request = {"action": "acknowledge", "id": known.id, "who": "anna"}
    submit(open_store(stand.path), "alarm", request)
    live(stand, watcher, 5, -1.0)
    for _ in range(10):
        say(stand, 1, -1.0, -1.0)
        watcher.step()
    (alarm,) = retained_findings(open_store(stand.path)).alarms.values()
    assert (alarm.state, alarm.who) == ("acknowledged", "anna")
    assert alarm.cause == "base#broken (very likely)"
    stand.box.close()
    watcher.step()
    watcher.close()
    assert written(stand.path) == stand.replayed(base_only())


class Failing(PlainDiagnoser):
    """Makes a diagnosis and fails at the next."""

    def _diagnosis(self, at_ns: int, *, new: bool) -> Diagnosis:
        if not new:
            raise ZeroDivisionError("by nothing")
        return super()._diagnosis(at_ns, new=new)


def test_a_diagnosis_that_fails_is_over_and_the_monitors_go_on(tmp_path: Path) -> None:
    stand = stand_of(tmp_path, 1)
    stand.diagnoser = Failing
    say(stand, 1, 1.0)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 20, -1.0)
    for _ in range(10):
        say(stand, 1, -1.0, -1.0)
        watcher.step()
    kill(watcher)
    watcher = stand.watcher(base_only())
    live(stand, watcher, 20, 1.0)
    watcher.close()
    assert {e["text"] for e in events(stand.path, "diagnosis_failed")} == {
        "goes on without diagnosis, which has failed: ZeroDivisionError: by nothing"
    }
    (first,) = channel(stand, "diagnosis")
    assert channel(stand, "diagnosis", live_only=True)[-1]["id"] == first["id"]
    assert retained_findings(open_store(stand.path)) == RetainedFindings()
    assert channel(stand, "alarm")[-1]["state"] == "healed"
    with pytest.raises(ZeroDivisionError):
        stand.replayed(base_only())
