"""Sealing: every file that is over has its line in the manifest, signed, before its columns."""

from __future__ import annotations

import hashlib
import json
import threading
from itertools import pairwise
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import maintenance as keeper_module
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.keys import RobotSigningKey, open_keys
from amberbox.blackbox.signing.signatures import (
    HEADS,
    parse_heads,
    seal_journals,
    sign_manifest,
    signed_heads,
    write_heads,
)
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic
from tests.support.manual_recorder import COUNT, ManualBox, events, number

pytest.importorskip("cryptography", reason="signatures need it; pip install 'amberbox[keep]'")


def record(path: Path, writes: int = 30, *, close: bool = True) -> ManualBox:
    """Record a file per second and sync each half of one."""
    topics = [TopicOptions("/ring", keep="ring")]
    box = ManualBox(path, topics, options=PipelineOptions(rotate_ns=NS))
    for n in range(writes):
        box.hear(COUNT, number(n))
        box.hear(Topic("/ring", "ros1", COUNT.schema), number(n))
        box.write()
        if n % 5 == 4:
            for mark in box.pipeline.mark_sync():
                mark.wait()
    if close:
        box.close()
    return box


def opened(box: ManualBox) -> tuple[Store, RobotSigningKey]:
    store = open_store(box.store)
    key = open_keys(store).key
    assert key is not None
    return store, key


def test_finished_files_are_sealed_with_what_they_are(tmp_path: Path) -> None:
    store, key = opened(record(tmp_path / "store"))
    done = seal_journals(store, key)
    paths = store.journal_files("main")
    assert [s.journal for s in done] == [f"journal/{path.name}" for path in paths]
    for before, after in pairwise(done):
        assert after.start_chain == before.chain and after.first_seq == before.end_seq
    for path, sealed in zip(paths, done, strict=True):
        content = path.read_bytes()
        assert sealed.bytes == len(content)
        assert sealed.tail == hashlib.sha256(content[sealed.tail_from :]).hexdigest()
        assert content[sealed.tail_from + 13 :].startswith(b"amberbox/chain")
        assert sealed.start_ns < sealed.end_ns and not sealed.holes
    assert mf.read(store.path).sealed == {sealed.journal: sealed for sealed in done}
    assert seal_journals(store, key) == []


def test_the_file_that_is_being_written_waits(tmp_path: Path) -> None:
    box = record(tmp_path / "store", 15, close=False)
    store, key = opened(box)
    sealed = {s.journal for s in seal_journals(store, key)}
    names = [f"journal/{path.name}" for path in store.journal_files("main")]
    assert len(names) > 1 and sealed == set(names[:-1])
    box.crash()
    assert [s.journal for s in seal_journals(store, key)] == names[-1:]


def test_damage_is_told_and_noted_as_holes(tmp_path: Path) -> None:
    box = record(tmp_path / "store", 8, close=False)
    box.crash()
    store, key = opened(box)
    (path,) = store.journal_files("main")
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    told: list[tuple[str, str]] = []
    (sealed,) = seal_journals(store, key, lambda kind, text: told.append((kind, text)))
    assert [kind for kind, _ in told] == ["damaged"]
    assert sealed.holes and sealed.holes[0].to_seq > sealed.holes[0].from_seq


def test_every_group_of_lines_is_signed_once(tmp_path: Path) -> None:
    store, key = opened(record(tmp_path / "store"))
    seal_journals(store, key)
    known = mf.read(store.path)
    assert len(known.signatures) == 1
    assert not sign_manifest(store, key)
    mf.append(store.path, [{"kind": "confirmed", "journals": [], "by": "", "at_ns": 0}])
    head = mf.read(store.path).last_hash
    assert sign_manifest(store, key)
    assert mf.read(store.path).signatures[-1].head == head
    assert not sign_manifest(store, None)


def test_the_statement_holds_only_what_is_durable(tmp_path: Path) -> None:
    box = record(tmp_path / "store", 7, close=False)
    store, key = opened(box)
    heads = write_heads(store, key)
    assert heads.holds() and parse_heads((store.path / HEADS).read_bytes()) == heads
    reach = heads.writers["main"]
    box.hear(COUNT, number(1))
    box.write()
    marks = box.pipeline.mark_sync()  # written, but not on the disk yet
    assert signed_heads(store, key).writers["main"] == reach
    for mark in marks:
        mark.wait()
    box.write()
    assert signed_heads(store, key).writers["main"].next_seq > reach.next_seq
    box.crash()


def test_the_statement_of_a_store_at_rest_is_about_its_last_seals(tmp_path: Path) -> None:
    store, key = opened(record(tmp_path / "store"))
    done = seal_journals(store, key)
    heads = write_heads(store, key)
    assert heads.manifest == mf.read(store.path).last_hash
    assert set(heads.writers) == {"main"}, "the ring goes by itself"
    assert heads.writers["main"].chain == done[-1].chain
    assert json.loads((store.path / "heads.json").read_text())["key"] == key.public


def test_the_keeper_seals_signs_and_states_also_without_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper_module, "can_build", lambda: False)
    box = record(tmp_path / "store")
    store = open_store(box.store)
    keeper = RetentionService(store, RetentionOptions(quota=10**9, min_free=0))
    keeper.step(threading.Event())
    known = mf.read(store.path)
    assert len(known.sealed) == len(store.journal_files("main")) and known.signatures
    assert not known.segments
    heads = parse_heads((store.path / HEADS).read_bytes())
    assert heads is not None and heads.holds()
    keeper.close()


def test_the_keeper_tells_of_an_open_key_and_seals_its_own_journal(tmp_path: Path) -> None:
    store, _ = opened(record(tmp_path / "store"))
    (store.path / "key").chmod(0o640)
    keeper = RetentionService(store, RetentionOptions(quota=10**9, min_free=0))
    keeper.step(threading.Event())
    keeper.close()
    (told,) = events(store.path, "keys")
    assert "open to others" in told["text"]
    assert any(name.startswith("keep/") for name in mf.read(store.path).sealed)
