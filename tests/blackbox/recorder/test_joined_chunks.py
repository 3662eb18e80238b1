"""Many small chunks read as one: the same rows, in the same order, in fewer batches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amberbox.blackbox.store import tail
from amberbox.blackbox.store.tail import follow
from amberbox.core.types import Batch, Cursor, Schema, Topic
from tests.support.manual_recorder import COUNT, ManualBox, number

OTHER = Topic("/other", "ros1", Schema("t/T", "ros1msg", b"string data\n"))


def rows(
    store: Path, items: list[str] | None, cursor: Cursor | None = None
) -> list[tuple[int, ...]]:
    """Return sequence, log time and value of every row, in order of delivery per item."""
    return sorted(
        (int(b.seq[n]), int(b.log_time_ns[n]), int(b.columns["data"][n]))
        for b in follow(store, items, cursor, live=False)
        if isinstance(b, Batch) and b.item == "ros_count"
        for n in range(len(b))
    )


@pytest.fixture
def store(tmp_path: Path) -> Path:
    box = ManualBox(tmp_path / "store")
    for value in range(100):
        box.hear(COUNT, number(value))
        if value % 3 == 0:
            box.hear(OTHER, b"\x05\0\0\0hello")
        box.write()
    box.close()
    return tmp_path / "store"


@pytest.mark.parametrize("items", [None, ["ros_count"]])
def test_joined_chunks_have_the_same_rows(
    store: Path, items: list[str] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    joined = rows(store, items)
    batches = sum(isinstance(d, Batch) for d in follow(store, ["ros_count"], live=False))
    assert batches < 10
    monkeypatch.setattr(tail, "BATCH_ROWS", 1)
    assert rows(store, items) == joined
    assert [value for _, _, value in joined] == list(range(100))
    single = sum(isinstance(d, Batch) for d in follow(store, ["ros_count"], live=False))
    assert single == 100


def test_reading_goes_on_amid_joined_chunks(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tail, "BATCH_ROWS", 7)
    whole = rows(store, ["ros_count"])
    cursors = [d.cursor for d in follow(store, ["ros_count"], live=False) if isinstance(d, Batch)]
    monkeypatch.setattr(tail, "BATCH_ROWS", 4096)
    for cursor in cursors[::3]:
        rest = rows(store, ["ros_count"], cursor)
        assert rest == (whole[-len(rest) :] if rest else [])
        assert len(whole) - len(rest) == np.searchsorted(
            [seq for seq, *_ in whole], cursor.writers["main"].ahead["ros_count"]
        )
