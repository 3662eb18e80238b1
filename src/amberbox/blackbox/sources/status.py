"""Statuses of another robot, as its watcher writes them: the members of a team."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.own_records import OwnRecords, WrittenRecord
from amberbox.blackbox.store.store import open_store, store_path
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.types import Schema, Topic

SAMPLE = """\
- status:
    where: ../ropod_001
    topics:
      - topic: {name: robot}
      - topic: {name: laser, max_frequency: 1}
"""
PASSIVE = "reads the record of {config.where}; nothing there is written to"

ROBOT = "robot"  # topic of the member as a whole
WRITER = "watch"
# levels from good to bad; ``level_code`` is the index of a level
LEVELS = ("ok", "warn", "unknown", "stale", "error")

_POLL_S = 0.1
_RETRY_S = 1.0
# a watcher that writes nothing for this long is silent; it writes all statuses every second
_SILENT_S = 3.0
_ROUND_NS = 5 * NS // 2
_TEXT, _COUNT, _NUMBER = {"type": "string"}, {"type": "integer"}, {"type": "number"}
_COMMON = {"level": _TEXT, "level_code": _COUNT, "reason": _TEXT, "measured_ns": _COUNT}
_FIELDS: Mapping[str, Mapping[str, Any]] = {
    "component": {**_COMMON, "state": _TEXT, "blocked_by": _TEXT, "since_ns": _COUNT,
                  "age_s": _NUMBER},
    "robot": {**_COMMON, "worst": _TEXT, "components": _COUNT,
              **dict.fromkeys(LEVELS, _COUNT), "alarms": _COUNT, "age_s": _NUMBER},
}  # fmt: skip


@dataclass(frozen=True)
class StatusOptions:
    """The ``status`` block."""

    where: str = option(doc="the member: its robot folder or its store, seen from this folder")
    topics: Sequence[TopicOptions] = option(
        (), "components to record, and robot for all together; everything when absent"
    )
    late_s: float = option(
        5.0, "what was written so long after it was measured is left out", unit="s"
    )

    def in_folder(self, folder: Path) -> StatusOptions:
        """Return the same with the place seen from a folder."""
        return replace(self, where=str(folder / Path(self.where).expanduser()))

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield a note if the member does not exist yet."""
        if not Path(self.where).exists():
            yield "where", f"there is nothing at {self.where} yet"

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if self.late_s <= 0:
            yield "late_s", "must be above 0"


Config = StatusOptions


def known_topics(config: StatusOptions) -> Sequence[Topic]:
    """Return the topics that are configured; without any, the member's own folder names them."""
    return [_topic(options.name) for options in config.topics]


def _topic(name: str) -> Topic:
    kind = "robot" if name == ROBOT else "component"
    document = {"type": "object", "properties": _FIELDS[kind]}
    schema = Schema(f"amberbox/{kind}_status", "jsonschema", msgspec.json.encode(document))
    return Topic(name, "json", schema)


class StatusSource:
    """Follows the statuses that the watcher of one member writes."""

    lossless = False

    def __init__(self, config: StatusOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Follow until ``stop`` is set; wait for a member that does not exist yet."""
        member: _Member | None = None
        is_reported = False
        while not stop.is_set():
            if member is None:
                try:
                    member = _Member(self.config, sink)
                except AmberboxError as error:
                    if not is_reported:
                        text = f"{error.what}; it is tried again"
                        sink.event("unreachable", text, where=self.config.where)
                    is_reported = True
            if member is not None:
                member.step()
            stop.wait(_RETRY_S if member is None else _POLL_S)
        if member is not None:
            member.down("stopped")


Source = StatusSource


@dataclass
class _Member:
    """The state of the member: the newest statuses of its components, and its alarms."""

    config: StatusOptions
    sink: Sink
    streams: dict[str, int] = field(default_factory=dict)
    newest: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    alarms: dict[str, str] = field(default_factory=dict)
    is_up: bool = False
    received_s: float = 0.0

    def __post_init__(self) -> None:
        store = open_store(store_path(self.config.where))
        self._statuses = OwnRecords(store, WRITER, {channels.STATUS})
        self._statuses.skip()  # older statuses are not current
        self._alarms = OwnRecords(store, WRITER, {channels.ALARM})
        self._wanted = {topic.name for topic in self.config.topics}

    def step(self) -> None:
        """Publish new records; report the links as down when the watcher is silent."""
        statuses = [
            record
            for record in self._statuses.step()  # not those that the watcher catches up with
            if _age_s(record) <= self.config.late_s or bool(record.values["live_only"])
        ]
        components = [record for record in statuses if not record.values["mode"]]
        now_s = time.monotonic()
        if components:
            self.received_s = now_s
            for record in self._alarms.step():
                self.alarms[record.values["id"]] = record.values["state"]
            self._hand_on(components)
        elif self.is_up and now_s - self.received_s > _SILENT_S:
            name = Path(self.config.where).name
            self.down(f"the watcher of {name} has said nothing for {_SILENT_S:g} s")

    def down(self, reason: str) -> None:
        """Report the links as down."""
        if self.is_up:
            self.is_up = False
            for topic in self.streams:
                self.sink.link_down(topic, self.config.where, reason)

    def _hand_on(self, records: Sequence[WrittenRecord]) -> None:
        if not self.is_up:
            self.is_up = True
            for topic in self.streams:
                self.sink.link_up(topic, self.config.where)
        for record in records:
            component = record.values["component"]
            self.newest[component] = record.values
            self._publish(topic_name(component), _component_row(record))
        newest_ns = max(values["measured_ns"] for values in self.newest.values())
        self.newest = {
            component: values
            for component, values in self.newest.items()
            if values["measured_ns"] >= newest_ns - _ROUND_NS
        }
        self._publish(ROBOT, self._robot_row(records[-1]))

    def _robot_row(self, last: WrittenRecord) -> Mapping[str, Any]:
        known = [v for v in self.newest.values() if v["state"] != "not_monitored"]
        counts = Counter(values["level"] for values in known)
        worst = max(known, key=lambda values: LEVELS.index(values["level"]), default=None)
        level = "unknown" if worst is None else worst["level"]
        standing = sum(state in ("open", "acknowledged") for state in self.alarms.values())
        return {
            "level": level,
            "level_code": LEVELS.index(level),
            "reason": "nothing is monitored" if worst is None else worst["reason"],
            "measured_ns": last.values["measured_ns"],
            "worst": "" if worst is None or level == "ok" else worst["component"],
            "components": len(known),
            **{name: counts[name] for name in LEVELS},
            "alarms": standing,
            "age_s": _age_s(last),
        }

    def _publish(self, topic: str, row: Mapping[str, Any]) -> None:
        if self._wanted and topic not in self._wanted:
            return
        if topic not in self.streams:
            self.streams[topic] = self.sink.topic(_topic(topic))
            self.sink.link_up(topic, self.config.where)
        data = msgspec.json.encode(row)
        self.sink.message(self.streams[topic], data, self.sink.now_ns())


def topic_name(component: str) -> str:
    """Return the topic of a component; one called ``robot`` gets a suffix."""
    return f"{ROBOT}_component" if component == ROBOT else component


def _component_row(record: WrittenRecord) -> Mapping[str, Any]:
    values = record.values
    return {
        "level": values["level"],
        "level_code": LEVELS.index(values["level"]),
        "reason": values["reason"],
        "measured_ns": values["measured_ns"],
        "state": values["state"],
        "blocked_by": ", ".join(values["blocked_by"]),
        "since_ns": values["since_ns"],
        "age_s": _age_s(record),
    }


def _age_s(record: WrittenRecord) -> float:
    """Return the seconds from a measurement to its record, both by the member's clock."""
    return float((record.wall_ns - record.values["measured_ns"]) / NS)
