"""A new robot folder from a running robot: read what runs, listen, draft, and write it down."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from amberbox.agent.commissioning.analysers import read_analysers
from amberbox.agent.commissioning.draft import (
    RecordedTopic,
    RobotDraft,
    draft_of,
    topics_to_listen,
)
from amberbox.agent.commissioning.folder_files import (
    ROBOT,
    TRIGGERS,
    drafted_files,
    yaml_text,
)
from amberbox.agent.commissioning.observation import block_of, observe, read_robot_graph
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock
from amberbox.blackbox.robot_folder.folder import BLACK_BOX_FILE, ROBOT_FILE, SOURCES
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.names import derive_id
from amberbox.core.plugins import get
from amberbox.core.robot_graph import GraphTopic, RobotGraph
from amberbox.core.safe_text import one_line

GRAPH_S = 5.0  # longest time to collect what runs

_BLACK_BOX = """\
# What the box listens to: each topic that was there, with what was measured in {seconds:g} s.
# Strike out what you do not need. 'amberbox plugins {plugin}' shows all keys: filters, patterns.
{rings}
- {plugin}:
{keys}    topics:
{topics}"""
_RINGS = """\
# Topics with 'keep: ring' are big: only the last 5 minutes are kept, and what an incident pins,
# thinned to 'max_frequency'. Monitors still count every message.
"""
_WIDEST = 90  # column of the comments, at most
_RING = ", keep: ring, max_frequency: 2"


@dataclass(frozen=True)
class NewFolder:
    """The files of a folder by name, and what a person should know of how they came about."""

    files: Mapping[str, str]
    remarks: Sequence[str]


def read_running(plugin: str, address: str) -> tuple[RobotGraph, Mapping[str, Any]]:
    """Return what runs on the robot that a source finds at an address, and the keys of its block.

    Raises AmberboxError where nothing answers.
    """
    module = _live_source(plugin)
    keys: Mapping[str, Any] = module.keys_of(address)
    try:
        return read_robot_graph(block_of(_block(plugin, keys, [])), GRAPH_S), keys
    except UsageError:
        raise
    except AmberboxError as error:
        where = ", ".join(f"{key}: {value}" for key, value in keys.items())
        raise AmberboxError(
            f"no robot answers at {where} ({error.what})",
            error.hint or f"is it on? Another address: --from {plugin}=ADDRESS",
        ) from error


def _live_source(plugin: str) -> ModuleType:
    """Return the module of a source that can be read while a robot runs."""
    module = get(SOURCES, plugin, defines=("Config", "Source")).load()
    if not hasattr(module, "read_graph") or not hasattr(module, "keys_of"):
        raise UsageError(
            f"the source '{plugin}' cannot tell what runs on a robot",
            "ros and ros2 can; without --listen and =ADDRESS its sample is written",
        )
    return module


def learn_folder(
    name: str,
    plugin: str,
    found: tuple[RobotGraph, Mapping[str, Any]],
    seconds: float,
    stop: threading.Event | None = None,
) -> NewFolder:
    """Listen to what runs for so many seconds, and return the files of a folder for it.

    ``name`` is that of the folder, from which the robot's id is derived.
    """
    graph, keys = found
    module = _live_source(plugin)
    names = [topic for topic in topics_to_listen(graph.topics) if _is_name(module, topic.name)]
    odd = [topic.name for topic in graph.topics if not _is_name(module, topic.name)]
    block = block_of(_block(plugin, keys, names))
    seen = observe(replace(graph, topics=tuple(names)), block, seconds, stop)
    draft = draft_of(seen)
    remarks = [*draft.remarks, *map(one_line, seen.remarks)]
    if odd:
        remarks.append(f"{len(odd)} topics with names that {plugin} does not allow are left out")
    files = {
        ROBOT_FILE: ROBOT.replace("{id}", derive_id(name)) + TRIGGERS,
        BLACK_BOX_FILE: black_box_file(plugin, keys, draft.topics, seen.seconds),
        **_watched_files(draft, module, block, graph, seen.seconds),
    }
    return NewFolder(files, remarks)


def learn_block(name: str, text: str, seconds: float, stop: threading.Event | None) -> NewFolder:
    """Return the files of a folder that records what a block in YAML records, with monitors."""
    block = block_of(text)
    module = get(SOURCES, block.plugin).load()
    graph = read_robot_graph(block, GRAPH_S)
    seen = observe(graph, block, seconds, stop)
    recorded = {topic.name for topic in seen.topics}
    topics = tuple(topic for topic in graph.topics if topic.name in recorded)
    draft = draft_of(replace(seen, graph=replace(graph, topics=topics)))
    files = {
        ROBOT_FILE: ROBOT.replace("{id}", derive_id(name)) + TRIGGERS,
        BLACK_BOX_FILE: text,
        **_watched_files(draft, module, block, graph, seen.seconds),
    }
    return NewFolder(files, [*draft.remarks, *map(one_line, seen.remarks)])


def analysers_folder(name: str, path: Path, *, into_existing: bool) -> NewFolder:
    """Return the files of a folder with the analysers of a ``diagnostic_aggregator`` as components.

    ``into_existing`` leaves out what an existing folder has: what it records, and who it is.
    """
    imported = read_analysers(path)
    draft, plugin = imported.draft, imported.plugin
    how = f"made of {one_line(path.name)}"
    files = drafted_files(draft, plugin, {}, how)
    if into_existing:
        del files["fmea.yaml"]
        remarks = [
            *draft.remarks,
            f"record {draft.diagnostics_topic} in {BLACK_BOX_FILE}",
            "fmea.yaml is as before: add what it means when one of them is not well",
        ]
        return NewFolder(files, remarks)
    keys = _live_source(plugin).keys_of("")
    topics = "".join(_topic_rows(draft.topics))
    black_box = f"# What the box listens to; {how}.\n\n- {plugin}:\n"
    black_box += f"{''.join(_key_lines(keys))}    topics:\n{topics}"
    robot = ROBOT.replace("{id}", derive_id(name)) + TRIGGERS
    return NewFolder({ROBOT_FILE: robot, BLACK_BOX_FILE: black_box, **files}, draft.remarks)


def _watched_files(
    draft: RobotDraft, module: ModuleType, block: SourceBlock, graph: RobotGraph, seconds: float
) -> dict[str, str]:
    service_of: Callable[[Any, str], tuple[str, str] | None]
    service_of = getattr(module, "service_of", lambda config, node: None)
    found = {node: service_of(block.config, node) for node in ("", *graph.nodes)}
    probes = {node: probe for node, probe in found.items() if probe is not None}
    when = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    how = f"made {when} from what ran and {seconds:g} s of listening"
    return drafted_files(draft, block.name, probes, how)


def named_apart(plugin: str, keys: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a block whose recorder does not push aside another one of the robot."""
    module = get(SOURCES, plugin).load()
    name = next((f.default for f in fields(module.Config) if f.name == "caller_id"), None)
    return dict(keys) | ({} if name is None else {"caller_id": f"{name}_auto"})


def _is_name(module: ModuleType, name: str) -> bool:
    is_name: Callable[[str], bool] | None = getattr(module.Config, "is_name", None)
    return name.isprintable() and (is_name is None or is_name(name))


def _block(plugin: str, keys: Mapping[str, Any], topics: Sequence[GraphTopic]) -> str:
    """Return a block in the form of ``black_box.yaml`` that listens to topics, or to all."""
    lines = "".join(f"      - topic: {{name: {yaml_text(topic.name)}}}\n" for topic in topics)
    listed = f"    topics:\n{lines}" if topics else "    all_topics: true\n"
    return f"- {plugin}:\n{''.join(_key_lines(keys))}{listed}"


def _key_lines(keys: Mapping[str, Any]) -> Iterator[str]:
    for key, value in keys.items():
        yield f"    {key}: {yaml_text(value) if isinstance(value, str) else json.dumps(value)}\n"


def black_box_file(
    plugin: str, keys: Mapping[str, Any], topics: Sequence[RecordedTopic], seconds: float
) -> str:
    """Return ``black_box.yaml`` with each topic, and what was measured of it."""
    text = _BLACK_BOX.format(
        plugin=plugin,
        seconds=seconds,
        keys="".join(_key_lines(keys)),
        topics="".join(_topic_rows(topics)),
        rings=_RINGS if any(topic.is_big for topic in topics) else "",
    )
    return text if topics else text.replace("    topics:\n", "    all_topics: true\n")


def _topic_rows(topics: Sequence[RecordedTopic]) -> Iterator[str]:
    """Yield the lines of topics, with what is known of each behind it."""
    rows = [
        f"      - topic: {{name: {yaml_text(topic.name)}, type: {yaml_text(topic.type)}"
        f"{_RING if topic.is_big else ''}}}"
        for topic in topics
    ]
    width = min(max(map(len, rows), default=0), _WIDEST)
    for row, topic in zip(rows, topics, strict=True):
        yield f"{row:<{width}}  # {topic.remark}\n"


def refuse_existing(folder: Path, names: Iterable[str] = (ROBOT_FILE, BLACK_BOX_FILE)) -> None:
    """Raise UsageError where a folder has one of the files, or is a file."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"'{folder}' is a file", "name a folder")
    there = [name for name in names if (folder / name).exists()]
    if there:
        what = f"'{folder}' has {file_names(there)} already, nothing was written"
        raise UsageError(
            what, f"edit what is there, or name another folder; amberbox check {folder}"
        )


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write the files of a folder; raise UsageError, and write nothing, if one is there already."""
    refuse_existing(folder, files)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def file_names(names: Iterable[str]) -> str:
    """Return the names of files, with whole folders instead of their contents."""
    return " and ".join(sorted({name.partition("/")[0] for name in names}))
