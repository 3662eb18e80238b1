"""A journal goes to the server once its seal is signed: before, the server would refuse it."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.segments import manifest
from amberbox.blackbox.signing.keys import open_keys
from amberbox.blackbox.signing.sealing import seal_journals
from amberbox.blackbox.signing.signing import sign_manifest
from amberbox.blackbox.store import Store, open_store
from amberbox.robot.link import copying
from amberbox.robot.link.copying import Copier, Reply
from amberbox.robot.link.options import LinkOptions
from amberbox.testing.box import COUNT, ManualBox, number


def refuse(method: str, path: str, headers: dict[str, str], body: bytes | memoryview) -> Reply:
    raise AssertionError("nothing is sent here")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write(0.1)
    box.close()
    return open_store(tmp_path / "store")


@pytest.fixture
def copier(store: Store) -> Copier:
    return Copier(store, LinkOptions("http://127.0.0.1:1", "r1", "key-r1"), refuse)


def test_a_seal_waits_for_its_signature(store: Store, copier: Copier) -> None:
    key = open_keys(store).key
    sealed = {one.journal for one in seal_journals(store, None)}  # as between seal and signature
    assert sealed and manifest.read(store.path).unsigned == sealed
    assert copier.waiting() == []
    assert sign_manifest(store, key)
    assert manifest.read(store.path).unsigned == set()
    assert set(copier.waiting()) == sealed


def test_a_signature_that_does_not_come_is_not_awaited_for_ever(
    store: Store, copier: Copier, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_keys(store)
    sealed = {one.journal for one in seal_journals(store, None)}
    assert copier.waiting() == []
    monkeypatch.setattr(copying, "SIGNATURE_S", 0.0)
    assert set(copier.waiting()) == sealed, "the server says what it thinks of it"


def test_a_robot_without_a_key_waits_for_nothing(store: Store, copier: Copier) -> None:
    sealed = {one.journal for one in seal_journals(store, None)}
    assert set(copier.waiting()) == sealed
