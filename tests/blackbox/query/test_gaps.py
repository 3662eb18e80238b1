"""Gaps: missing data are listed with the reason; empty and unusual stores are handled."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.store import segment_builder as segments
from amberbox.blackbox.store.journal_reader import journals
from amberbox.cli.main import main
from amberbox.cli.plot import gaps_in_plot as gaps_drawn
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import Gap
from amberbox.testing.records import BATTERY, T0_NS, FakeRun, build_segments_of, fill_store


def test_undecodable_messages_are_gaps(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    run.write(
        [
            (T0_NS, BATTERY, {"volts": 1.0}),
            (T0_NS + 1, BATTERY, b"{"),
            (T0_NS + 2, BATTERY, {"volts": 2.0}),
        ]
    )
    run.close()
    table = amberbox.open(tmp_path).query("battery")
    assert table.values("volts") == [1.0, 2.0]
    assert any("undecodable" in note for note in table.notes)
    for step in ("journal", "segment", "segment only"):
        record = amberbox.open(tmp_path)
        assert record.query("battery").values("volts") == [1.0, 2.0]
        (gap,) = record.gaps("battery")
        assert (gap.from_ns, gap.count) == (T0_NS + 1, 1)
        assert "undecodable" in gap.reason
        build_segments_of(tmp_path)
        if step == "segment":
            journals(tmp_path)[0].path.unlink()


def test_undecodable_messages_in_a_row_are_one_gap(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    good = {"volts": 1.0}
    said = [good, b"{", b"[", b"}", good, b"x", good]
    run.write([(T0_NS + n, BATTERY, value) for n, value in enumerate(said)])
    found = [(gap.from_ns - T0_NS, gap.to_ns - T0_NS, gap.count) for gap in gaps_of(tmp_path)]
    assert found == [(1, 4, 3), (5, 6, 1)]
    run.write([(T0_NS + 10, BATTERY, b"{")])  # while it is being written
    assert [gap.count for gap in gaps_of(tmp_path)] == [3, 1, 1]
    run.close()


def gaps_of(store: Path) -> list[Gap]:
    return amberbox.open(store).gaps("battery")


def test_a_gap_of_one_publisher_names_it_and_is_no_gap_of_a_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = FakeRun(tmp_path)
    run.write([(T0_NS + n * NS, BATTERY, {"volts": 1.0}) for n in range(10)])
    gone = {"item": "battery", "reason": "publisher died", "count": None}
    of_one = {**gone, "peer": "/b", "from_ns": T0_NS + 2 * NS, "to_ns": T0_NS + 5 * NS}
    of_all = {**gone, "peer": "/a", "from_ns": T0_NS + 9 * NS + 1, "to_ns": T0_NS + 12 * NS}
    run.own("amberbox/gap", T0_NS + 10 * NS, of_one)
    run.own("amberbox/gap", T0_NS + 12 * NS, of_all)
    run.write([(T0_NS + 12 * NS, BATTERY, {"volts": 1.0})])
    run.close()
    assert [gap.peer for gap in gaps_of(tmp_path)] == ["/b", "/a"]
    assert main(["gaps", str(tmp_path), "battery"]) == 0
    assert "battery  /b " in capsys.readouterr().out
    assert main(["gaps", str(tmp_path), "--json"]) == 0
    assert [gap["publisher"] for gap in json.loads(capsys.readouterr().out)] == ["/b", "/a"]
    times = np.asarray(amberbox.open(tmp_path).query("battery", ["received"])["received"])
    (drawn,) = gaps_drawn(amberbox.open(tmp_path), "battery", times)
    assert drawn[0] == T0_NS + 9 * NS + 1


def test_recorded_gaps_are_listed(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    run.write([(T0_NS + n * NS, BATTERY, {"volts": 1.0}) for n in range(10)])
    opened = {"item": "battery", "peer": "p", "from_ns": T0_NS + 2 * NS, "to_ns": None,
              "reason": "publisher died", "count": None}  # fmt: skip
    run.own("amberbox/gap", T0_NS + 2 * NS, opened)
    run.own("amberbox/gap", T0_NS + 4 * NS, {**opened, "to_ns": T0_NS + 4 * NS})
    run.own("amberbox/gap", T0_NS + 8 * NS, {**opened, "from_ns": T0_NS + 8 * NS})
    run.write([(T0_NS + 10 * NS, BATTERY, {"volts": 1.0})])
    run.close()
    for _ in range(2):
        record = amberbox.open(tmp_path)
        found = [
            (g.item, (g.from_ns - T0_NS) // NS, (g.to_ns - T0_NS) // NS) for g in record.gaps()
        ]
        assert found == [("battery", 2, 4), ("battery", 8, 10)]
        assert record.gaps("other") == []
        assert len(record.gaps("battery", T0_NS + 5 * NS)) == 1
        build_segments_of(tmp_path)


def test_a_lost_journal_is_a_gap_unless_its_segments_are_there(tmp_path: Path) -> None:
    fill_store(tmp_path)
    first, second, _ = journals(tmp_path)
    segments.build_segments(tmp_path, first)
    first.path.unlink()
    second.path.unlink()
    (gap,) = amberbox.open(tmp_path).gaps()
    assert (gap.from_seq, gap.to_seq) == (second.first_seq, second.end_seq)


def test_an_empty_store_says_so(tmp_path: Path) -> None:
    FakeRun(tmp_path).close()
    record = amberbox.open(tmp_path)
    assert record.items() == []
    assert record.last_ns() is None
    with pytest.raises(UsageError, match="no data item"):
        record.query("odom")
    assert len(record.events()) == 0


@pytest.mark.parametrize("where", ["nowhere", "."])
def test_a_place_without_record_is_wrong_usage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError):
        amberbox.open(where)


def test_events_are_a_table(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    run.own("amberbox/event", T0_NS, {"kind": "k", "text": "t", "source": "", "details": ""})
    run.close()
    (row,) = amberbox.open(tmp_path).events().rows()
    assert (row["timestamp"], row["kind"]) == (T0_NS, "k")
