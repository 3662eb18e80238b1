"""Read and write settings: each is a dataclass of the room that goes by it, with defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import msgspec
from sqlalchemy import Connection, select, update

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.options.tables import OPTION
from amberbox.fleet.options.vault import is_plain, seal, unseal

Kind = TypeVar("Kind")


def read(connection: Connection, name: str, kind: type[Kind]) -> Kind:
    """Return a setting; its defaults when nobody has set it, or an older version did otherwise."""
    text = connection.execute(select(OPTION.c.value).where(OPTION.c.name == name)).scalar()
    try:
        if text is None:
            return kind()
        return msgspec.convert(unseal(connection, msgspec.json.decode(text)), kind)
    except msgspec.MsgspecError:
        return kind()


def write(connection: Connection, now_ns: int, name: str, value: object) -> None:
    """Keep a setting; the caller adds to the audit log in the same transaction.

    Secrets in it are kept encrypted (``vault.py``).
    """
    sealed = seal(connection, msgspec.to_builtins(value))
    row = {"name": name, "value": msgspec.json.encode(sealed).decode(), "changed_ns": now_ns}
    connection.execute(
        upsert(connection.dialect, OPTION, ("name",), ("value", "changed_ns")), [row]
    )


def seal_plain(connection: Connection) -> bool:
    """Encrypt secrets that an earlier version kept in plain text; tell whether there were any."""
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
    """Make a setting of what somebody sent; raises UsageError that names the key."""
    try:
        made = msgspec.convert(value, kind, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise UsageError(f"the setting is not right: {error}", "GET it to see its form") from error
    _refuse_unknown(value, msgspec.to_builtins(made), "the setting")
    return made


def _refuse_unknown(sent: object, known: object, where: str) -> None:
    """Raise UsageError for a key that was sent and means nothing: it would change nothing."""
    if isinstance(sent, Mapping) and isinstance(known, Mapping):
        for key, value in sent.items():
            if key not in known:
                near = did_you_mean(str(key), [str(one) for one in known])
                raise UsageError(f"{where} has no key {key!r}{near}", f"keys: {', '.join(known)}")
            _refuse_unknown(value, known[key], f"{where}: {key}")
    elif isinstance(sent, list) and isinstance(known, list | tuple):
        for number, (value, its) in enumerate(zip(sent, known, strict=False), 1):
            _refuse_unknown(value, its, f"{where}: entry {number}")
