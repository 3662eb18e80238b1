"""Analysers of a ``diagnostic_aggregator`` as components: ROS 1 and ROS 2 parameter files.

A GenericAnalyzer becomes a component that is watched by the entries it collects, an AnalyzerGroup a
component that consists of others. What the aggregator decides (one bad entry is enough, entries
that are missing, their number) the mode ``diagnostics`` decides in the same way.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.agent.commissioning.draft import (
    DiagnosticSign,
    DraftedComponent,
    RecordedTopic,
    RobotDraft,
    escaped,
    free_name,
    id_of,
)
from amberbox.core.config import raise_errors
from amberbox.core.errors import Problem, UsageError
from amberbox.core.safe_text import one_line
from amberbox.core.yaml_nodes import Node, load_yaml

_PARAMETERS = "ros__parameters"
_MOST_DEEP = 16
_TOPIC = "/diagnostics"
_TYPES = {"ros": "diagnostic_msgs/DiagnosticArray", "ros2": "diagnostic_msgs/msg/DiagnosticArray"}
_LONGEST_AGE_S = 600.0
_CHOICES = ("startswith", "contains", "name", "expected", "regex", "find_and_remove_prefix")
_KNOWN = frozenset(
    (*_CHOICES, "type", "path", "remove_prefix", "timeout", "num_items", "discard_stale")
)


@dataclass(frozen=True)
class ImportedAnalysers:
    """The draft made of analysers, and the source that it is for."""

    plugin: str
    draft: RobotDraft


@dataclass
class _Reading:
    """What has been read so far."""

    components: list[DraftedComponent] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    taken: set[str] = field(default_factory=set)


def read_analysers(path: Path) -> ImportedAnalysers:
    """Read a file of analysers; what cannot be imported is named in the remarks of the draft.

    Raises ConfigurationError if it is no YAML, UsageError if it has no analysers.
    """
    problems: list[Problem] = []
    root = load_yaml(path, problems) if path.is_file() else None
    if not path.is_file():
        raise UsageError(f"there is no file '{path}'", "name the YAML of a diagnostic_aggregator")
    raise_errors(problems)
    plugin, analysers = ("", None) if root is None else _found(root)
    if not analysers:
        raise UsageError(
            f"{path} has no analysers",
            "ROS 1: a key 'analyzers'; ROS 2: analysers below 'ros__parameters'",
        )
    reading = _Reading()
    for name, node in analysers.items():
        _read(name, node, "", reading)
    draft = RobotDraft(
        tuple(reading.components),
        (RecordedTopic(_TOPIC, _TYPES[plugin], "what the nodes report of themselves"),),
        diagnostics_topic=_TOPIC,
        remarks=tuple(reading.remarks),
    )
    return ImportedAnalysers(plugin, draft)


def _found(root: Node, depth: int = 0) -> tuple[str, dict[str, Node] | None]:
    """Return the source and the analysers of a file, which may be in any namespace."""
    keys = root.mapping or {}
    if _PARAMETERS in keys:
        inner = keys[_PARAMETERS].mapping or {}
        nested = inner["analyzers"].mapping if "analyzers" in inner else None
        return "ros2", nested or {name: node for name, node in inner.items() if _has_type(node)}
    if "analyzers" in keys:
        return "ros", keys["analyzers"].mapping
    if depth < _MOST_DEEP:
        for node in keys.values():
            plugin, analysers = _found(node, depth + 1)
            if analysers:
                return plugin, analysers
    return "", None


def _has_type(node: Node) -> bool:
    return "type" in (node.mapping or {})


def _read(name: str, node: Node, group: str, reading: _Reading, depth: int = 0) -> str:
    """Add the component of an analyser; return its id, empty if it is not imported."""
    keys = node.mapping or {}
    kind = _text(keys, "type").rpartition("/")[2].rpartition("::")[2]
    path = _text(keys, "path") or name
    where = f"analyser '{one_line(name)}'"
    if kind == "AnalyzerGroup" and depth < _MOST_DEEP:
        return _group(name, node, path, group, reading, depth)
    if kind != "GenericAnalyzer":
        what = f"of type {one_line(kind)}" if kind else "without a type"
        reading.remarks.append(f"{where} {what} is not imported")
        return ""
    unknown = sorted(keys.keys() - _KNOWN)
    if unknown:
        reading.remarks.append(f"{where}: not imported: {', '.join(map(one_line, unknown))}")
    sign = _sign(keys, where, reading)
    if sign is None:
        reading.remarks.append(f"{where} names no entries and is not imported")
        return ""
    component = _new_id(path, group, reading)
    what = f"{path} ({group})" if group else path
    reading.components.append(DraftedComponent(component, one_line(what), diagnostics=sign))
    return component


def _group(name: str, node: Node, path: str, group: str, reading: _Reading, depth: int) -> str:
    keys = node.mapping or {}
    component = _new_id(path, group, reading)
    place = len(reading.components)
    members = keys["analyzers"].mapping if "analyzers" in keys else None
    found = [
        _read(member, below, f"{group}/{path}".strip("/"), reading, depth + 1)
        for member, below in (members or {}).items()
    ]
    parts = tuple(part for part in found if part)
    if not parts:
        reading.remarks.append(f"group '{one_line(name)}' has nothing that could be imported")
        return ""
    what = one_line(f"{path} ({group})" if group else path)
    reading.components.insert(place, DraftedComponent(component, what, parts=parts))
    return component


def _new_id(path: str, group: str, reading: _Reading) -> str:
    wanted = id_of(path)
    if wanted in reading.taken:
        wanted = id_of(f"{group}_{path}")
    return free_name(wanted, reading.taken)


def _sign(keys: Mapping[str, Node], where: str, reading: _Reading) -> DiagnosticSign | None:
    """Return what an analyser collects; one pattern for all that may be there, one for each that
    must be.
    """
    prefixes = [*_texts(keys, "startswith"), *_texts(keys, "find_and_remove_prefix")]
    some = [f"^{escaped(text)}" for text in prefixes]
    some += [escaped(text) for text in _texts(keys, "contains")]
    some += [f"^{escaped(text)}$" for text in _texts(keys, "name")]
    for text in _texts(keys, "regex"):
        try:
            re.compile(text)
        except re.error as error:
            reading.remarks.append(f"{where}: regex '{one_line(text)}' cannot be used: {error}")
            continue
        some.append(f"^(?:{text})$")
    each = [f"^{escaped(text)}$" for text in _texts(keys, "expected")]
    if not some and not each:
        return None
    patterns = ([some[0] if len(some) == 1 else "|".join(some)] if some else []) + each
    return DiagnosticSign(
        tuple(patterns),
        max_age_s=_age_s(keys, where, reading),
        count=_count(keys),
        absent_ok=_text(keys, "discard_stale").lower() == "true",
    )


def _age_s(keys: Mapping[str, Node], where: str, reading: _Reading) -> float:
    value = keys["timeout"].value if "timeout" in keys else 5.0
    if isinstance(value, bool) or not isinstance(value, int | float):
        value = 5.0
    if 0 < value <= _LONGEST_AGE_S:
        return float(value)
    reading.remarks.append(
        f"{where}: timeout {value:g} is not imported: entries are stale after {_LONGEST_AGE_S:g} s"
    )
    return _LONGEST_AGE_S


def _count(keys: Mapping[str, Node]) -> int | None:
    value = keys["num_items"].value if "num_items" in keys else None
    is_count = isinstance(value, int) and not isinstance(value, bool) and value > 0
    return value if is_count and isinstance(value, int) else None


def _text(keys: Mapping[str, Node], key: str) -> str:
    node = keys.get(key)
    return node.text.strip() if node is not None else ""


def _texts(keys: Mapping[str, Node], key: str) -> Iterator[str]:
    """Yield the texts of a key, which may be one text or a list."""
    node = keys.get(key)
    for entry in () if node is None else (node,) if node.items is None else node.items:
        if entry.text:
            yield entry.text
