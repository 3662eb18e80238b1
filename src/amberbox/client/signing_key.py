"""A person's Ed25519 keys on their own computer, which sign commands; no server gets them.

Each is a JSON file that only its owner can read, below the folder of sign-ins. With a passphrase
the private half is encrypted: scrypt, then ChaCha20-Poly1305, bound to the public half.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from amberbox.client import credentials
from amberbox.core import ed25519
from amberbox.core.command import CommandError, key_id, key_text, parse_key_text
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import write_private

_FOLDER = "keys"
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
# 2**17 rounds of 1 KiB blocks: 128 MiB and a third of a second
_SCRYPT_N, _SCRYPT_R, _SCRYPT_P = 1 << 17, 8, 1
_SALT_BYTES, _NONCE_BYTES = 16, 12


@dataclass(frozen=True, slots=True)
class SigningKey:
    """A key pair of a person; ``name`` is what its file is called."""

    name: str
    public: bytes
    private: bytes = field(repr=False)

    @property
    def id(self) -> str:
        """Return the id of the key."""
        return key_id(self.public)

    @property
    def text(self) -> str:
        """Return the public half as a trust file has it."""
        return key_text(self.public)


class _Encrypted(Struct, frozen=True):
    salt: bytes
    nonce: bytes
    sealed: bytes
    n: Annotated[int, Meta(ge=2, le=1 << 20)] = _SCRYPT_N


class _KeyFile(Struct, frozen=True):
    public: str
    private: bytes = b""
    encrypted: _Encrypted | None = None


def folder() -> Path:
    """Return the folder of the keys."""
    return credentials.path().parent / _FOLDER


def stored_keys() -> list[str]:
    """Return the names of the keys on this computer."""
    return sorted(path.stem for path in folder().glob("*.key"))


def make_key(name: str, passphrase: str = "") -> SigningKey:
    """Make a key and store it; raises UsageError for a name that is taken or unfit."""
    path = _path(name)
    if path.exists():
        raise UsageError(f"there is a key '{name}' already", "take another --name, or leave --new")
    private = ed25519.new_private_key()
    key = SigningKey(name, ed25519.public_key_of(private), private)
    stored = _KeyFile(key.text, private)
    if passphrase:
        stored = _KeyFile(key.text, encrypted=_encrypted(key, passphrase))
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.parent.chmod(0o700)
    write_private(path, msgspec.json.encode(stored).decode() + "\n")
    return key


def public_key(name: str) -> bytes:
    """Return the public half of a stored key; raises UsageError if there is none."""
    return parse_key_text(_read(name).public)


def read_key(name: str, passphrase: Callable[[], str]) -> SigningKey:
    """Return a stored key; ``passphrase`` is called if it has one.

    Raises UsageError if there is none, if others can read it, or for a wrong passphrase.
    """
    stored = _read(name)
    public = parse_key_text(stored.public)
    private = stored.private
    if stored.encrypted is not None:
        private = _decrypted(stored.encrypted, public, passphrase())
    if len(private) != ed25519.KEY_BYTES or ed25519.public_key_of(private) != public:
        raise AmberboxError(f"the key {_path(name)} is damaged", "take it from a copy, or make one")
    return SigningKey(name, public, private)


def _path(name: str) -> Path:
    if not _NAME.fullmatch(name) or name.startswith("."):
        raise UsageError(f"'{name}' cannot be the name of a key", "letters, digits, _ . -")
    return folder() / f"{name}.key"


def _read(name: str) -> _KeyFile:
    path = _path(name)
    try:
        with path.open("rb") as opened:
            if os.fstat(opened.fileno()).st_mode & 0o077:
                raise UsageError(f"others can read the key {path}", f"chmod 600 {path}")
            found = msgspec.json.decode(opened.read(), type=_KeyFile)
            parse_key_text(found.public)
    except FileNotFoundError:
        known = ", ".join(stored_keys())
        hint = f"--key NAME; there are: {known}" if known else "amberbox sign key --new"
        raise UsageError(f"there is no key '{name}' on this computer", hint) from None
    except (msgspec.MsgspecError, CommandError) as error:
        raise AmberboxError(
            f"the key {path} is damaged", "take it from a copy, or make one"
        ) from error
    return found


def _encrypted(key: SigningKey, passphrase: str) -> _Encrypted:
    from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

    salt, nonce = os.urandom(_SALT_BYTES), os.urandom(_NONCE_BYTES)
    cipher = ChaCha20Poly1305(_derived(passphrase, salt, _SCRYPT_N))
    return _Encrypted(salt, nonce, cipher.encrypt(nonce, key.private, key.public))


def _decrypted(stored: _Encrypted, public: bytes, passphrase: str) -> bytes:
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

    try:
        cipher = ChaCha20Poly1305(_derived(passphrase, stored.salt, stored.n))
        return cipher.decrypt(stored.nonce, stored.sealed, public)
    except (InvalidTag, ValueError):
        raise UsageError("the passphrase is not that of the key", "try again") from None


def _derived(passphrase: str, salt: bytes, n: int) -> bytes:
    from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

    kdf = Scrypt(salt=salt, length=ed25519.KEY_BYTES, n=n, r=_SCRYPT_R, p=_SCRYPT_P)
    return kdf.derive(passphrase.encode())
