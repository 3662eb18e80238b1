"""The newest records of a journal, and those of a channel that is seldom written to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.journal import channels
from amberbox.blackbox.journal.chunk import Chunk, decode_own_messages
from amberbox.blackbox.journal.scan import chunk_at
from amberbox.blackbox.store import own_records
from amberbox.blackbox.store.own_records import OwnRecords, newest_records
from amberbox.blackbox.store.store import Store, create_store
from amberbox.core.clock import NS
from amberbox.testing.records import T0_NS, FakeRun

STATUSES = {channels.STATUS}


def fill(run: FakeRun, start: int, stop: int) -> None:
    """Write a status each second, and an alarm with every hundredth."""
    for number in range(start, stop):
        run.own(channels.STATUS, T0_NS + number * NS, {"reason": f"{number}" + "x" * 2000})
        if number % 100 == 50:
            run.own(channels.ALARM, T0_NS + number * NS, {"id": f"{number}"})


def numbers(store: Store, lookback_s: float) -> list[int]:
    found = newest_records(store, "watch", STATUSES, lookback_s)
    return [int(record.values["reason"].rstrip("x")) for record in found]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return create_store(tmp_path / "store")


def test_journal_that_is_not_there_has_none(store: Store) -> None:
    assert newest_records(store, "watch", STATUSES, 5) == []
    assert OwnRecords(store, "watch", {channels.ALARM}).step() == []


@pytest.mark.parametrize("is_finished", [True, False])
def test_newest_of_a_file(store: Store, is_finished: bool) -> None:
    run = FakeRun(store.path, "watch")
    fill(run, 0, 300)
    if is_finished:
        run.close()
    assert numbers(store, 3) == [296, 297, 298, 299]
    assert numbers(store, 0) == [299]
    assert numbers(store, 1000) == list(range(300))


@pytest.mark.parametrize("lookback_s", [0, 0.0])
def test_newest_alone_is_found_at_any_instant(store: Store, lookback_s: float) -> None:
    """Instants are in ns, which a float64 cannot always distinguish."""
    run = FakeRun(store.path, "watch")
    for number in range(100):
        run.own(channels.STATUS, T0_NS + number * 10_000_001, {"reason": f"{number}"})
        assert numbers(store, lookback_s) == [number]


def test_newest_go_over_files_and_runs(store: Store) -> None:
    run = FakeRun(store.path, "watch")
    fill(run, 0, 10)
    run.rotate()
    fill(run, 10, 12)
    run.close()
    later = FakeRun(store.path, "watch")
    fill(later, 12, 13)
    assert numbers(store, 4) == [8, 9, 10, 11, 12]


def test_run_that_has_said_nothing_yet_hides_nothing(store: Store) -> None:
    fill(FakeRun(store.path, "watch"), 0, 5)
    FakeRun(store.path, "watch").own(channels.RUN, T0_NS + 9 * NS, {"writer": "watch"})
    assert numbers(store, 1) == [3, 4]


def test_torn_end_hides_nothing_before_it(store: Store) -> None:
    run = FakeRun(store.path, "watch")
    fill(run, 0, 50)
    (path,) = store.journal_files("watch")
    whole = path.read_bytes()
    path.write_bytes(whole[:-60])
    assert numbers(store, 2) == [46, 47, 48]


def test_only_the_end_of_a_file_is_read(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    run = FakeRun(store.path, "watch")
    fill(run, 0, 300)
    monkeypatch.setattr(own_records, "_FIRST_BYTES", 2000)
    seen: list[int] = []
    plain = decode_own_messages

    def counting(chunk: Chunk, wanted: set[str]) -> Any:
        seen.append(chunk.offset)
        return plain(chunk, wanted)

    monkeypatch.setattr(own_records, "decode_own_messages", counting)
    assert numbers(store, 1) == [298, 299]
    assert len(seen) < 100


def test_wall_time_is_log_time_and_what_the_clock_was_off(store: Store) -> None:
    run = FakeRun(store.path, "watch")
    run.clock(T0_NS, 7)
    fill(run, 1, 3)
    written = newest_records(store, "watch", STATUSES, 1)
    assert [record.wall_ns - record.log_ns for record in written] == [7, 7]


def test_own_records_give_each_record_once(store: Store) -> None:
    reader = OwnRecords(store, "watch", {channels.ALARM})
    run = FakeRun(store.path, "watch")
    fill(run, 0, 160)
    assert ids(reader) == ["50", "150"]
    assert ids(reader) == []
    fill(run, 160, 260)
    run.rotate()
    fill(run, 260, 360)
    assert ids(reader) == ["250", "350"]
    run.close()
    assert ids(reader) == []
    assert ids(OwnRecords(store, "watch", {channels.ALARM})) == ["50", "150", "250", "350"]


def ids(reader: OwnRecords) -> list[str]:
    return [record.values["id"] for record in reader.step()]


def test_only_what_holds_them_is_decoded(store: Store) -> None:
    run = FakeRun(store.path, "watch")
    fill(run, 0, 160)
    run.close()
    with counted() as decoded:
        assert ids(OwnRecords(store, "watch", {channels.ALARM})) == ["50", "150"]
    assert len(decoded) == 2


@contextmanager
def counted() -> Iterator[list[int]]:
    """Count the chunks that are decoded."""
    decoded: list[int] = []

    def counting(data: Any, offset: int) -> Any:
        decoded.append(offset)
        return chunk_at(data, offset)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("amberbox.blackbox.store.own_records.chunk_at", counting)
        yield decoded
