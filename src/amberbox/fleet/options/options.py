"""Read and write settings: each is a dataclass of the room that goes by it, with defaults."""

from __future__ import annotations

from typing import TypeVar

import msgspec
from sqlalchemy import Connection, select

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
        return msgspec.convert(value, kind, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise UsageError(f"the setting is not right: {error}", "GET it to see its form") from error
