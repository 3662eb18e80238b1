"""The coverage bar of recordings: close intervals are joined, reasons have kinds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from amberbox.core.api import Gap, GapKind, Incident, Integrity, RecordingState
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.server.data.recordings import JournalListing
from amberbox.server.drawing.charts import TimeAxis
from amberbox.server.web.coverage import axis_of, share, shortest, spans, stretches

HOUR_NS = 3600 * NS
AXIS = TimeAxis(0, 24 * HOUR_NS)


def journal(
    start: float, to: float, integrity: Integrity = "intact", state: RecordingState = "in_columns",
    keeping: str = "main",
) -> JournalListing:  # fmt: skip
    return JournalListing("s", f"journal/{start}.mcap", keeping, "", state, integrity, "", 1, 1, 1,
                     int(start * HOUR_NS), int(to * HOUR_NS), 0)  # fmt: skip


def gap(start: float, to: float, kind: GapKind, item: str = "") -> Gap:
    at = (format_time(int(hour * HOUR_NS)) for hour in (start, to))
    return Gap(item=item, writer="main", run=1, from_=next(at), to=next(at), kind=kind,
               reason="as it was said", count=1)  # fmt: skip


def incident(state: str) -> Incident:
    return Incident(id="i", origin="robot", state=state, reason="bump", who="", trigger="",
                    from_=format_time(HOUR_NS), to=format_time(2 * HOUR_NS))  # fmt: skip


def test_files_that_follow_each_other_are_one_stretch() -> None:
    found = stretches([journal(1, 2), journal(2, 3), journal(5, 6)], [], [], AXIS)
    assert [(s.start // HOUR_NS, s.to // HOUR_NS) for s in found] == [(1, 3), (5, 6)]


def test_what_is_not_here_is_not_recorded() -> None:
    found = stretches(
        [journal(1, 2, "missing"), journal(3, 4, state="refused"),
         journal(5, 6, "unknown", "copying"), journal(7, 8, keeping="keep"),
         journal(7, 8, keeping="act"), journal(9, 10, "deleted")], [], [], AXIS,
    )  # fmt: skip
    assert [(one.kind, one.start // HOUR_NS) for one in found] == [("deleted", 9)]


@pytest.mark.parametrize(
    ("kind", "drawn"),
    [("lost", ["lost"]), ("deleted", ["deleted"]), ("filtered", ["filtered"]),
     ("to_come", []), ("uncovered", [])],
)  # fmt: skip
def test_what_is_missing_is_drawn(kind: GapKind, drawn: list[str]) -> None:
    found = stretches([], [gap(1, 2, kind, "odom")], [], AXIS)
    assert [one.kind for one in found] == drawn
    assert all(one.text == "odom: as it was said" for one in found)


def test_released_incidents_are_not_drawn() -> None:
    found = stretches([], [], [incident("complete"), incident("released")], AXIS)
    assert [(one.kind, one.text) for one in found] == [("incident", "bump")]


def test_thousands_of_files_are_a_few_stretches() -> None:
    files = [journal(n / 200, (n + 0.9) / 200) for n in range(4800)]
    assert len(stretches(files, [], [], AXIS)) == 1


def test_a_file_whose_times_are_not_known_covers_nothing() -> None:
    damaged = replace(journal(0, 0, "altered", "quarantined"), from_ns=None, to_ns=None)
    coming = replace(journal(0, 0, "unknown", "copying"), from_ns=None, to_ns=None)
    assert stretches([damaged, coming, journal(1, 2)], [], [], AXIS) == stretches(
        [journal(1, 2)], [], [], AXIS
    )
    now_ns = 100 * HOUR_NS
    assert axis_of("all", [damaged, journal(3, 4)], now_ns) == TimeAxis(3 * HOUR_NS, now_ns)


def test_all_time_begins_with_the_first_file() -> None:
    now_ns = 100 * HOUR_NS
    assert axis_of("all", [journal(3, 4), journal(9, 10)], now_ns) == TimeAxis(3 * HOUR_NS, now_ns)
    assert axis_of("all", [], now_ns) == TimeAxis(99 * HOUR_NS, now_ns)
    assert axis_of("24h", [journal(3, 4)], now_ns) == TimeAxis(76 * HOUR_NS, now_ns)


def test_the_share_of_a_mission_counts_nothing_twice() -> None:
    known = spans([journal(1, 3), journal(2, 4, keeping="bulk"), journal(6, 7)])
    assert share(known, HOUR_NS, 4 * HOUR_NS) == 1
    assert share(known, 3 * HOUR_NS, 7 * HOUR_NS) == 0.5
    assert share(known, 8 * HOUR_NS, 9 * HOUR_NS) == 0
    assert share(known, HOUR_NS, HOUR_NS) == 0


@pytest.mark.parametrize(
    ("hours", "window"),
    [(None, "7d"), (0.1, "1h"), (1.0, "1h"), (1.1, "6h"), (20, "24h"), (25, "7d"), (2000, "7d")],
)
def test_where_nobody_chose_the_window_is_the_shortest_that_holds_all(
    hours: float | None, window: str
) -> None:
    now_ns = 10_000 * HOUR_NS
    assert shortest(None if hours is None else int(now_ns - hours * HOUR_NS), now_ns) == window
