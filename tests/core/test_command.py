"""Commands: what is decoded, what is refused, and exactly what a signature covers."""

from __future__ import annotations

import hashlib

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core import ed25519
from amberbox.core.command import (
    Command,
    CommandError,
    CommandSignature,
    decode_command,
    encode_command,
    key_id,
    key_text,
    new_command_id,
    parse_key_text,
    sign_command,
    signed_bytes,
    verify_command,
)

PRIVATE = bytes(range(32))
PUBLIC = ed25519.public_key_of(PRIVATE)
COMMAND = Command(
    "0123456789abcdef" * 2, "mira", "drive_linear", '{"distance_m": 1.50}', "anna", "moves",
    run="run 7", step="ä",
)  # fmt: skip
CHALLENGE = b"\x01" * 32


def signed(command: Command = COMMAND) -> Command:
    return sign_command(command, PRIVATE, lease=12, challenge=CHALLENGE, ttl_s=30, server="9f3c")


def test_the_signed_bytes_are_as_documented() -> None:
    """Known bytes, written out here: other programs sign them, too."""
    signature = CommandSignature("0" * 16, 12, CHALLENGE, 30, "9f3c")
    expected = (
        b"amberbox-command-1\0"
        b"\0\0\0\x200123456789abcdef0123456789abcdef" b"\0\0\0\4mira" b"\0\0\0\0049f3c"
        b"\0\0\0\5run 7" b"\0\0\0\2\xc3\xa4" b"\0\0\0\x0cdrive_linear"
        b'\0\0\0\x14{"distance_m": 1.50}' b"\0\0\0\5moves" b"\0\0\0\00212" b"\0\0\0\x20"
        + CHALLENGE + b"\0\0\0\00230"
    )  # fmt: skip
    assert signed_bytes(COMMAND, signature) == expected


def test_a_signed_command_survives_the_way_and_is_verified() -> None:
    command = decode_command(encode_command(signed()))
    assert command == signed() and verify_command(command, PUBLIC)
    assert not verify_command(COMMAND, PUBLIC)
    assert not verify_command(command, ed25519.public_key_of(bytes(32)))


@pytest.mark.parametrize(
    "change",
    [
        {"id": "f" * 32}, {"robot": "other"}, {"action": "drive"}, {"parameters": "{}"},
        {"risk": "state"}, {"run": "run 8"}, {"step": ""},
    ],
    ids=str,
)  # fmt: skip
def test_a_changed_field_is_not_signed(change: dict[str, str]) -> None:
    assert not verify_command(msgspec.structs.replace(signed(), **change), PUBLIC)


@pytest.mark.parametrize(
    "change",
    [
        {"lease": 13}, {"challenge": bytes(32)}, {"ttl_s": 60}, {"server": "9f3d"},
        {"key_id": "0" * 16}, {"signature": bytes(64)}, {"signature": b""},
    ],
    ids=str,
)  # fmt: skip
def test_a_changed_part_of_the_signature_is_not_signed(change: dict[str, object]) -> None:
    command = signed()
    assert command.signature is not None
    other = msgspec.structs.replace(command.signature, **change)
    assert not verify_command(msgspec.structs.replace(command, signature=other), PUBLIC)


@pytest.mark.parametrize(
    "change",
    [
        {"id": "A" * 32}, {"id": "a" * 32 + "\n"}, {"id": ""}, {"robot": "a/b"}, {"robot": ""},
        {"action": "x" * 65}, {"action": "a\0"}, {"issuer": "a\x1b[2J"}, {"run": "r" * 129},
        {"risk": "fun"}, {"created_ns": 2**63}, {"expires_ns": -(2**63)}, {"parameters": "[]"},
        {"parameters": '{"a": 1, "a": 2}'}, {"parameters": '{"a": NaN}'},
        {"parameters": '{"a": 1e999}'}, {"parameters": "{"}, {"parameters": ""},
        {"parameters": '{"a": "\\ud800"}'}, {"parameters": "[" * 5000},
        {"parameters": '{"a":' * 20 + "1" + "}" * 20},
        {"parameters": '{"a": "' + "ä" * 20000 + '"}'},
        {"parameters": '{"a": ' + "1" * 9000 + "}"}, {"risk": "record"},
    ],
    ids=lambda change: str(change)[:40],
)  # fmt: skip
def test_hostile_values_are_no_command(change: dict[str, object]) -> None:
    bad = msgspec.structs.replace(signed(), **change)
    with pytest.raises(CommandError):
        decode_command(msgspec.msgpack.encode(bad))
    with pytest.raises(CommandError):
        encode_command(bad)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_command_or_an_error(data: bytes) -> None:
    with pytest.raises(CommandError):
        decode_command(data)


@given(st.integers(0, 10**6), st.integers(0, 7))
def test_no_changed_bit_moves_a_robot(at: int, bit: int) -> None:
    raw = bytearray(encode_command(signed()))
    raw[at % len(raw)] ^= 1 << bit
    try:
        command = decode_command(bytes(raw))
    except CommandError:
        return
    unsigned = {"issuer": "anna", "created_ns": 0, "expires_ns": 0}
    if verify_command(command, PUBLIC):
        assert msgspec.structs.replace(command, **unsigned) == signed()


def test_too_large_data_are_not_read() -> None:
    with pytest.raises(CommandError, match="bytes"):
        decode_command(bytes(100_000))


def test_ids_and_keys_as_text() -> None:
    assert len({new_command_id() for _ in range(100)}) == 100
    assert key_id(PUBLIC) == hashlib.sha256(PUBLIC).hexdigest()[:16]
    assert parse_key_text(key_text(PUBLIC)) == PUBLIC


@pytest.mark.parametrize(
    "text",
    [
        "", "ed25519:", "ed25519:AAAA", "rsa:AAAA", "ed25519:é",
        "ed25519:" + "A" * 42 + "B=", "ed25519:" + "A" * 43 + "= ",
    ],
)  # fmt: skip
def test_other_texts_are_no_key(text: str) -> None:
    with pytest.raises(CommandError) as error:
        parse_key_text(text)
    assert error.value.hint
