"""The book of clocks: unsynchronised starts, steps and slews are put right when read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.gaps import corrected_gap
from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.signing.signatures import seal_journals
from amberbox.blackbox.store.catalogue import read_catalogue
from amberbox.blackbox.store.clocks import (
    ClockBook,
    ClockReading,
    ClockTable,
    JournalClock,
    book_of,
    simplified,
)
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.segment_builder import build_segments
from amberbox.blackbox.store.store import create_store, open_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Gap, IntArray
from amberbox.testing.records import FakeItem, FakeRun

MS = 1_000_000
TRUTH = 1_790_000_000 * NS
TICK = FakeItem("tick", [{"n": 1}])


@dataclass
class Computer:
    """A computer whose wall clock is set and turned; it is recorded as the recorder does it.

    ``ahead`` is wall clock minus time since boot; the truth is ``TRUTH`` plus time since boot.
    """

    ahead: int = 0
    synchronised: bool | None = False
    boot_ns: int = 30 * NS
    rate: float = 0.0
    files: list[list[ClockReading]] = field(default_factory=list)
    rows: list[list[int]] = field(default_factory=list)
    base: int = 0
    _seen: tuple[int, int] = (0, 0)
    _written_ns: int = 0
    _written: int = 0

    def start(self) -> Computer:
        self._new_file()
        return self

    def pass_time(self, seconds: float) -> None:
        """Let time pass in ticks of 0.1 s; a row each."""
        for _ in range(round(seconds * 10)):
            self.boot_ns += 100 * MS
            self.ahead += round(100 * MS * self.rate)
            self._tick()

    def step(self, seconds: float) -> None:
        self.ahead += round(seconds * NS)

    def clocks(self, boot: str = "0000000a", run: int = 1) -> list[JournalClock]:
        return [
            JournalClock(f"journal/{run}-{boot}-{number}.mcap", boot, run, tuple(readings))
            for number, readings in enumerate(self.files)
        ]

    def truth(self, shift_ns: int = TRUTH) -> IntArray:
        rows = [
            np.array(rows, np.int64) - base
            for rows, base in zip(self.rows, self._bases, strict=True)
        ]
        return np.concatenate(rows) + shift_ns

    @property
    def _bases(self) -> list[int]:
        return [(f[0].log_ns - (f[0].boot_ns or 0)) for f in self.files]

    def _new_file(self) -> None:
        self.base = self.ahead
        self.files.append([])
        self.rows.append([])
        self._read(self.boot_ns, self.ahead)

    def _read(self, boot_ns: int, ahead: int) -> None:
        reading = ClockReading(boot_ns + self.base, ahead - self.base, self.synchronised, boot_ns)
        self.files[-1].append(reading)
        self._written_ns, self._written = boot_ns, ahead

    def _tick(self) -> None:
        change = abs(self.ahead - self._written)
        if change > NS:
            self._new_file()
        elif change > 50 * MS:
            self._read(*self._seen)
            self._read(self.boot_ns, self.ahead)
        elif self.boot_ns - self._written_ns >= 10 * NS:
            self._read(self.boot_ns, self.ahead)
        self._seen = self.boot_ns, self.ahead
        self.rows[-1].append(self.boot_ns + self.base)


def read(computer: Computer, book: ClockBook | None = None) -> IntArray:
    """Correct the times of all rows as a query does."""
    clocks = computer.clocks()
    book = book or book_of(clocks)
    tables = [ClockTable(book.points(clock.name) or ()) for clock in clocks]
    pairs = zip(tables, computer.rows, strict=True)
    return np.concatenate([table.received(np.array(rows, np.int64)) for table, rows in pairs])


def assert_right(computer: Computer, tolerance_ns: int = MS) -> None:
    received = read(computer)
    assert np.abs(received - computer.truth()).max() < tolerance_ns
    assert (np.diff(received) >= 0).all()


def test_a_start_in_1970_is_put_right_by_the_first_synchronisation() -> None:
    computer = Computer().start()
    computer.pass_time(30)
    computer.ahead, computer.synchronised = TRUTH, True
    computer.pass_time(30)
    assert len(computer.files) == 2
    assert_right(computer)


@pytest.mark.parametrize("step_s", [0.8, -0.8, 7200.0, -7200.0, 0.2])
def test_the_clock_was_wrong_before_it_was_corrected_by_a_step(step_s: float) -> None:
    computer = Computer(ahead=TRUTH - round(step_s * NS), synchronised=True).start()
    computer.pass_time(35)
    computer.step(step_s)
    computer.pass_time(35)
    assert_right(computer)


def test_a_wrong_step_by_hand_does_not_move_what_was_synchronised() -> None:
    computer = Computer(ahead=TRUTH, synchronised=True).start()
    computer.pass_time(20)
    computer.step(-7200)
    computer.synchronised = False
    computer.pass_time(20)
    assert_right(computer)
    computer.step(7200.3)
    computer.pass_time(20)
    assert_right(computer)


@pytest.mark.parametrize("rate", [500e-6, -500e-6])
def test_a_slew_is_followed_for_an_hour(rate: float) -> None:
    computer = Computer(ahead=TRUTH, synchronised=True, rate=rate).start()
    computer.pass_time(3600)
    expected = computer.truth() + np.rint((computer.truth() - TRUTH - 30 * NS) * rate)
    received = read(computer)
    assert np.abs(received - expected).max() < MS
    assert (np.diff(received) >= 0).all()
    book = book_of(computer.clocks())
    assert len(book.boots["0000000a"].points) < 120


def test_without_any_word_on_synchronisation_the_newest_counts() -> None:
    computer = Computer(ahead=5 * NS, synchronised=None).start()
    computer.pass_time(20)
    computer.ahead = TRUTH
    computer.pass_time(20)
    assert_right(computer)
    assert book_of(computer.clocks()).notes == []


def test_a_boot_that_was_never_synchronised_is_marked_and_left() -> None:
    computer = Computer(ahead=5 * NS).start()
    computer.pass_time(20)
    book = book_of(computer.clocks())
    assert book.boots["0000000a"].synchronised is False
    assert (read(computer) == computer.truth(5 * NS)).all()
    assert "never synchronised" in book.notes[0]


def test_boots_do_not_correct_each_other_but_a_wrong_order_is_told() -> None:
    good = Computer(ahead=TRUTH, synchronised=True).start()
    good.pass_time(20)
    bad = Computer(ahead=0, synchronised=False).start()
    bad.pass_time(20)
    clocks = [*good.clocks("0000000a", 1), *bad.clocks("0000000b", 2)]
    book = book_of(clocks)
    assert [book.boots[b].synchronised for b in ("0000000a", "0000000b")] == [True, False]
    assert any("run 2 came after run 1" in note for note in book.notes)
    assert book.boots["0000000b"].runs == (2,)


def test_two_runs_of_one_boot_share_what_is_known() -> None:
    computer = Computer().start()
    computer.pass_time(20)
    first = computer.clocks(run=1)
    computer.pass_time(3)
    computer.ahead, computer.synchronised = TRUTH, True
    computer.pass_time(20)
    second = computer.clocks(run=2)[len(first) :]
    book = book_of([*first, *second])
    times = ClockTable(book.points(first[0].name) or ()).received(np.array([40 * NS]))
    assert abs(int(times[0]) - TRUTH - 40 * NS) < MS


def test_journals_that_do_not_tell_their_boot_stay_as_they_are() -> None:
    readings = (ClockReading(TRUTH, 0, True, None), ClockReading(TRUTH + NS, 800 * MS, True, None))
    book = book_of([
        JournalClock("journal/1-0000000a-1.mcap", "0000000a", 1, readings),
        JournalClock("journal/2-00000000-1.mcap", "00000000", 2,
                     (ClockReading(TRUTH, 0, True, 30 * NS),)),
    ])  # fmt: skip
    assert book.journals == {}
    assert book.points("journal/1-0000000a-1.mcap") is None


STEPS = st.sampled_from([-7200.0, -0.9, -0.06, 0.06, 0.3, 0.9, 3.0, 1e6])
PHASES = st.tuples(STEPS, st.floats(-500e-6, 500e-6), st.sampled_from([True, False, None]),
                   st.integers(1, 25))  # fmt: skip


@settings(max_examples=20)
@given(phases=st.lists(PHASES, max_size=4), last_s=st.integers(1, 25))
def test_any_history_is_right_once_it_is_synchronised(
    phases: Sequence[tuple[float, float, bool | None, int]], last_s: int
) -> None:
    computer = Computer(ahead=3 * NS).start()
    for step_s, _, flag, lasts_s in phases:
        computer.step(step_s)
        computer.synchronised = flag
        computer.pass_time(lasts_s)
    computer.ahead, computer.synchronised = TRUTH, True
    computer.pass_time(last_s)
    assert_right(computer)


@settings(max_examples=20)
@given(phases=st.lists(PHASES, min_size=1, max_size=4))
def test_time_never_runs_backwards_and_durations_are_those_of_the_boot_clock(
    phases: Sequence[tuple[float, float, bool | None, int]],
) -> None:
    computer = Computer(ahead=TRUTH, synchronised=True).start()
    for step_s, rate, flag, lasts_s in phases:
        computer.step(step_s)
        computer.rate, computer.synchronised = rate, flag
        computer.pass_time(lasts_s)
    received = read(computer)
    assert (np.diff(received) >= 0).all()
    lasted = received[-1] - received[0] - (computer.truth()[-1] - computer.truth()[0])
    turned = sum(abs(rate) * lasts_s * NS for _, rate, _, lasts_s in phases)
    assert abs(lasted) <= turned + MS


@given(
    offsets=st.lists(st.integers(-80 * MS, 80 * MS), min_size=1, max_size=30),
    tolerance=st.sampled_from([0, 500_000]),
)
def test_points_left_out_are_near_the_line(offsets: list[int], tolerance: int) -> None:
    points = [(TRUTH + n * 10 * NS, offset) for n, offset in enumerate(offsets)]
    kept = simplified(points, tolerance)
    assert set(kept) <= set(points)
    assert (kept[0], kept[-1]) == (points[0], points[-1])
    times = np.array([t for t, _ in points], np.int64)
    error = ClockTable(kept).received(times) - times - np.array(offsets)
    assert np.abs(error).max() <= tolerance + 1


# -- whole stores


def record(store: Path, computer: Computer) -> None:
    """Write what a computer recorded as journals of one run."""
    run = FakeRun(store, items=[TICK])
    for number, (readings, rows) in enumerate(zip(computer.files, computer.rows, strict=True)):
        if number:
            run.rotate()
        run.own(channels.RUN, rows[0], {"writer": "main", "run": run.run, "items": "{}"})
        for r in readings:
            values = {"offset_ns": r.offset_ns, "synchronised": r.synchronised}
            run.own(channels.CLOCK, r.log_ns, {**values, "boot_ns": r.boot_ns})
        run.write([(at, TICK, {"n": n}) for n, at in enumerate(rows)])
    run.close()


@pytest.fixture
def started_in_1970(tmp_path: Path) -> tuple[Path, Computer]:
    computer = Computer(rate=300e-6).start()
    computer.pass_time(5)
    computer.ahead, computer.synchronised, computer.rate = TRUTH, True, 0.0
    computer.pass_time(5)
    record(tmp_path / "store", computer)
    return tmp_path / "store", computer


def received_in(store: Path) -> IntArray:
    times = LocalRecord(store).query("tick", ["received"]).columns["received"]
    assert isinstance(times, np.ndarray)
    return times


def test_a_query_goes_by_corrected_times(started_in_1970: tuple[Path, Computer]) -> None:
    store, computer = started_in_1970
    assert np.abs(received_in(store) - computer.truth()).max() < 2 * MS
    found = LocalRecord(store).query("tick", ["received"], from_="-6s")
    assert len(found) == 61
    (tick,) = [info for info in LocalRecord(store).items() if info.name == "tick"]
    assert tick.last_ns - tick.first_ns == pytest.approx(9.9 * NS, abs=2 * MS)


def test_segments_and_journals_say_the_same_also_when_these_are_gone(
    started_in_1970: tuple[Path, Computer],
) -> None:
    store, _ = started_in_1970
    before, files = received_in(store), journals(store)
    first_ns = LocalRecord(store).items()[0].first_ns
    for journal in files:
        build_segments(store, journal)
    assert (received_in(store) == before).all()
    late = LocalRecord(store).query("tick", ["received"], int(before[20]), by="timestamp")
    assert len(late) == len(before) - 20
    rows = LocalRecord(store).sql("SELECT received AS a FROM tick ORDER BY received").columns["a"]
    assert (np.asarray(rows) == before).all()
    assert LocalRecord(store).items()[0].first_ns == first_ns


def test_what_is_known_outlives_the_journals(started_in_1970: tuple[Path, Computer]) -> None:
    store, _ = started_in_1970
    before, files = received_in(store), journals(store)
    sealed = seal_journals(open_store(store), None)
    assert [entry.boot_base_ns is None for entry in sealed] == [False, False]
    for journal in files:
        build_segments(store, journal)
    (store / files[1].name).unlink()
    assert (received_in(store) == before).all()
    (store / files[0].name).unlink()
    assert (received_in(store) == before).all()


def test_gaps_found_earlier_are_moved_with_the_rows(
    started_in_1970: tuple[Path, Computer],
) -> None:
    store, computer = started_in_1970
    book = LocalRecord(store).clock()
    then, now = computer.rows[0][20], received_in(store)[20]
    assert book.known_now_ns(1, then) == now
    assert book.known_now_ns(2, then) == then
    gap = Gap("main", 1, then, then + NS, "deleted: test")
    moved = corrected_gap(gap, read_catalogue(store))
    assert moved.from_ns == now
    assert moved.to_ns - moved.from_ns == pytest.approx(NS, abs=MS)


def test_follow_goes_by_what_was_known_then(started_in_1970: tuple[Path, Computer]) -> None:
    store, computer = started_in_1970
    batches = [d for d in follow(store, {"tick"}, live=False) if isinstance(d, Batch)]
    times = np.concatenate([batch.received_ns for batch in batches])
    assert times[0] == computer.rows[0][0] < 100 * NS
    assert times[-1] == computer.rows[-1][-1]


def test_the_record_tells_of_its_clocks(tmp_path: Path) -> None:
    computer = Computer(ahead=5 * NS).start()
    computer.pass_time(2)
    create_store(tmp_path / "store")
    record(tmp_path / "store", computer)
    (boot,) = LocalRecord(tmp_path / "store").clock().boots.values()
    assert boot.synchronised is False
    assert boot.runs == (1,)
