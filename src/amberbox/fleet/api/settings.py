"""Settings that admins change while the server runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from fastapi import Body, HTTPException
from sqlalchemy import Connection, select

from amberbox.core.errors import UsageError
from amberbox.fleet.api.access import Caller, Fleet, Routes, Who
from amberbox.fleet.api.forms import Named, missing, shown
from amberbox.fleet.options import options
from amberbox.fleet.options.known import Known, find, known
from amberbox.fleet.options.masking import masked, unmasked
from amberbox.fleet.options.tables import OPTION

routes = Routes("settings")

_MOST_BYTES = 200_000


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting; ``form`` is the JSON schema of its value, ``changed`` null for the defaults."""

    name: str
    about: str
    value: Any
    changed: str | None
    form: dict[str, Any]


@routes.get("/settings", "settings.write")
def list_settings(fleet: Fleet) -> list[Setting]:
    """List all settings with their values; secrets in them are masked."""
    with fleet.database.reading() as connection:
        return [_shown(connection, name, setting) for name, setting in known().items()]


@routes.get("/settings/{name}", "settings.write")
def read_setting(fleet: Fleet, name: Named) -> Setting:
    """Show a setting; secrets in it are masked."""
    setting = _find(name)
    with fleet.database.reading() as connection:
        return _shown(connection, name, setting)


@routes.put("/settings/{name}", "settings.write")
def change_setting(fleet: Fleet, who: Who, name: Named, value: Annotated[Any, Body()]) -> Setting:
    """Replace a setting by a value of its form; a masked secret stays as it is."""
    setting = _find(name)
    _refuse(who, setting, value)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        before = msgspec.to_builtins(options.read(connection, name, setting.kind))
        new = options.parsed(unmasked(value, before), setting.kind)
        setting.refuse(new)
        options.write(connection, now_ns, name, new)
        told = {"before": masked(before), "after": masked(msgspec.to_builtins(new))}
        who.note(connection, now_ns, "settings.change", name, details=told)
        return _shown(connection, name, setting)


def _refuse(who: Caller, setting: Known, value: Any) -> None:
    if not who.may(setting.action):
        raise HTTPException(403, "you may not change this setting")
    try:
        size = len(msgspec.json.encode(value))
    except (UnicodeEncodeError, RecursionError, msgspec.MsgspecError, OverflowError) as error:
        raise UsageError("the setting has text or numbers that cannot be written") from error
    if size > _MOST_BYTES:
        raise UsageError("the setting is too long", f"at most {_MOST_BYTES:,} bytes")


def _find(name: str) -> Known:
    try:
        return find(name)
    except UsageError as error:
        raise missing(error) from error


def _shown(connection: Connection, name: str, setting: Known) -> Setting:
    value = msgspec.to_builtins(options.read(connection, name, setting.kind))
    changed_ns = connection.execute(
        select(OPTION.c.changed_ns).where(OPTION.c.name == name)
    ).scalar()
    return Setting(name, setting.about, masked(value), shown(changed_ns), setting.form())
