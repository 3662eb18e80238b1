"""The process of the detectors: live equals replay, crashes, evidence for the watcher."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.agent import detect as detect_module
from amberbox.agent.detect import (
    ALARM_ITEM,
    CHECKPOINT_FILE,
    DetectProcess,
    changed_ns,
    read_for,
    replayed,
)
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import WriterLock, create_store, finish, open_store, pending
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError
from amberbox.core.given_findings import KIND
from amberbox.detection.alarms import DetectorAlarm
from amberbox.detection.missions import readable_items
from amberbox.detection.model_file import DetectionModel, load_model, save_model
from amberbox.detection.record_detection import Detected
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup
from amberbox.testing.clock import PATIENCE_S, ManualClock, wait_until
from tests.monitoring.watcher.stand import line_of
from tests.monitoring.watcher.stand import written as stand_written
from tests.support.manual_recorder import COUNT, ManualBox, number

RANGE = "guard.range.ros_count.data"


def nominal(box: ManualBox, steps: int, rng: random.Random) -> None:
    """Let a value wander from 0 to 20."""
    for step in range(steps):
        box.hear(COUNT, number(step % 20 + rng.randrange(2)))
        box.write()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a model of 60 s of nominal operation."""
    folder = tmp_path_factory.mktemp("model")
    box = ManualBox(folder / "store")
    nominal(box, 600, random.Random(1))
    box.close()
    file = folder / "count.model"
    assert main(["learn", str(folder / "store"), "-o", str(file), "--false-alarms", "60"]) == 0
    return file


def robot(path: Path) -> Path:
    path.mkdir()
    (path / "robot.yaml").write_text("id: rob\n")
    (path / "black_box.yaml").write_text("- sim:\n    robot: rob\n")
    return path


def process_of(folder: Path, model: Path) -> DetectProcess:
    return DetectProcess(load_folder(folder), create_store(folder / "store"), model)


def step(process: DetectProcess) -> None:
    process._step(threading.Event())


def kill(process: DetectProcess) -> None:
    """Leave everything as ``kill -9`` does."""
    process._lock.release()


def written(store: Path) -> list[tuple[Any, ...]]:
    """Return the alarms and scores of the detectors' journal."""
    record = amberbox.open(store)
    alarms = record.query(ALARM_ITEM, ["at_ns", "id", "state", "onset_ns", "score"])
    found = list(zip(*(alarms.values(n) for n in ("at_ns", "id", "state", "onset_ns", "score")),
                     strict=True))  # fmt: skip
    for name in ("guard", "event_timing"):
        scores = record.query(f"detector_{name}", ["at_ns", "score", "series", "alarms"])
        columns = (scores.values(n) for n in ("at_ns", "score", "series", "alarms"))
        found += [(name, *row) for row in zip(*columns, strict=True)]
    return found


def expected(found: Sequence[Detected]) -> list[tuple[Any, ...]]:
    """Return what a replay found in the same form."""
    rows: list[tuple[Any, ...]] = [
        (changed_ns(a), a.id, "present" if a.gone_ns is None else "absent", a.onset_ns, a.score)
        for a in found if isinstance(a, DetectorAlarm)
    ]  # fmt: skip
    for name in ("guard", "event_timing"):
        rows += [
            (name, one.at_ns, one.score, one.series, one.alarms)
            for one in found if not isinstance(one, DetectorAlarm) and one.detector == name
        ]  # fmt: skip
    return rows


@pytest.mark.parametrize("seed", range(3))
def test_live_equals_replay_through_crashes_and_runs_of_the_recorder(
    tmp_path: Path, model: Path, seed: int
) -> None:
    rng = random.Random(seed)
    folder = robot(tmp_path / "rob")
    clock = ManualClock()
    process = process_of(folder, model)
    for _ in range(2):
        box = ManualBox(folder / "store", clock=clock)
        for at in range(250):
            value = 500 if 100 <= at < 130 else at % 20
            if not 180 <= at < 210:
                box.hear(COUNT, number(value))
            box.write()
            if rng.random() < 0.1:
                step(process)
            if rng.random() < 0.03:
                process._save()
            if rng.random() < 0.03:
                kill(process)
                process = process_of(folder, model)
        box.close()
        clock.advance(5.0)
    step(process)
    kill(process)
    process = process_of(folder, model)
    stopped = threading.Event()
    stopped.set()
    step(process)
    process.run(stopped)

    store = open_store(folder / "store")
    found = list(replayed(read_for(model, store), store))
    assert written(folder / "store") == expected(found)
    with amberbox.open(folder) as record:
        assert readable_items(record) == ("ros_count",)  # nothing of the detectors is learnt
    alarms = [one for one in found if isinstance(one, DetectorAlarm)]
    ids = [alarm.id for alarm in alarms if alarm.gone_ns is None]
    assert ids.count(RANGE) == 2 and "guard.silent.ros_count" in ids
    # a part of a replay is a part of the whole
    for share in (0.25, 0.75):  # in the first run, and in the second
        from_ns, to_ns = changed_ns(found[int(share * len(found))]), changed_ns(found[-1])
        part = list(replayed(read_for(model, store), store, from_ns, to_ns))
        assert part == [one for one in found if from_ns <= changed_ns(one) < to_ns]


def test_findings_that_last_are_left_to_the_watcher(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = robot(tmp_path / "rob")
    box = ManualBox(folder / "store")
    nominal(box, 50, random.Random(1))
    process = process_of(folder, model)
    store = process.store

    monkeypatch.setattr(detect_module, "_TELL_S", 0.0)

    def told() -> list[tuple[str, str]]:
        requests = [one for one in pending(store) if one.kind == KIND]
        for one in requests:
            finish(one)
        return [(one.values["id"], one.values["state"]) for one in requests]

    def detect(value: int, steps: int = 40) -> None:
        for _ in range(steps):
            box.hear(COUNT, number(value))
            box.write()
        step(process)

    detect(700)
    assert told() == []  # nobody would take it
    watcher = WriterLock(store, "watch")
    step(process)
    assert (RANGE, "present") in told()
    detect(700)
    assert RANGE not in dict(told())
    kill(process)
    process = process_of(folder, model)
    detect(700)
    assert (RANGE, "present") in told()
    detect(10, 60)
    assert (RANGE, "absent") in told()
    detect(700)
    assert (RANGE, "present") in told()
    kill(process)
    process = process_of(folder, model)
    detect(10, 60)  # over while nothing detected: still said
    assert (RANGE, "absent") in told()
    detect(700)
    told()
    stopped = threading.Event()
    stopped.set()
    process.run(stopped)
    assert (RANGE, "unknown") in told()
    watcher.release()
    another = WriterLock(store, "watch")
    (store.path / "lock.watch").write_text("1")
    process = process_of(folder, model)
    step(process)
    assert told()  # a watcher that may know nothing is told again
    (store.path / "lock.watch").write_text("2")
    step(process)
    assert (RANGE, "present") in told()
    kill(process)
    another.release()
    box.close()


@pytest.mark.parametrize("damage", ["", "{}", "other model", "half"])
def test_a_checkpoint_of_no_use_begins_anew(tmp_path: Path, model: Path, damage: str) -> None:
    folder = robot(tmp_path / "rob")
    box = ManualBox(folder / "store")
    nominal(box, 100, random.Random(1))
    box.close()
    process = process_of(folder, model)
    step(process)
    process._save()
    kill(process)
    path = folder / "store" / CHECKPOINT_FILE
    saved = json.loads(path.read_bytes())
    other = {**saved, "model": "x"} if damage == "other model" else {**saved, "state": {}}
    path.write_text(json.dumps(other) if damage in ("other model", "half") else damage)
    process = process_of(folder, model)
    asked = [one.values["text"] for one in pending(process.store) if one.kind == "event"]
    assert any("begin anew" in text for text in asked)
    step(process)
    kill(process)
    scores = amberbox.open(folder / "store").query("detector_guard", ["at_ns"]).values("at_ns")
    half = len(scores) // 2
    assert half > 5 and list(scores[:half]) == list(scores[half:])


def test_a_model_that_states_no_items_takes_those_of_the_record(
    tmp_path: Path, model: Path
) -> None:
    """As earlier versions wrote them."""
    found = load_model(model)
    assert found.origin["items"] == ["ros_count"]
    older = tmp_path / "older.model"
    save_model(DetectionModel(found.detectors, {"missions": []}), older)
    with pytest.raises(AmberboxError, match="not known which items"):
        read_for(older, create_store(tmp_path / "empty"))
    box = ManualBox(tmp_path / "store")
    nominal(box, 20, random.Random(1))
    box.close()
    assert read_for(older, open_store(tmp_path / "store")).items == {"ros_count"}


SIM = """\
- sim:
    {{seed: 3, speed: {speed}, duration_s: {seconds}, topics: [{{topic: {{name: battery}}}}],
     faults: [{faults}]}}
"""


def recorded(path: Path, speed: str, seconds: int, faults: str) -> Path:
    path.mkdir()
    (path / "robot.yaml").write_text("id: r1\nstore: {path: store}\n")
    (path / "black_box.yaml").write_text(SIM.format(speed=speed, seconds=seconds, faults=faults))
    return path


def test_a_planted_fault_is_found_live_through_kill_9_as_in_a_replay(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The programs themselves: recorder, detectors, ``kill -9``, SIGTERM."""
    nominal_robot = recorded(tmp_path / "nominal", "max", 60, "")
    folder = recorded(tmp_path / "r1", "20", 60, "{id: battery_overheats, at_s: 30}")
    file = str(tmp_path / "r1.model")
    assert main(["record", str(nominal_robot), "--quiet"]) == 0
    assert main(["learn", str(nominal_robot), "-o", file, "--detectors", "guard"]) == 0

    def detecting() -> subprocess.Popen[str]:
        words = [sys.executable, "-m", "amberbox", "detect", str(folder), file, "--json"]
        return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)

    def has_scores() -> bool:
        store = folder / "store"
        if not (store / CHECKPOINT_FILE).exists():
            return False
        return "detector_guard" in {item.name for item in amberbox.open(store).items()}

    first = detecting()
    second = None
    recorder = subprocess.Popen(
        [sys.executable, "-m", "amberbox", "record", str(folder), "--quiet"]
    )
    try:
        wait_until(has_scores, "there are scores")
        first.kill()
        first.wait(PATIENCE_S)
        second = detecting()
        assert recorder.wait(PATIENCE_S) == 0
        capfd.readouterr()
        assert main(["detect", str(folder), file, "--replay", "--json"]) == 0
        replay = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
        ids = [alarm["id"] for alarm in replay if alarm["gone_ns"] is None]
        assert "guard.range.sim_battery.temperature" in ids

        def all_written() -> bool:
            items = {item.name: item.rows for item in amberbox.open(folder / "store").items()}
            return items.get(ALARM_ITEM, 0) >= len(replay)

        wait_until(all_written, "all alarms are written")
        second.send_signal(signal.SIGTERM)
        assert second.wait(PATIENCE_S) == 0
    finally:
        for one in (first, second, recorder):
            if one is not None:
                one.kill()
                one.wait(PATIENCE_S)
    live = amberbox.open(folder / "store").query(ALARM_ITEM, ["id", "onset_ns"])
    assert list(live.values("id")) == [alarm["id"] for alarm in replay]
    assert list(live.values("onset_ns")) == [alarm["onset_ns"] for alarm in replay]


def test_mistakes_are_explained(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = robot(tmp_path / "rob")
    damaged = tmp_path / "damaged.model"
    damaged.write_bytes(model.read_bytes()[:2000])
    for arguments, status, text in (
        ([str(folder), str(damaged)], 1, "no usable model file"),
        ([str(folder), str(tmp_path / "none.model")], 1, "cannot read"),
        ([str(tmp_path / "nowhere"), str(model)], 2, "no robot folder"),
        ([str(folder), str(model), "--from", "-1m"], 2, "add --replay"),
        ([str(tmp_path / "nowhere"), str(model), "--replay"], 2, "nothing at"),
    ):
        assert main(["detect", *arguments]) == status
        shown = capsys.readouterr().err
        assert text in shown and "hint:" in shown
    process = process_of(folder, model)
    assert main(["detect", str(folder), str(model)]) == 2
    assert "Traceback" not in capsys.readouterr().err
    kill(process)


MODE = """\
name: usual_monitor
monitor: range
mappings:
  - mapping:
      inputs: [{address}]
      outputs: [{{output: {{name: usual, type: bool, expected: true}}}}]
arguments: {{max: 1}}
"""


def with_mode(folder: Path, model: Path, address: str) -> Path:
    (folder / "robot.yaml").write_text(f"id: rob\ndetection: {{model: {model}}}\n")
    (folder / "components" / "counter").mkdir(parents=True, exist_ok=True)
    text = "component_name: counter\nmodes: [counter/usual.yaml]\n"
    (folder / "components" / "counter.yaml").write_text(text)
    (folder / "components" / "counter" / "usual.yaml").write_text(MODE.format(address=address))
    return folder


@pytest.mark.parametrize("seed", range(2))
def test_modes_read_scores_live_as_in_a_replay(tmp_path: Path, model: Path, seed: int) -> None:
    """However late the detectors are, and whoever is killed."""
    rng = random.Random(seed)
    folder = with_mode(robot(tmp_path / "rob"), model, "detector_combined.ros_count")
    clock = ManualClock()
    options = PipelineOptions(boot_id=clock.boot_id())
    box = ManualBox(folder / "store", clock=clock, options=options)
    loaded = load_folder(folder)
    plan, problems = load_plan(loaded)
    assert not [problem for problem in problems if problem.is_error]
    setup = WatcherSetup(
        plan, create_store(folder / "store"), loaded, clock=clock, clock_s=lambda: clock.boot / 1e9
    )
    box.write()
    watcher, process = RecordWatcher(setup), process_of(folder, model)
    levels: list[str] = []
    for at in range(300):
        box.hear(COUNT, number(500 if 100 <= at < 150 else at % 20))
        box.write()
        if rng.random() < 0.3:
            step(process)
        watcher.step()
        levels += [one.level for one in watcher._engine.statuses() if one.mode]
        if rng.random() < 0.02:
            kill(process)
            process = process_of(folder, model)
        if rng.random() < 0.02:
            watcher._lock.release()
            watcher = RecordWatcher(setup)
    box.close()
    watcher.step()
    watcher.close()
    kill(process)
    assert {"ok", "error"} <= {*levels}
    again = [line_of(found) for found in replay(plan, open_store(folder / "store"))]
    live = stand_written(folder / "store")
    assert again == [line for line in live if b'"kind":"finding"' not in line]


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("detector_guad.score", "'detector_guad.score'; did you mean 'detector_guard'"),
        ("detector_guard.scor", "no variable 'scor'"),
        ("detector_combined.ros_cuont", "did you mean 'ros_count'"),
    ],
)
def test_check_knows_the_items_of_the_detectors(
    tmp_path: Path, model: Path, address: str, message: str
) -> None:
    folder = with_mode(robot(tmp_path / "rob"), model, address)
    _, problems = load_plan(load_folder(folder))
    assert any(message in problem.what for problem in problems), problems


def test_without_its_model_a_folder_takes_any_item_of_detectors(tmp_path: Path) -> None:
    """As on a server, which has no model file."""
    folder = with_mode(robot(tmp_path / "rob"), tmp_path / "none.model", "detector_combined.x")
    plan, problems = load_plan(load_folder(folder))
    assert not [problem for problem in problems if problem.is_error], problems
    assert [entry.address for entry in plan.inputs()] == ["watch_detector_combined.x"]
