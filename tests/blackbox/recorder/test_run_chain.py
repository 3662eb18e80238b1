"""The hash chain continues from run to run: removing a run breaks it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import pytest

from amberbox.blackbox.journal.mcap import CHAIN_METADATA
from amberbox.blackbox.journal.scan import JournalWalk, MetadataRecord, start_record
from amberbox.blackbox.journal.writer import EMPTY_CHAIN
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.derived_journal import DerivedJournal, event
from amberbox.blackbox.store.journal_reader import previous_chain
from amberbox.blackbox.store.manifest_entries import Tombstone, to_record
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.source import TopicOptions
from tests.support.manual_recorder import COUNT, ManualBox, number

RING = [TopicOptions("/count", keep="ring")]


def record(store: Path, topics: Sequence[TopicOptions] = (), *, crash_after: int = 0) -> None:
    """Record a run of three links; a crash leaves out the last ``crash_after`` of them."""
    box = ManualBox(store, topics)
    for n in range(3):
        box.hear(COUNT, number(n))
        box.write()
        if n < 3 - crash_after:
            for mark in box.pipeline.mark_sync():
                mark.wait()
    box.crash() if crash_after else box.close()


def links(path: Path) -> list[str]:
    found = [m for m in JournalWalk(path.read_bytes()) if isinstance(m, MetadataRecord)]
    return [m.values["chain"] for m in found if m.name == CHAIN_METADATA]


def begins_with(path: Path) -> str:
    return start_record(path)["chain"]


@pytest.mark.parametrize("crash_after", [0, 1, 2])
@pytest.mark.parametrize("topics", [[], RING])
def test_each_run_begins_where_the_one_before_ended(
    tmp_path: Path, topics: Sequence[TopicOptions], crash_after: int
) -> None:
    for _ in range(3):
        record(tmp_path / "store", topics, crash_after=crash_after)
    store = open_store(tmp_path / "store")
    for writer in ("main", "ring") if topics else ("main",):
        first, second, third = store.journal_files(writer)
        assert begins_with(first) == EMPTY_CHAIN
        assert begins_with(second) == links(first)[-1]
        assert begins_with(third) == links(second)[-1]
        assert previous_chain(store, writer) == links(third)[-1]


def test_a_run_that_ended_before_its_first_link_hands_on_what_it_had(tmp_path: Path) -> None:
    record(tmp_path / "store")
    record(tmp_path / "store", crash_after=3)
    record(tmp_path / "store")
    first, second, third = open_store(tmp_path / "store").journal_files("main")
    assert links(second) == []
    assert begins_with(second) == begins_with(third) == links(first)[-1]


def test_a_file_that_lost_its_tail_hands_on_its_last_link(tmp_path: Path) -> None:
    record(tmp_path / "store")
    (path,) = open_store(tmp_path / "store").journal_files("main")
    content, known = path.read_bytes(), links(path)
    path.write_bytes(content[: content.index(known[1].encode())])
    left = links(path)
    assert 0 < len(left) < len(known)
    record(tmp_path / "store")
    assert begins_with(open_store(tmp_path / "store").journal_files("main")[-1]) == left[-1]


def test_an_empty_file_is_passed_over(tmp_path: Path) -> None:
    record(tmp_path / "store")
    (path,) = open_store(tmp_path / "store").journal_files("main")
    (path.parent / "000002-00000000-0000.mcap").touch()
    assert previous_chain(open_store(tmp_path / "store"), "main") == links(path)[-1]


def test_the_tombstone_hands_on_the_link_of_what_was_deleted(tmp_path: Path) -> None:
    record(tmp_path / "store")
    record(tmp_path / "store")
    store = open_store(tmp_path / "store")
    older, newer = store.journal_files("main")
    bury(store, newer, hashlib.sha256(b"last link").hexdigest())
    newer.unlink()
    assert previous_chain(store, "main") == hashlib.sha256(b"last link").hexdigest()
    assert previous_chain(store, "ring") == EMPTY_CHAIN
    record(tmp_path / "store")
    newest = store.journal_files("main")[-1]
    assert begins_with(newest) == hashlib.sha256(b"last link").hexdigest()
    bury(store, older, "ff" * 32)
    assert previous_chain(store, "main") == links(newest)[-1]


def bury(store: Store, path: Path, chain: str) -> None:
    stone = Tombstone(
        (f"journal/{path.name}",), "raw", "main", 1, 0, 5, 0, 1, chain, "for room", True, 2
    )
    manifest.append(store.path, [to_record(stone)])


def test_nothing_known_gives_zeros(tmp_path: Path) -> None:
    ManualBox(tmp_path / "store").close()
    assert previous_chain(open_store(tmp_path / "store"), "watch") == EMPTY_CHAIN


def test_a_journal_of_conclusions_goes_on_the_same_way(tmp_path: Path) -> None:
    ManualBox(tmp_path / "store").close()
    store = open_store(tmp_path / "store")
    for _ in range(2):
        journal = DerivedJournal(store, "keep", chain=lambda: previous_chain(store, "keep"))
        journal.write([event("kept", "something")])
        journal.close()
    first, second = store.journal_files("keep")
    assert begins_with(second) == links(first)[-1] != EMPTY_CHAIN
