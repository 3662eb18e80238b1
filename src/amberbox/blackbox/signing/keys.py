"""The robot's signing key: made at the first start, never leaves the store."""

from __future__ import annotations

import importlib.util
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from amberbox.blackbox.store.store import Store
from amberbox.core.ed25519 import is_signed
from amberbox.core.errors import UsageError
from amberbox.core.files import replace_file, write_private

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

PRIVATE = "key"
PUBLIC = "key.pub"
_HEX_DIGITS = 64


@dataclass(frozen=True, slots=True)
class RobotSigningKey:
    """An Ed25519 key; ``public`` is its public half, 64 hex digits."""

    public: str
    _private: Ed25519PrivateKey = field(repr=False)

    def sign(self, message: bytes) -> str:
        """Return the signature of a message, 128 hex digits."""
        return self._private.sign(message).hex()


@dataclass(frozen=True, slots=True)
class StoreKeys:
    """The key to sign with, if there is one, and warnings about it.

    ``is_new``: the key published before was another one, or there was none.
    """

    key: RobotSigningKey | None
    warnings: tuple[str, ...] = ()
    is_new: bool = False


def can_sign() -> bool:
    """Return whether signatures can be made and checked here (cryptography is installed)."""
    return importlib.util.find_spec("cryptography") is not None


def open_keys(store: Store) -> StoreKeys:
    """Read the store's key, or make one at the first start; only the keeper calls this.

    Without a key that can be used everything goes on unsigned, and ``warnings`` hold why.
    """
    if not can_sign():
        return StoreKeys(None, ("nothing is signed: the package cryptography is not installed",))
    path = store.path / PRIVATE
    try:
        made = not path.exists()
        if made:
            # Make a key; a power cut leaves a whole one or none.
            from cryptography.hazmat.primitives import serialization as form
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

            content = Ed25519PrivateKey.generate().private_bytes(
                form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption()
            )
            write_private(path, content.decode("ascii"))
        key, known = _load(path), public_key(store.path)
        warnings = [*_width(path), *_publish(store, key.public, made=made)]
    except (OSError, ValueError, TypeError) as error:
        return StoreKeys(None, (f"nothing is signed: {path} cannot be used: {error}",))
    return StoreKeys(key, tuple(warnings), is_new=known != key.public)


def _load(path: Path) -> RobotSigningKey:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    private = load_pem_private_key(path.read_bytes(), None)
    if not isinstance(private, Ed25519PrivateKey):
        raise ValueError("it is no Ed25519 key")
    return RobotSigningKey(private.public_key().public_bytes_raw().hex(), private)


def _width(path: Path) -> list[str]:
    mode = stat.S_IMODE(path.stat().st_mode)
    if not mode & 0o077:
        return []
    return [f"the private key {path} is open to others (mode {mode:04o}): chmod 600 {path}"]


def _publish(store: Store, public: str, *, made: bool) -> list[str]:
    """Write the public half beside the key; return a warning when another one was there."""
    path = store.path / PUBLIC
    known = public_key(store.path)
    if known == public:
        return []
    replace_file(path, to_pem(public))
    if known is None:
        return []
    how = "a new key was made" if made else "the key was replaced"
    return [f"{how}: {path} held {known}, now it is {public}"]


def to_pem(public: str) -> str:
    """Write a public key as PEM, as ``openssl`` reads it."""
    from cryptography.hazmat.primitives import serialization as form
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(public))
    return key.public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo).decode()


def public_key(store: Path) -> str | None:
    """Return the public key that lies in a store (hex); None without one that can be read."""
    try:
        return _from_pem((store / PUBLIC).read_bytes())
    except (OSError, ValueError, TypeError):
        return None


def _from_pem(content: bytes) -> str:
    if not can_sign():
        raise ValueError("the package cryptography is not installed")
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    key = load_pem_public_key(content)
    if not isinstance(key, Ed25519PublicKey):
        raise ValueError("it is no Ed25519 key")
    return key.public_bytes_raw().hex()


def is_private_key(public: str, store: Path) -> bool | None:
    """Return whether a store's private key belongs to a public one; None if it may not be read."""
    try:
        return _load(store / PRIVATE).public == public
    except PermissionError:
        return None
    except (OSError, ValueError, TypeError):
        return False


def is_key(public: str, content: bytes) -> bool:
    """Return whether the bytes of a file hold this public key (hex)."""
    try:
        return _from_pem(content) == public
    except (ValueError, TypeError):
        return False


def parse_public(text: str) -> str:
    """Read a public key as it was noted: 64 hex digits, or a file with them or with PEM.

    Raises UsageError when it is neither.
    """
    if _is_hex(text):
        return text.lower()
    try:
        content = Path(text).read_bytes()
    except OSError as error:
        _refuse(text, error.strerror or str(error))
    noted = content.decode("ascii", "replace").strip()
    if _is_hex(noted):
        return noted.lower()
    try:
        return _from_pem(content)
    except (ValueError, TypeError) as error:
        _refuse(text, str(error))


def _is_hex(text: str) -> bool:
    return len(text) == _HEX_DIGITS and set(text.lower()) <= set("0123456789abcdef")


def _refuse(text: str, why: str) -> NoReturn:
    hint = "give a copy of the store's key.pub, or the key's 64 hex digits"
    raise UsageError(f"no public key in {text}: {why}", hint)


def holds(public: str, signature: str, message: bytes) -> bool:
    """Return whether a signature (hex) was made with the private half of ``public`` (hex)."""
    try:
        return is_signed(bytes.fromhex(public), bytes.fromhex(signature), message)
    except ValueError:
        return False
