"""The robot's key: created once, private, never lost in a power cut; a change is reported."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from amberbox.blackbox.signing import keys
from amberbox.blackbox.store.store import create_store
from amberbox.core.errors import UsageError

pytest.importorskip("cryptography", reason="signatures need it; pip install 'amberbox[keep]'")


def test_a_key_is_made_once_and_only_its_owner_may_read_it(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    first = keys.open_keys(store)
    assert first.key is not None and first.is_new and not first.warnings
    assert stat.S_IMODE((store.path / "key").stat().st_mode) == 0o600
    again = keys.open_keys(store)
    assert again.key is not None and not again.is_new
    assert again.key.public == first.key.public == keys.public_key(store.path)
    assert not list(store.path.glob("*.part"))


def test_a_signature_holds_for_its_message_and_key_only(tmp_path: Path) -> None:
    key = keys.open_keys(create_store(tmp_path / "one")).key
    other = keys.open_keys(create_store(tmp_path / "two")).key
    assert key is not None and other is not None
    signature = key.sign(b"message")
    assert keys.holds(key.public, signature, b"message")
    assert not keys.holds(key.public, signature, b"massage")
    assert not keys.holds(other.public, signature, b"message")
    assert not keys.holds(key.public, "no hex", b"message")
    assert signature not in repr(key) and "private" not in repr(key)


def test_a_key_open_to_others_is_told(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    keys.open_keys(store)
    (store.path / "key").chmod(0o644)
    (warning,) = keys.open_keys(store).warnings
    assert "open to others (mode 0644)" in warning and "chmod 600" in warning


def test_another_key_than_before_is_told(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    before = keys.open_keys(store).key
    (store.path / "key").unlink()
    found = keys.open_keys(store)
    assert before is not None and found.key is not None and found.is_new
    assert before.public in found.warnings[0] and found.key.public in found.warnings[0]


def test_a_key_that_cannot_be_read_leaves_everything_unsigned(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    (store.path / "key").write_text("rubbish")
    found = keys.open_keys(store)
    assert found.key is None and "nothing is signed" in found.warnings[0]
    assert (store.path / "key").read_text() == "rubbish"


def test_without_the_library_everything_goes_on_unsigned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keys, "can_sign", lambda: False)
    store = create_store(tmp_path / "store")
    found = keys.open_keys(store)
    assert found.key is None and "cryptography" in found.warnings[0]
    assert not (store.path / "key").exists() and keys.public_key(store.path) is None


def test_a_noted_key_is_read_from_hex_and_files(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    key = keys.open_keys(store).key
    assert key is not None
    noted = tmp_path / "noted"
    noted.write_text(key.public.upper() + "\n")
    for text in (key.public, str(store.path / "key.pub"), str(noted)):
        assert keys.parse_public(text) == key.public
    noted.write_text("rubbish")
    for text in (str(noted), "abc", str(store.path / "store.json")):
        with pytest.raises(UsageError, match="no public key"):
            keys.parse_public(text)
