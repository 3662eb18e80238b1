"""A source in a process of its own: however it dies, it costs its own gap and nothing else."""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.recorder import source_process
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store import journal_reader
from amberbox.core.clock import NS, SystemClock
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink
from tests.support.manual_recorder import (
    COUNT,
    ManualBox,
    event_texts,
    events,
    last_counters,
    number,
    raw_messages,
    recording,
)
from tests.support.planted_source import Death, plant
from tests.support.processes import command, wait_for

AFTER = 2000
STEADY = "- planted: {name: steady, process: false, after: 500}\n"


@pytest.fixture(autouse=True)
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(tmp_path / "site", monkeypatch, planted="tests.support.planted_source")


def robot(place: Path, black_box: str, robot_yaml: str = "id: r\n") -> Path:
    folder = place / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text(robot_yaml)
    (folder / "black_box.yaml").write_text(black_box)
    return folder


def numbers(store: Path, topic: str = "/count") -> list[int]:
    return [int.from_bytes(data[:8], "little") for data in raw_messages(store, topic)]


def values(folder: Path, item: str) -> list[int]:
    return amberbox.open(folder).query(item).values("data")


def kept(recorder: Recorder, item: str) -> int:
    found = recorder.pipeline.items.get(item)
    return 0 if found is None else found.counters.kept


REASONS: dict[Death, str] = {
    "abort": "the process of the source ended by signal 6 (SIGABRT)",
    "segv": "the process of the source ended by signal 11 (SIGSEGV)",
    "kill": "the process of the source ended by signal 9 (SIGKILL)",
    "exit": "the process of the source ended with status 3",
    "error": "dying failed",
    "frozen": "the process of the source showed no life for 4 s and was ended",
    "deaf": "the process of the source showed no life for 4 s and was ended",
    "garbage": "the process of the source sent what cannot be taken",
    "children": "the process of the source ended by signal 6 (SIGABRT)",
}


@pytest.mark.parametrize("death", REASONS)
def test_a_death_costs_the_gap_of_its_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, death: Death
) -> None:
    if "no life" in REASONS[death]:
        monkeypatch.setattr(source_process, "SILENT_S", 4.0)
    monkeypatch.setenv("PLANTED_CHILD", str(tmp_path / "child"))
    block = f"- planted: {{name: dying, after: {AFTER}, death: {death}}}\n"
    with recording(robot(tmp_path, block + STEADY)) as recorder:
        wait_until(lambda: kept(recorder, "dying_count") == 2 * AFTER, "a second run")
        wait_until(lambda: kept(recorder, "steady_count") == 500, "the other source")
    folder = tmp_path / "robot"
    assert values(folder, "dying_count") == list(range(2 * AFTER))
    assert values(folder, "steady_count") == list(range(500))
    (event,) = events(folder / "store", "source_failed")
    assert event["source"] == "dying"
    record = amberbox.open(folder)
    (gap,) = (gap for gap in record.gaps("dying_count") if gap.peer == "counter")
    assert gap.reason.startswith(REASONS[death])
    times = record.query("dying_count", ["received"]).values("received")
    before, after = times[AFTER - 1], times[AFTER]
    assert before <= gap.from_ns < gap.to_ns
    assert gap.to_ns - after < 1e9
    assert not [gap for gap in record.gaps("steady_count") if gap.reason in REASONS[death]]
    counters = last_counters(folder / "store")["dying_count"]
    assert (counters["received"], counters["dropped"]) == (2 * AFTER, 0)
    if death == "error":
        assert "the device is gone" in event["text"]
    if death == "children":
        assert has_ended(int((tmp_path / "child").read_text()))


def has_ended(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in "ZX"


class BlockedSink(MemorySink):
    """A recorder that is held up."""

    def __init__(self) -> None:
        super().__init__(longest_bytes=1_000_000)
        self.goes_on = threading.Event()

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        self.goes_on.wait()
        super().message(stream, data, received_ns)


def test_a_flood_is_dropped_in_the_process_while_the_recorder_is_held_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = tmp_path / "done"
    monkeypatch.setenv("PLANTED_DONE", str(done))
    node = parse_yaml("{after: 20000, bytes: 1000}", "black_box.yaml", [])
    assert node is not None
    module = "tests.support.planted_source"
    source = source_process.SourceProcess(module, "planted", "planted", node, tmp_path)
    sink, stop = BlockedSink(), threading.Event()
    thread = threading.Thread(target=source.run, args=(sink, stop))
    thread.start()
    wait_until(done.exists, "the source has not waited for the recorder")
    sink.goes_on.set()
    wait_until(lambda: sink.saved.get("next") == 20_000, "all is passed on")
    wait_until(lambda: sink.drops, "the drops are counted")
    stop.set()
    thread.join(PATIENCE_S)
    ((topic, from_ns, to_ns, count),) = sink.drops
    came = [int.from_bytes(data[:8], "little") for data in sink.of("/count")]
    assert came == sorted(set(came))
    assert len(came) >= 2000  # the pipe, and the room of 1 MB
    assert (topic, len(came) + count) == ("/count", 20_000)
    assert sink.messages[0][2] < from_ns < to_ns


def test_drops_of_a_process_are_those_of_the_queue(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    stream, at_ns = box.sink.topic(COUNT), box.sink.now_ns()
    box.sink.dropped(stream, at_ns + 1, at_ns + 9, 7)
    box.write()
    box.close()
    counters = last_counters(box.store)["ros_count"]
    assert (counters["received"], counters["kept"], counters["dropped"]) == (8, 1, 7)
    (gap,) = (gap for gap in amberbox.open(box.store).gaps("ros_count") if gap.count)
    assert (gap.reason, gap.count) == ("dropped: queue full", 7)
    assert (gap.from_ns, gap.to_ns) == (at_ns + 1, at_ns + 10)


def test_large_messages_arrive_whole(tmp_path: Path) -> None:
    size = 5_000_000
    block = f"- planted: {{after: 6, bytes: {size}, every_s: 0.1}}\n"
    with recording(robot(tmp_path, block)) as recorder:
        wait_until(lambda: kept(recorder, "planted_count") == 6, "all six")
    found = raw_messages(tmp_path / "robot" / "store", "/count")
    assert found == [n.to_bytes(8, "little") + bytes(size - 8) for n in range(6)]


def test_state_and_latched_messages_survive_the_process(tmp_path: Path) -> None:
    block = "- planted: {after: 3, death: abort, latched: true, says: hello}\n"
    with recording(robot(tmp_path, block)) as recorder:
        wait_until(lambda: kept(recorder, "planted_count") == 6, "the second run")
    store = tmp_path / "robot" / "store"
    assert numbers(store) == list(range(6))
    assert event_texts(store, "latched") == [
        "the last one was None",
        f"the last one was {number(2)!r}",
    ]
    lines = event_texts(store, "source_output")
    assert lines[0] == "planted: hello"
    assert any("Fatal Python error: Aborted" in line for line in lines)


class SteppingClock(SystemClock):
    """The machine's clocks, with a wall clock that is set."""

    ahead_ns = 0

    def wall_ns(self) -> int:
        return super().wall_ns() + self.ahead_ns


def test_a_step_of_the_clock_reaches_the_process(tmp_path: Path) -> None:
    clock = SteppingClock()
    folder = robot(tmp_path, "- planted: {after: 100000, every_s: 0.005}\n")
    recorder = Recorder(load_folder(folder), clock, retention=False)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    wait_until(lambda: kept(recorder, "planted_count") > 50, "some before")
    clock.ahead_ns = 3600 * NS
    wait_until(lambda: events(folder / "store", "clock_step"), "the step")
    before = kept(recorder, "planted_count")
    wait_until(lambda: kept(recorder, "planted_count") > before + 100, "some after")
    recorder.stop.set()
    thread.join(PATIENCE_S)
    assert not events(folder / "store", "late")
    found = numbers(folder / "store")
    assert found == list(range(len(found)))
    (step,) = events(folder / "store", "clock_step")
    times = np.array(
        [
            time_ns
            for batch in journal_reader.batches(folder / "store", ["planted_count"])
            for time_ns in batch.log_time_ns.tolist()
        ]
    )
    assert step
    (place,) = np.flatnonzero(np.diff(times) > 3000 * NS).tolist()
    assert np.all(np.diff(times) >= 0)
    assert place > 50


@contextmanager
def recorder_process(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Run ``amberbox record``; yield it with the id of the process of its source."""
    process = subprocess.Popen(command("record", "--quiet", folder))
    try:
        state = folder / "store" / "state" / "planted.json"
        wait_until(state.exists, "the source runs")
        yield process, json.loads(state.read_text())["pid"]
    finally:
        process.kill()
        process.wait(PATIENCE_S)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_process_ends_with_the_recorder(tmp_path: Path, number: signal.Signals) -> None:
    folder = robot(tmp_path, "- planted: {after: 100000, every_s: 0.005}\n")
    with recorder_process(folder) as (process, child):
        assert not has_ended(child)
        process.send_signal(number)
        process.wait(PATIENCE_S)
        wait_until(lambda: has_ended(child), "the source's process has ended, too")
    if number == signal.SIGTERM:
        assert not events(folder / "store", "source_failed")
        (stopped,) = events(folder / "store", "stopped")
        assert stopped["details"]["stuck"] == []


def _stall_over(store: Path, at_ns: int) -> tuple[int, int] | None:
    """Return the stall of the recorder that an instant lies in: a busy computer makes others."""
    spans = [event["details"] for event in events(store, "recorder_stalled")]
    found = [(span["from_ns"], span["to_ns"]) for span in spans]
    return next(((start, end) for start, end in found if start <= at_ns <= end), None)


def test_times_of_receipt_are_kept_while_the_recorder_stands_still(tmp_path: Path) -> None:
    folder = robot(tmp_path, "- planted: {after: 100000, every_s: 0.02}\n")
    with recorder_process(folder) as (process, _):
        wait_until(lambda: numbers(folder / "store"), "messages are recorded")
        process.send_signal(signal.SIGSTOP)
        inside_ns = time.time_ns() + NS
        time.sleep(3.0)
        process.send_signal(signal.SIGCONT)
        stall = wait_for(lambda: _stall_over(folder / "store", inside_ns), "its stall is recorded")
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)
    record = amberbox.open(folder)
    found = record.query("planted_count", ["received", "data"])
    assert found.values("data") == list(range(len(found.values("data"))))
    from_ns, to_ns = stall
    times = np.array(found.values("received"))
    inside = times[(times > from_ns) & (times < to_ns)]
    assert to_ns - from_ns > 2 * NS
    assert len(inside) > 50
    assert np.percentile(np.diff(inside), 90) < NS // 10
    assert not events(folder / "store", "late")
