"""The settings, each with its form and checks; secrets are masked when shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
from sqlalchemy import Connection, select

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.names import is_id
from amberbox.core.redaction import MASK, sounds_secret
from amberbox.core.timestamps import maybe_time
from amberbox.server import settings
from amberbox.server.alarms.alarm import AlarmSettings
from amberbox.server.alarms.recipients import Notifications
from amberbox.server.data.downloads import Downloads
from amberbox.server.journals import OWN, Retention
from amberbox.server.schema import OPTION
from amberbox.server.services.context import NotFoundError, Services
from amberbox.server.settings import LOST

_LONGEST_S = 1e10
_CLASSES = ("*", OWN, "main", "bulk", "ring", "watch", "keep", "kept", "act",
            "experiment", "detect")  # fmt: skip


@dataclass(frozen=True, slots=True)
class SettingDefinition:
    """A setting: ``kind`` is its type (its defaults are ``kind()``), ``action`` who may set it.

    ``refuse`` raises UsageError for a value that has the form but makes no sense.
    """

    kind: Any
    about: str
    action: str = "settings.write"
    refuse: Callable[[Any], None] = lambda _: None

    def form(self) -> dict[str, Any]:
        """Return the JSON schema of its values."""
        return msgspec.json.schema(self.kind)


def setting_definitions() -> Mapping[str, SettingDefinition]:
    """Return the settings by name."""
    return {
        "retention": SettingDefinition(
            tuple[Retention, ...],
            "how long journals and columns are kept, by robot and class; nothing: for ever",
            "retention.write",
            _refuse_retention,
        ),
        "alarms": SettingDefinition(
            AlarmSettings, "when alarms open, when they are over, who is missed"
        ),
        "downloads": SettingDefinition(
            Downloads, "how long downloads are kept, and how much room they have"
        ),
        "notifications": SettingDefinition(
            Notifications, "who is told of alarms, by mail and by webhook"
        ),
    }


def setting_definition(name: str) -> SettingDefinition:
    """Return a setting; raises UsageError for an unknown one."""
    settings = setting_definitions()
    if name not in settings:
        listed = f"settings are: {', '.join(settings)}"
        raise UsageError(f"there is no setting '{name}'{did_you_mean(name, settings)}", listed)
    return settings[name]


def _refuse_retention(rules: tuple[Retention, ...]) -> None:
    for rule in rules:
        if rule.robot != "*" and not is_id(rule.robot):
            raise UsageError(f"not a name of a robot: {rule.robot!r}", "'*' is every robot")
        if rule.keeping not in _CLASSES:
            near = did_you_mean(rule.keeping, _CLASSES)
            listed = f"classes are: {', '.join(_CLASSES)}"
            raise UsageError(f"there is no class '{rule.keeping}'{near}", listed)
        for lasts_s in (rule.journals_s, rule.columns_s):
            if lasts_s is not None and not 0 <= lasts_s <= _LONGEST_S:
                what = "a lifetime is a number of seconds, not below 0, 1e10 at most"
                raise UsageError(what, "null: for ever")
    pairs = [(rule.robot, rule.keeping) for rule in rules]
    twice = next((pair for pair in pairs if pairs.count(pair) > 1), None)
    if twice is not None:
        raise UsageError(f"two rules for robot {twice[0]!r} and class {twice[1]!r}", "keep one")


def mask_secrets(value: Any) -> Any:
    """Return what JSON can hold, with secrets masked that are not empty; lost ones are empty."""
    if isinstance(value, Mapping):
        return {key: _cover(key, inner) for key, inner in value.items()}
    return [mask_secrets(inner) for inner in value] if isinstance(value, list | tuple) else value


def restore_secrets(value: Any, before: Any) -> Any:
    """Replace masks by the stored secrets at the same place of the previous value.

    Raises UsageError if there is none, or if it would now be sent to another host or address.
    """
    if isinstance(value, Mapping):
        old = before if isinstance(before, Mapping) else {}
        if any(key in value and value[key] != old.get(key) for key in ("host", "url")):
            old = {}  # it goes elsewhere now: whoever changed that has to know the secret
        return {key: _uncover(key, inner, old.get(key)) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        held = list(before) if isinstance(before, list | tuple) else []
        held += [None] * (len(value) - len(held))
        return [restore_secrets(inner, old) for inner, old in zip(value, held, strict=False)]
    return value


def _cover(key: str, value: Any) -> Any:
    if not (sounds_secret(key) and isinstance(value, str) and value):
        return mask_secrets(value)
    return "" if value == LOST else MASK


def _uncover(key: str, value: Any, before: Any) -> Any:
    if sounds_secret(key) and value == MASK:
        if isinstance(before, str) and before and before != LOST:
            return before
        raise UsageError(
            f"the {key} is masked, and there is none to keep",
            "write it again: it is new, or goes to another host or address now",
        )
    return restore_secrets(value, before)


def read_setting(fleet: Services, name: str) -> Setting:
    """Show a setting; secrets in it are masked."""
    setting = find_setting(name)
    with fleet.database.reading() as connection:
        return setting_line(connection, name, setting)


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting; ``form`` is the JSON schema of its value, ``changed`` null for the defaults."""

    name: str
    about: str
    value: Any
    changed: str | None
    form: dict[str, Any]


def find_setting(name: str) -> SettingDefinition:
    """Return a setting; raises NotFoundError for an unknown one."""
    try:
        return setting_definition(name)
    except UsageError as error:
        raise NotFoundError(error.what) from error


def setting_line(connection: Connection, name: str, setting: SettingDefinition) -> Setting:
    """Return a setting with its value in its published form."""
    value = msgspec.to_builtins(settings.read(connection, name, setting.kind))
    changed_ns = connection.execute(
        select(OPTION.c.changed_ns).where(OPTION.c.name == name)
    ).scalar()
    return Setting(name, setting.about, mask_secrets(value), maybe_time(changed_ns), setting.form())
