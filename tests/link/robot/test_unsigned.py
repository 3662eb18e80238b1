"""A journal is uploaded once its seal is signed: before, the server would refuse it."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.signing.keys import open_keys
from amberbox.blackbox.signing.signatures import seal_journals, sign_manifest
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.store import Store, open_store
from amberbox.link import uploader
from amberbox.link.connection import LinkOptions
from amberbox.link.uploader import JournalCopier, UploadReply
from tests.support.manual_recorder import COUNT, ManualBox, number


def refuse(
    method: str, path: str, headers: dict[str, str], body: bytes | memoryview
) -> UploadReply:
    raise AssertionError("nothing is sent here")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write(0.1)
    box.close()
    return open_store(tmp_path / "store")


@pytest.fixture
def copier(store: Store) -> JournalCopier:
    return JournalCopier(store, LinkOptions("http://127.0.0.1:1", "r1", "key-r1"), refuse)


def test_a_seal_waits_for_its_signature(store: Store, copier: JournalCopier) -> None:
    key = open_keys(store).key
    sealed = {one.journal for one in seal_journals(store, None)}  # as between seal and signature
    assert sealed and manifest.read(store.path).unsigned == sealed
    assert copier.waiting() == []
    assert sign_manifest(store, key)
    assert manifest.read(store.path).unsigned == set()
    assert set(copier.waiting()) == sealed


def test_a_signature_that_does_not_come_is_not_awaited_for_ever(
    store: Store, copier: JournalCopier, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_keys(store)
    sealed = {one.journal for one in seal_journals(store, None)}
    assert copier.waiting() == []
    monkeypatch.setattr(uploader, "SIGNATURE_S", 0.0)
    assert set(copier.waiting()) == sealed, "the server says what it thinks of it"


def test_a_robot_without_a_key_waits_for_nothing(store: Store, copier: JournalCopier) -> None:
    sealed = {one.journal for one in seal_journals(store, None)}
    assert set(copier.waiting()) == sealed
