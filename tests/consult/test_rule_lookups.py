"""Times at which conditions held: equal to evaluating single instants, for any division into
blocks.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.query.record_window import RecordWindow
from amberbox.consult import rule_lookups
from amberbox.consult.rule_lookups import ConditionLookup, StatusLookup
from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

A, B = FakeItem("a", [{"x": 1.0}]), FakeItem("b", [{"y": 1.0}])
Rows = list[tuple[int, FakeItem, dict[str, Any]]]


def runs_of(store: Path, chance: random.Random) -> list[Rows]:
    """Write two runs of random rows, with a pause of about an hour between them."""
    runs, at_ns = [], T0_NS
    for _ in range(2):
        rows: Rows = []
        for _ in range(60):
            at_ns += chance.randrange(1, 200) * NS // 7
            item = chance.choice([A, B])
            values = {"x": chance.choice([0.0, 1.0, 2.0])}
            rows.append((at_ns, item, values if item is A else {"y": chance.choice([0, 1, None])}))
        run = FakeRun(store, items=[A, B])
        run.write(rows)
        run.close()
        runs.append(rows)
        at_ns += 3500 * NS
    return runs


def series_of(rows: Rows, addresses: Sequence[str]) -> dict[str, Any]:
    of = {
        "a.x": [(t, values["x"]) for t, item, values in rows if item is A],
        "b.y": [(t, values["y"]) for t, item, values in rows if item is B],
    }
    return {
        name: (np.array([t for t, _ in of[name]]), np.array([v for _, v in of[name]], object))
        for name in addresses
    }


@pytest.mark.parametrize("block_s", [37, 900])
def test_intervals_say_what_single_instants_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_s: int
) -> None:
    monkeypatch.setattr(rule_lookups, "_BLOCK_NS", block_s * NS)
    chance = random.Random(block_s)
    runs = runs_of(tmp_path / "store", chance)
    window = RecordWindow(LocalRecord(tmp_path / "store"))
    for text in (
        "a.x > 0 and b.y < 1",
        "a.x > 1 for 20s",
        "age(a.x) > 10",
        "max(a.x over 60s) > 1",
    ):
        when, found = parse(text), [*ConditionLookup(window).find((text,), None)]
        spans = [(interval.from_ns, interval.to_ns) for interval in found]
        assert spans == sorted(spans)
        for rows in runs:
            series = series_of(rows, when.addresses())
            for _ in range(15):
                at_ns = chance.randrange(rows[0][0] // NS + 1, rows[-1][0] // NS) * NS
                wanted = bool(when.evaluate_series(series, at_ns))  # null is no
                assert any(first <= at_ns < last for first, last in spans) == wanted
                near = ConditionLookup(window).find((text,), (at_ns, at_ns))
                assert any(of.from_ns <= at_ns < of.to_ns for of in near) == wanted


def test_nobody_was_well_or_ill_where_nobody_watched(tmp_path: Path) -> None:
    runs_of(tmp_path / "store", random.Random(1))
    assert StatusLookup(RecordWindow(LocalRecord(tmp_path / "store"))).intervals == []
