"""Settings that admins change while the server runs: dataclasses with defaults, stored as JSON.

Secrets in them are encrypted with a key that is stored outside the database.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
from sqlalchemy import Connection, select, update

from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.files import write_private
from amberbox.core.redaction import sounds_secret
from amberbox.server.database import FOLDER, upsert_rows
from amberbox.server.schema import OPTION

if TYPE_CHECKING:
    from cryptography.fernet import Fernet


FILE: Final = "secrets.key"
# Placeholder for a secret that the key does not decrypt
LOST: Final = "(cannot be read: enter it again)"
_SEALED: Final = "sealed:1:"


def seal(connection: Connection, value: Any) -> Any:
    """Return plain data with its secrets encrypted; encrypted or lost ones are not changed."""
    return _with_secrets(value, lambda text: text if _is_done(text) else _sealed(connection, text))


def unseal(connection: Connection, value: Any) -> Any:
    """Return plain data with its secrets decrypted, ``LOST`` where that is impossible."""
    return _with_secrets(value, lambda text: _opened(connection, text))


def is_plain(value: Any) -> bool:
    """Return whether plain data hold an unencrypted secret, as earlier versions stored them."""
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
    """Read the key; None without a valid key file."""
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


Kind = TypeVar("Kind")


def read(connection: Connection, name: str, kind: type[Kind]) -> Kind:
    """Return a setting; its defaults when it is unset or does not fit its type."""
    text = connection.execute(select(OPTION.c.value).where(OPTION.c.name == name)).scalar()
    try:
        if text is None:
            return kind()
        return msgspec.convert(unseal(connection, msgspec.json.decode(text)), kind)
    except msgspec.MsgspecError:
        return kind()


def write(connection: Connection, now_ns: int, name: str, value: object) -> None:
    """Write a setting, with its secrets encrypted.

    The caller adds to the audit log in the same transaction.
    """
    sealed = seal(connection, msgspec.to_builtins(value))
    row = {"name": name, "value": msgspec.json.encode(sealed).decode(), "changed_ns": now_ns}
    upsert_rows(connection, OPTION, [row], ("value", "changed_ns"))


def seal_plain(connection: Connection) -> bool:
    """Encrypt secrets that earlier versions stored in plain text; return whether there were any."""
    found = False
    for row in connection.execute(select(OPTION)).all():
        value = msgspec.json.decode(row.value)
        if is_plain(value):
            found = True
            sealed = msgspec.json.encode(seal(connection, value)).decode()
            kept = update(OPTION).where(OPTION.c.name == row.name)
            connection.execute(kept.values(value=sealed))
    return found


def parsed(value: object, kind: type[Kind]) -> Kind:
    """Convert a setting that a client sent; raises UsageError that names the wrong key."""
    try:
        made = msgspec.convert(value, kind, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise UsageError(f"the setting is not right: {error}", "GET it to see its form") from error
    _refuse_unknown(value, msgspec.to_builtins(made), "the setting")
    return made


def _refuse_unknown(sent: object, known: object, where: str) -> None:
    """Raise UsageError for an unknown key, since it would change nothing."""
    if isinstance(sent, Mapping) and isinstance(known, Mapping):
        for key, value in sent.items():
            if key not in known:
                near = did_you_mean(str(key), [str(one) for one in known])
                raise UsageError(f"{where} has no key {key!r}{near}", f"keys: {', '.join(known)}")
            _refuse_unknown(value, known[key], f"{where}: {key}")
    elif isinstance(sent, list) and isinstance(known, list | tuple):
        for number, (value, its) in enumerate(zip(sent, known, strict=False), 1):
            _refuse_unknown(value, its, f"{where}: entry {number}")
