"""External power lost: sync at once and often, an incident; a low battery ends the run cleanly."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.queue import ItemCounters
from amberbox.blackbox.recorder.recorder import PowerWatch, Recorder, Syncer
from amberbox.blackbox.store import journal_reader, store
from amberbox.blackbox.store.store import open_store
from amberbox.core.source import Power
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import COUNT, ManualBox, events, number, recording

BOX = "- ros: {ros_master_uri: 'http://127.0.0.1:1', topics: [{name: /count}]}\n"


class SyncNotes(Syncer):
    """Records the calls of the syncer."""

    def __init__(self, box: ManualBox) -> None:
        super().__init__(box.pipeline, 1.0)
        self.asked: list[tuple[str, float]] = []

    def every(self, sync_s: float) -> None:
        self.asked.append(("every", sync_s))
        super().every(sync_s)

    def at_once(self, sync_s: float) -> None:
        self.asked.append(("at once", sync_s))
        super().at_once(sync_s)


def watched(store: Path, *states: Power) -> tuple[list[bool], SyncNotes, ManualBox]:
    """Let a source report the states of the supply; return when the run has to end."""
    box = ManualBox(store)
    syncer = SyncNotes(box)
    watch = PowerWatch(box.pipeline, syncer, 1.0)
    ends = [watch.ends_run()]
    for state in states:
        box.sink.power(state, f"now on {state}")
        ends.append(watch.ends_run())
        assert not watch.ends_run()
    watch.stop()
    box.close()
    return ends, syncer, box


def test_lost_power_hurries_the_syncs_and_asks_for_an_incident(tmp_path: Path) -> None:
    ends, syncer, box = watched(tmp_path / "store", "mains", "battery", "mains")
    assert ends == [False] * 4
    assert syncer.asked == [("every", 1.0), ("at once", 0.2), ("every", 1.0)]
    (request,) = store.pending(open_store(box.store))
    assert request.kind == "incident"
    assert request.values == {
        "before_s": 60, "after_s": 20, "reason": "external power lost", "who": "recorder",
        "trigger": "power",
    }  # fmt: skip
    assert [e["text"] for e in events(box.store, "power_battery")] == ["now on battery"]


STATES: list[tuple[list[Power], bool, int]] = [
    (["mains", "battery", "low"], True, 1),
    (["mains", "low"], True, 1),
    (["battery", "low"], True, 0),
    (["low"], False, 0),
    (["low", "mains"], False, 0),
]


@pytest.mark.parametrize(("states", "ends", "incidents"), STATES)
def test_a_low_battery_ends_a_run_but_not_one_that_begins_with_it(
    tmp_path: Path, states: list[Power], ends: bool, incidents: int
) -> None:
    asked, _, box = watched(tmp_path / "store", *states)
    assert (asked[-1], any(asked[:-1])) == (ends, False)
    assert len(store.pending(open_store(box.store))) == incidents


def test_a_request_that_cannot_be_left_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store, "submit", refuse)
    _, _, box = watched(tmp_path / "store", "mains", "battery")
    (event,) = events(box.store, "disk")
    assert event["text"].endswith("is not marked: No space left on device")


def robot(folder: Path, sync_s: float) -> Path:
    folder.mkdir()
    (folder / "robot.yaml").write_text(f"id: r\nstore: {{sync_s: {sync_s}}}\n")
    (folder / "black_box.yaml").write_text(BOX)
    return folder


def test_on_battery_what_is_heard_is_soon_durable(tmp_path: Path) -> None:
    def durable(recorder: Recorder) -> int:
        return recorder.pipeline._journals._writers["main"].durable_seq

    with recording(robot(tmp_path / "robot", 60.0)) as recorder:
        sink = recorder._sources[0]
        wait_until(lambda: sink._sink is not None, "the source runs")
        assert sink._sink is not None
        sink._sink.power("mains", "on")
        wait_until(lambda: recorder.pipeline.bytes_written, "a file")
        assert durable(recorder) == 0
        sink._sink.power("battery", "off")
        wait_until(lambda: durable(recorder) > 0, "a sync at once")
        for _ in range(3):
            before = durable(recorder)
            sink._sink.message(sink._sink.topic(COUNT), number(1), sink._sink.now_ns())
            wait_until(partial(_is_beyond, durable, recorder, before), "a sync soon")


def _is_beyond(value: Callable[[Recorder], int], recorder: Recorder, before: int) -> bool:
    return value(recorder) > before


def _has_kept(counters: ItemCounters, n: int) -> bool:
    return counters.kept > n


def test_a_low_battery_leaves_finished_files(tmp_path: Path) -> None:
    with recording(robot(tmp_path / "robot", 60.0)) as recorder:
        source = recorder._sources[0]
        wait_until(lambda: source._sink is not None, "the source runs")
        assert source._sink is not None
        source._sink.power("battery", "off")
        for n in range(2):
            source._sink.message(source._sink.topic(COUNT), number(n), source._sink.now_ns())
            kept = recorder.pipeline.items["ros_count"].counters
            wait_until(partial(_has_kept, kept, n), "a write, and one more")
        source._sink.power("low", "10 %")
        wait_until(recorder.stop.is_set, "the end of the run")
    (stopped,) = events(tmp_path / "robot" / "store", "stopped")
    assert stopped["text"] == "recording stopped: the battery is low"
    assert all(
        journal.finished for journal in journal_reader.journals(tmp_path / "robot" / "store")
    )
