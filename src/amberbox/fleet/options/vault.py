"""Encrypt secrets in settings with a key that is kept outside the database.

A copy of the database alone then opens nothing. The key is ``secrets.key`` in the server's folder
(mode 0600), made when the first secret is kept. Without it, or with another one, secrets read as
``LOST`` until they are entered again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sqlalchemy import Connection

from amberbox.core.errors import AmberboxError
from amberbox.core.files import write_private
from amberbox.core.redaction import sounds_secret
from amberbox.fleet.database.database import FOLDER

if TYPE_CHECKING:
    from cryptography.fernet import Fernet

FILE: Final = "secrets.key"
LOST: Final = "(cannot be read: enter it again)"
"""Stands for a secret that the key does not open."""
_SEALED: Final = "sealed:1:"


def seal(connection: Connection, value: Any) -> Any:
    """Return plain data with its secrets encrypted; those that are sealed or lost stay."""
    return _with_secrets(value, lambda text: text if _is_done(text) else _sealed(connection, text))


def unseal(connection: Connection, value: Any) -> Any:
    """Return plain data with its secrets in plain text, ``LOST`` where that cannot be had."""
    return _with_secrets(value, lambda text: _opened(connection, text))


def is_plain(value: Any) -> bool:
    """Tell whether a secret stands in plain data unencrypted, as earlier versions kept it."""
    return bool(_with_secrets(value, lambda text: text if _is_done(text) else "") != value)


def _is_done(text: str) -> bool:
    return text == LOST or text.startswith(_SEALED)


def _with_secrets(value: Any, change: Callable[[str], str], key: str = "") -> Any:
    if isinstance(value, Mapping):
        return {name: _with_secrets(inner, change, name) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_with_secrets(inner, change) for inner in value]
    is_secret = isinstance(value, str) and bool(value) and sounds_secret(key)
    return change(value) if is_secret else value


def _sealed(connection: Connection, text: str) -> str:
    path = _path(connection)
    key = _key(path)
    if key is None:
        if path.exists():
            raise AmberboxError(f"{path} holds no key", "move it away: a new one is made then")
        key = _new_key(path)
    return _SEALED + key.encrypt(text.encode()).decode()


def _opened(connection: Connection, text: str) -> str:
    from cryptography.fernet import InvalidToken

    if not text.startswith(_SEALED):
        return text
    path = _path(connection)
    key = _key(path)
    try:
        return LOST if key is None else key.decrypt(text.removeprefix(_SEALED)).decode()
    except InvalidToken:
        return LOST


def _path(connection: Connection) -> Path:
    return Path(connection.get_execution_options()[FOLDER]) / FILE


def _key(path: Path) -> Fernet | None:
    """Read the key; None where there is none, or no key stands in the file."""
    from cryptography.fernet import Fernet

    try:
        if path.stat().st_mode & 0o077:
            path.chmod(0o600)
            logging.getLogger(__name__).warning("%s was readable for others: chmod 600", path)
        return Fernet(path.read_text(encoding="ascii").strip())
    except (OSError, ValueError):
        return None


def _new_key(path: Path) -> Fernet:
    from cryptography.fernet import Fernet

    text = Fernet.generate_key().decode()
    try:
        write_private(path, text + "\n")
    except OSError as error:
        what = f"cannot write {path}: {error.strerror}"
        raise AmberboxError(what, "secrets are kept encrypted: let the server write it") from error
    return Fernet(text)
