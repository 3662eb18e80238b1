"""A layout for Foxglove and Lichtblick: diagnostics, log, plots of variables, and messages.

Viewers open it from their menu of layouts ("Import from file").
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from amberbox.blackbox.query.export_job import View
from amberbox.blackbox.query.export_tables import json_topic, table_streams
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.robot_folder.folder import RobotFolder, planned_items
from amberbox.blackbox.store.catalogue import read_catalogue
from amberbox.blackbox.store.segment_file import can_build
from amberbox.core.types import Column

FILE = "foxglove-layout.json"
DIAGNOSTICS, LOG = "/amberbox/diagnostics", "/amberbox/log"

_PLOTS = 6
_LINES = 4  # variables in a plot
_PLAIN = re.compile(r"[/A-Za-z0-9_-]+")
_DRAWN = re.compile(r"bool|u?int\d+|float\d+")
_NOT_MEASURED = re.compile(r"(^|[/_])(header|stamp|seq|secs?|nsecs?|nanosec|covariance)([/_]|$)")


class PlottedTopic(NamedTuple):
    """A topic, and the paths of its variables that are plotted: ``pose/position/x``."""

    name: str
    paths: Sequence[str] = ()


def layout(topics: Sequence[PlottedTopic]) -> dict[str, Any]:
    """Return the layout for these topics; only the first ones get a plot."""
    plots = [topic for topic in topics if topic.paths][:_PLOTS]
    panels: dict[str, Mapping[str, Any]] = {
        "DiagnosticSummary!statuses": {
            "topicToRender": DIAGNOSTICS, "minLevel": 0, "pinnedIds": [], "hardwareIdFilter": "",
            "sortByLevel": True,
        },
        "DiagnosticStatusPanel!status": {"topicToRender": DIAGNOSTICS, "numericPrecision": 3},
        "RosOut!log": {"topicToRender": LOG, "minLogLevel": 1, "searchTerms": []},
        "RawMessages!messages": {"topicPath": topics[0].name if topics else DIAGNOSTICS},
    }  # fmt: skip
    for number, topic in enumerate(plots):
        panels[f"Plot!plot{number}"] = _plot(topic)
    left = _column(["DiagnosticSummary!statuses", "DiagnosticStatusPanel!status"])
    right = _column([*(name for name in panels if name.startswith("Plot!")),
                     _beside("RosOut!log", "RawMessages!messages", 60)])  # fmt: skip
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _beside(left, right, 30),
    }


def _plot(topic: PlottedTopic) -> dict[str, Any]:
    lines = [
        {"value": _message_path(topic.name, path), "enabled": True,
         "timestampMethod": "receiveTime", "label": path.replace("/", ".")}
        for path in topic.paths[:_LINES]
    ]  # fmt: skip
    return {
        "title": topic.name, "paths": lines, "isSynced": True, "xAxisVal": "timestamp",
        "showXAxisLabels": True, "showYAxisLabels": True, "showLegend": True,
        "legendDisplay": "floating",
    }  # fmt: skip


def _message_path(topic: str, path: str) -> str:
    """Return the address of a field as viewers write it: ``/odom.pose.position.x``."""
    name = topic if _PLAIN.fullmatch(topic) else msgspec.json.encode(topic).decode()
    return f"{name}.{path.replace('/', '.')}"


def _beside(first: Any, second: Any, percent: float) -> dict[str, Any]:
    return {"direction": "row", "first": first, "second": second, "splitPercentage": percent}


def _column(panels: Sequence[Any]) -> Any:
    """Put panels below each other, all of one height."""
    if len(panels) == 1:
        return panels[0]
    rest = _column(panels[1:])
    percent = 100 / len(panels)
    return {"direction": "column", "first": panels[0], "second": rest, "splitPercentage": percent}


def recorded_topics(
    record: Record, items: Sequence[str] = (), *, columns: bool = False
) -> list[PlottedTopic]:
    """Return the topics of a record, with their numbers; with ``columns`` its tables as topics.

    Raises UsageError for an unknown item, and for a record without any.
    """
    catalogue = read_catalogue(record.path, with_segments=can_build())
    streams = table_streams(catalogue, View(items=items))
    found = []
    for stream in streams:
        drawn = [wanted for wanted in stream.wanted if _is_drawn(wanted.column)]
        if columns:
            found.append(PlottedTopic(json_topic(stream).name, [each.name for each in drawn]))
        elif not stream.schema.parent:
            paths = _measured(each.column.path for each in drawn)
            found.append(PlottedTopic(stream.schema.topic, paths))
    return found


def _is_drawn(column: Column) -> bool:
    return _DRAWN.fullmatch(column.type) is not None and not _NOT_MEASURED.search(column.path)


def _measured(paths: Iterable[str]) -> list[str]:
    return [path for path in paths if not _NOT_MEASURED.search(path)]


def add_layout(folder: RobotFolder) -> list[str]:
    """Write the layout of a robot folder, unless there is one; return the names of new files."""
    if (folder.path / FILE).exists():
        return []
    items = planned_items(folder, [])
    topics = [PlottedTopic(item.topic, _measured(item.variables)) for item in items]
    write_layout(folder.path / FILE, topics)
    return [FILE]


def write_layout(path: Path, topics: Sequence[PlottedTopic]) -> None:
    """Write the layout for these topics to a file."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(layout(topics)), indent=2) + b"\n")
