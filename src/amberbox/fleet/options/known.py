"""The settings that there are: each with its form, what it is about, and what it must not be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.ids import is_id
from amberbox.fleet.alarms.settings import AlarmSettings
from amberbox.fleet.archive.store import OWN, Retention
from amberbox.fleet.jobs.wanted import Downloads
from amberbox.fleet.notifying.settings import Notifications

_LONGEST_S = 1e10
_CLASSES = ("*", OWN, "main", "bulk", "ring", "watch", "keep", "kept")


@dataclass(frozen=True, slots=True)
class Known:
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


def known() -> Mapping[str, Known]:
    """Return the settings by name."""
    return {
        "retention": Known(
            tuple[Retention, ...],
            "how long journals and columns are kept, by robot and class; nothing: for ever",
            "retention.write",
            _refuse_retention,
        ),
        "alarms": Known(AlarmSettings, "when alarms open, when they are over, who is missed"),
        "downloads": Known(Downloads, "how long downloads are kept, and how much room they have"),
        "notifications": Known(Notifications, "who is told of alarms, by mail and by webhook"),
    }


def find(name: str) -> Known:
    """Return a setting; raises UsageError for one that is not there."""
    settings = known()
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
