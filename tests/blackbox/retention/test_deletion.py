"""The one rule as a pure function: in which order things go, and what never does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.retention.rule import (
    DeletionUnit,
    JournalWindow,
    ages_s,
    for_room,
    too_old,
)
from amberbox.blackbox.robot_folder.robot_yaml import Lifetime, RetentionOptions
from amberbox.core.clock import NS

OPTIONS = RetentionOptions(keep_min_s=100.0)
ALL = 1 << 60


def unit(name: str, age_s: float, writer: str = "main", *, confirmed: bool = False) -> DeletionUnit:
    start_ns = round((10_000 - age_s) * NS)
    return DeletionUnit(name, writer, 1, start_ns, start_ns + NS, age_s, 10, 5, confirmed)


def names(
    units: Sequence[DeletionUnit], options: RetentionOptions = OPTIONS, needed: int = ALL
) -> list[str]:
    return [removal.unit.name for removal in for_room(units, needed, options)]


MIXED = [
    unit("main new", 50), unit("main old", 500), unit("main older", 600),
    unit("bulk new", 20, "bulk"), unit("bulk old", 700, "bulk"), unit("ring", 30, "ring"),
    unit("sent new", 10, confirmed=True), unit("sent old", 400, "bulk", confirmed=True),
]  # fmt: skip


def test_the_order_of_the_rule() -> None:
    assert names(MIXED) == [
        "sent old", "sent new", "ring", "bulk old", "bulk new", "main older", "main old",
    ]  # fmt: skip


def test_a_store_that_stops_keeps_what_no_server_has() -> None:
    assert names(MIXED, replace(OPTIONS, when_full="stop")) == ["sent old", "sent new", "ring"]


def test_no_more_goes_than_is_needed() -> None:
    assert names(MIXED, needed=16) == ["sent old", "sent new"]
    assert names(MIXED, needed=0) == []


def test_the_part_with_the_shorter_lifetime_goes_first_of_the_whole_store() -> None:
    units = [unit("a", 500), unit("b", 600), replace(unit("raw only", 700), column_bytes=0)]
    options = replace(OPTIONS, lifetime=Lifetime(raw_s=1000.0))
    found = [(removal.unit.name, removal.what) for removal in for_room(units, ALL, options)]
    assert found == [("b", "raw"), ("a", "raw"), ("raw only", "both"), ("b", "both"), ("a", "both")]
    options = replace(OPTIONS, lifetime=Lifetime(raw_s=1000.0, columns_s=10.0))
    assert for_room(units, ALL, options)[0].what == "columns"


def test_lifetimes_win_over_room_and_over_keep_min() -> None:
    units = [unit("new", 50), unit("old", 80), unit("oldest", 99), unit("ring", 99, "ring")]
    options = replace(OPTIONS, lifetime=Lifetime(raw_s=60.0, columns_s=90.0))
    found = [(removal.unit.name, removal.what) for removal in too_old(units, options)]
    assert found == [("oldest", "both"), ("old", "raw")]


def test_raw_data_wait_for_columns_that_are_to_outlive_them() -> None:
    waiting = replace(unit("a", 99), column_bytes=0, pending=True)
    keeps_columns = replace(OPTIONS, lifetime=Lifetime(raw_s=60.0))
    assert too_old([waiting], keeps_columns) == []
    assert [r.what for r in too_old([replace(waiting, pending=False)], keeps_columns)] == ["both"]


UNITS = st.builds(
    DeletionUnit,
    name=st.integers().map(str),
    writer=st.sampled_from(["main", "bulk", "ring"]),
    run=st.just(1),
    start_ns=st.just(0),
    end_ns=st.just(1),
    age_s=st.floats(0, 1000),
    raw_bytes=st.integers(0, 100),
    column_bytes=st.integers(0, 100),
    confirmed=st.booleans(),
)


@given(st.lists(UNITS, unique_by=lambda u: u.name), st.integers(0, 2000), st.booleans())
def test_whatever_there_is(units: list[DeletionUnit], needed: int, stops: bool) -> None:
    options = replace(OPTIONS, when_full="stop" if stops else "overwrite")
    gone = [removal.unit for removal in for_room(units, needed, options)]
    assert len(gone) == len({u.name for u in gone})
    for one in gone:
        if not one.confirmed and one.writer == "main":
            assert one.age_s >= options.keep_min_s
            assert not stops
    freed = sum(u.raw_bytes + u.column_bytes for u in gone)
    left = [u for u in units if u not in gone]
    if freed < needed:  # then nothing that may go is left
        assert not any(u.confirmed or u.writer == "ring" for u in left)
    steps = [0 if u.confirmed else {"ring": 1, "bulk": 2, "main": 3}[u.writer] for u in gone]
    assert steps == sorted(steps)


def window(
    name: str, run: int, start_s: float, end_s: float, writer: str = "main"
) -> JournalWindow:
    number = int(name) if name.isdigit() else 0
    return JournalWindow(
        name, writer, run, number, 0, 1, round(start_s * NS), round(end_s * NS), ""
    )


def test_ages_count_recorded_time_whatever_the_clock_did() -> None:
    files = [
        window("0", 1, 1000, 1010),
        window("1", 1, 500, 510),  # the clock was set back
        window("2", 2, 9999, 10_009),  # forward by far, while nothing ran
        window("3", 2, 10_009, 10_019),
    ]
    assert ages_s(files) == {"3": 0.0, "2": 10.0, "1": 9509.0, "0": 9519.0}


def test_lifetimes_count_no_pause_that_a_wrong_clock_makes() -> None:
    month = 32 * 86_400
    files = [
        replace(window("0", 1, 1000, 1010), synchronised=True),
        replace(window("1", 2, 1020, 1030), synchronised=True),
        replace(window("2", 3, month, month + 10), synchronised=False),
        replace(window("3", 4, 2000, 2010 + month), synchronised=True, stepped_ns=month * NS),
    ]
    assert ages_s(files, sure=True) == {"3": 0.0, "2": 10.0, "1": 20.0, "0": 40.0}


def test_other_writers_are_placed_among_the_main_journals() -> None:
    files = [
        *(window(str(n), 1, n * 10, n * 10 + 10) for n in range(1, 5)),
        window("bulk", 1, 12, 15, "bulk"),
        window("last", 1, 41, 57, "bulk"),
    ]
    ages = ages_s(files)
    assert (ages["bulk"], ages["last"]) == (35.0, 0.0)
