"""Read and write settings: each is a dataclass of the room that goes by it, with defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import msgspec
from sqlalchemy import Connection, select

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.options.tables import OPTION

Kind = TypeVar("Kind")


def read(connection: Connection, name: str, kind: type[Kind]) -> Kind:
    """Return a setting; its defaults when nobody has set it, or an older version did otherwise."""
    text = connection.execute(select(OPTION.c.value).where(OPTION.c.name == name)).scalar()
    try:
        return kind() if text is None else msgspec.json.decode(text, type=kind)
    except msgspec.MsgspecError:
        return kind()


def write(connection: Connection, now_ns: int, name: str, value: object) -> None:
    """Keep a setting; the caller adds to the audit log in the same transaction."""
    row = {"name": name, "value": msgspec.json.encode(value).decode(), "changed_ns": now_ns}
    connection.execute(
        upsert(connection.dialect, OPTION, ("name",), ("value", "changed_ns")), [row]
    )


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
