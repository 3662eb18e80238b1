"""Keys of a person on their own computer: private, encrypted if wanted, damaged or readable."""

from __future__ import annotations

import stat
from pathlib import Path

import msgspec
import pytest

from amberbox.cli.main import main
from amberbox.client import signing_key
from amberbox.core.command import Command, sign_command, verify_command
from amberbox.core.errors import AmberboxError, UsageError


def never() -> str:
    raise AssertionError("this key has no passphrase")


def test_a_key_signs_and_only_its_owner_can_read_it() -> None:
    made = signing_key.make_key("anna")
    read = signing_key.read_key("anna", never)
    assert read == made and signing_key.stored_keys() == ["anna"]
    command = Command("0" * 32, "r1", "light", "{}", "", "state")
    signed = sign_command(command, read.private, lease=1, challenge=bytes(32), ttl_s=9, server="s")
    assert verify_command(signed, signing_key.public_key("anna"))
    [file] = signing_key.folder().iterdir()
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (file, file.parent)]
    assert modes == [0o600, 0o700]
    assert repr(made.private) not in repr(made)
    with pytest.raises(UsageError, match="already"):
        signing_key.make_key("anna")


def test_a_passphrase_hides_the_private_half() -> None:
    made = signing_key.make_key("anna", "correct horse")
    [file] = signing_key.folder().iterdir()
    stored = msgspec.json.decode(file.read_bytes())
    assert stored["private"] == ""
    assert signing_key.public_key("anna") == made.public
    assert signing_key.read_key("anna", lambda: "correct horse") == made
    with pytest.raises(UsageError, match="passphrase"):
        signing_key.read_key("anna", lambda: "wrong horse")
    other = signing_key.make_key("ben")
    stored["public"] = other.text
    file.write_bytes(msgspec.json.encode(stored))
    with pytest.raises(UsageError, match="passphrase"):
        signing_key.read_key("anna", lambda: "correct horse")


@pytest.mark.parametrize("content", [b"", b"{", b'{"public": "ed25519:AA"}', b'{"public": 5}'])
def test_a_damaged_key_is_no_key(content: bytes) -> None:
    made = signing_key.make_key("anna")
    [file] = signing_key.folder().iterdir()
    file.write_bytes(content)
    with pytest.raises(AmberboxError, match="damaged"):
        signing_key.read_key("anna", never)
    halves = {"public": made.text, "private": "AAAA"}
    file.write_bytes(msgspec.json.encode(halves))
    with pytest.raises(AmberboxError, match="damaged"):
        signing_key.read_key("anna", never)


def test_a_key_that_others_can_read_is_not_used() -> None:
    signing_key.make_key("anna")
    [file] = signing_key.folder().iterdir()
    file.chmod(0o640)
    with pytest.raises(UsageError, match="others can read"):
        signing_key.read_key("anna", never)


@pytest.mark.parametrize("name", ["../anna", "", ".anna", "a/b", "a\n", "x" * 65])
def test_a_name_leads_nowhere_else(name: str, home: Path) -> None:
    with pytest.raises(UsageError, match="cannot be the name"):
        signing_key.make_key(name)
    assert not list(home.rglob("*.key"))


def test_the_verb_makes_a_key_and_prints_what_the_trust_file_needs(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["sign", "key", "--name", "anna"]) == 2
    assert "amberbox sign key --new" in capsys.readouterr().err
    assert main(["sign", "key", "--new", "--name", "anna"]) == 0
    key = signing_key.read_key("anna", never)
    assert f'anna: {{key: "{key.text}", risk: state}}' in capsys.readouterr().out
