"""What a server answers of alarms, typed."""

from __future__ import annotations

from amberbox.client.models import Answer


class AlarmRobot(Answer, frozen=True):
    """A robot that an alarm is about."""

    robot: str
    from_: str
    to: str | None = None


class Said(Answer, frozen=True):
    """What somebody said of an alarm; ``until`` of what is shelved."""

    who: str
    at: str | None = None
    until: str | None = None
    reason: str = ""


class Window(Answer, frozen=True):
    """Where the data about an alarm are."""

    robot: str
    from_: str
    to: str | None = None


class AlarmLine(Answer, frozen=True):
    """An alarm: ``active`` is whether it lasts, ``state`` what people made of it."""

    id: int
    kind: str
    robots: tuple[AlarmRobot, ...]
    origin: str
    severity: str
    level: str
    state: str
    active: bool
    reason: str
    opened: str
    changed: str
    count: int
    revision: int
    window: Window
    cause: str = ""
    diagnosis: str = ""
    cleared: str | None = None
    late: bool = False
    owner: str = ""
    acknowledged: Said | None = None
    shelved: Said | None = None
    resolved: Said | None = None
    merged_into: int | None = None


class Consequence(Answer, frozen=True):
    """A component that suffers from the root of an alarm."""

    component: str
    level: str
    reason: str
    from_: str
    to: str | None = None


class Happening(Answer, frozen=True):
    """A line of an alarm's history; ``who`` is empty for the server itself."""

    at: str
    who: str
    what: str
    text: str = ""


class AlarmPage(Answer, frozen=True):
    """All that is known of an alarm."""

    alarm: AlarmLine
    consequences: tuple[Consequence, ...] = ()
    history: tuple[Happening, ...] = ()
