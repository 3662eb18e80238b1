"""A store of thousands of journals: a reader that starts at its end opens only the last ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.journal.scan import FileScan, scan
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.recorder.recorder import previous_end_ns
from amberbox.blackbox.store import journal_reader, tail
from amberbox.blackbox.store.derived_journal import last_progress
from amberbox.blackbox.store.store import Store, open_store
from amberbox.blackbox.store.tail import position_at
from amberbox.core.clock import NS
from amberbox.core.types import WriterCursor
from tests.support.manual_recorder import COUNT, ManualBox, number


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    box = ManualBox(
        tmp_path_factory.mktemp("many") / "store", options=PipelineOptions(rotate_ns=NS)
    )
    for n in range(60):
        box.hear(COUNT, number(n))
        box.write(0.5)
    box.close()
    return open_store(box.store)


def test_what_begins_at_the_end_opens_few_files(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[Path] = []

    def look(path: Path) -> FileScan:
        looked.append(path)
        return scan(path)

    journal_reader._journal_file.cache_clear()
    monkeypatch.setattr(journal_reader, "scan", look)
    assert len(store.journal_files("main")) > 20
    assert previous_end_ns(store) is not None
    assert position_at(store, "main", None, 1.0).seq > 0
    assert last_progress(store, "keep") is None
    assert 0 < len(set(looked)) <= 4


@pytest.mark.parametrize("back", [0, 1, 7, 20])
def test_the_file_of_a_position_is_found_from_the_end(store: Store, back: int) -> None:
    files = store.journal_files("main")
    wanted = len(files) - 1 - back
    starts = [journal_reader.journal_file(path).first_seq for path in files]
    assert tail._first_of_interest(files, 1, starts[wanted]) == wanted
    assert tail._first_of_interest(files, 1, starts[wanted] + 1) == wanted
    assert tail._first_of_interest(files, 0, 10**9) == 0
    assert tail._first_of_interest(files, 2, 0) == len(files)


def test_a_lookback_reaches_over_files(store: Store) -> None:
    end = position_at(store, "main", None, 0.001)
    back = position_at(store, "main", None, 10.0)
    assert position_at(store, "main", WriterCursor(1, back.seq), 0.001).seq <= back.seq < end.seq
    files = [journal_reader.journal_file(path) for path in store.journal_files("main")]
    (of,) = [f for f in files if f.first_seq <= back.seq < f.end_seq]
    assert 9.0 <= (files[-1].end_ns - of.end_ns) / NS <= 11.0
