"""``black_box.yaml``: a list of blocks, each named after the source that reads it."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args, get_type_hints

from amberbox.core.config import build, field_keys
from amberbox.core.errors import AmberboxError, Problem, did_you_mean
from amberbox.core.names import derive_id, is_id
from amberbox.core.options import option
from amberbox.core.plugins import Plugin, find
from amberbox.core.probe import SOURCE as PROBES
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import Node

# path of a key in ``black_box.yaml``, without the places in lists, to the note that is shown
LEGACY_KEYS: Mapping[str, str] = {
    "default_parameters.max_database_size": "ignored, use robot.yaml store.quota",
    "default_parameters.split_database": "ignored, use robot.yaml store.rotate_mb",
    "default_parameters.db_name": "ignored, use robot.yaml store.path",
    "default_parameters.db_export_dir": "ignored, nothing is dumped; use 'amberbox query -o FILE'",
    "ros.topics.metadata": "ignored, names and types are recorded with the data",
    "zmq.topics.metadata": "ignored, names and types are recorded with the data",
}


DEFAULTS = "default_parameters"
NAMED = ("status",)  # sources whose blocks are always called by their ``name``, also a single one
# ways to a robot that are no sources of their own
INSTEAD: Mapping[str, str] = {
    "dds": "- ros2: {via: dds}",
    "foxglove": "- ros2: {via: bridge}",
    "vda5050": "- mqtt: {vda5050: {}}",
    "zenoh": "- ros2: {via: zenoh}",
}
# planned sources and such ways: earlier versions ignored their blocks, so folders that record have
# them and go on without; elsewhere they are errors
NOT_BUILT_YET = ("mavlink", "modbus", "opcua", "video", *INSTEAD)


@dataclass(frozen=True)
class DefaultParameters:
    """Default values of the keys of topics."""

    max_frequency: float | None = option(None, "keep at most this many per second", unit="Hz")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if self.max_frequency is not None and self.max_frequency <= 0:
            yield "max_frequency", "must be above 0"


@dataclass(frozen=True)
class SourceBlock:
    """One source to run: its plugin, its name in item names, its checked configuration."""

    plugin: str
    name: str
    config: Any
    line: int
    file: str = ""
    node: Node | None = None
    """The block as it was read, to be read again in the process of its source."""


@dataclass(frozen=True)
class _Block:
    """A block as written."""

    plugin: str
    node: Node

    @property
    def given_name(self) -> Node | None:
        return (self.node.mapping or {}).get("name")


@dataclass(frozen=True)
class Blocks:
    """The blocks of ``black_box.yaml``; ``not_built`` names those that are not recorded."""

    sources: tuple[SourceBlock, ...] = ()
    not_built: tuple[str, ...] = ()


def read_blocks(
    root: Node, sources: str, problems: list[Problem], *, has_recorded: bool = False
) -> Blocks:
    """Check every block against its source's ``Config``; problems are appended to ``problems``.

    Blocks of planned sources are errors, or notes in a folder that ``has_recorded`` without them.
    """
    blocks = list(_split(root, problems))
    plugins = find(sources, defines=("Config", "Source"))
    defaults = _defaults(blocks, problems)
    wanted = [block for block in blocks if _is_known(block, plugins, problems, has_recorded)]
    names = _names(wanted, problems)
    built = [
        _build(block, name, plugins[block.plugin], defaults, problems)
        for block, name in zip(wanted, names, strict=True)
    ]
    if not blocks and not any(problem.is_error for problem in problems):
        problems.append(root.problem("file", "lists nothing to record", "add a source block"))
    to_come = (block.plugin for block in blocks if _is_to_come(block, plugins))
    return Blocks(tuple(block for block in built if block), tuple(dict.fromkeys(to_come)))


def _is_to_come(block: _Block, plugins: Mapping[str, Plugin]) -> bool:
    return block.plugin in NOT_BUILT_YET and block.plugin not in plugins


def _split(root: Node, problems: list[Problem]) -> Iterator[_Block]:
    """Yield the blocks of a list of single-key mappings, or of one mapping."""
    if root.mapping is None and root.items is None and root.value is not None:
        problems.append(root.problem("file", f"expected a list of blocks, got {root.kind}"))
    for entry in root.items or (root,):
        for plugin, node in _keys(entry, root, problems):
            yield _Block(plugin, node)


def _keys(entry: Node, root: Node, problems: list[Problem]) -> Iterator[tuple[str, Node]]:
    keys = entry.mapping or {}
    if entry is not root and not keys:
        problems.append(entry.problem("block", f"expected '- source:', got {entry.kind}"))
    elif entry is not root and len(keys) > 1:
        first = next(iter(keys))
        what = f"a block has one key, this has {len(keys)}: {', '.join(keys)}"
        hint = f"indent what belongs to '{first}:' further, and start other blocks with '- '"
        problems.append(entry.problem(first, what, hint))
    else:
        yield from keys.items()


def _defaults(blocks: Sequence[_Block], problems: list[Problem]) -> Node | None:
    """Return the node of the default ``max_frequency``, if there is a valid one."""
    found = [block for block in blocks if block.plugin == DEFAULTS]
    for block in found[1:]:
        problems.append(block.node.problem(DEFAULTS, "is given twice"))
    if not found:
        return None
    built = build(DefaultParameters, found[0].node, problems, DEFAULTS, LEGACY_KEYS.get)
    return (found[0].node.mapping or {}).get("max_frequency") if built else None


def _is_known(
    block: _Block, plugins: Mapping[str, Plugin], problems: list[Problem], has_recorded: bool
) -> bool:
    if block.plugin == DEFAULTS or block.plugin in plugins:
        return block.plugin in plugins
    if _is_to_come(block, plugins):
        what = f"source '{block.plugin}' is not built yet"
        hint = "take the block out, or put # before its lines; the others are recorded"
        if block.plugin in INSTEAD:
            what, hint = f"'{block.plugin}' is no source", f"write {INSTEAD[block.plugin]}"
        if has_recorded:
            what += ": the block is not recorded"
        problems.append(block.node.problem(block.plugin, what, hint, is_error=not has_recorded))
        return False
    known = (*plugins, DEFAULTS, *NOT_BUILT_YET)
    what = f"there is no source '{block.plugin}'{did_you_mean(block.plugin, known)}"
    hint = f"sources: {', '.join(plugins)}"
    problems.append(block.node.problem(block.plugin or "block", what, hint))
    return False


def _names(blocks: Sequence[_Block], problems: list[Problem]) -> list[str]:
    """Return the name that the items of each block start with; report duplicates."""
    shares = Counter(block.plugin for block in blocks)
    names: list[str] = []
    for block in blocks:
        given = block.given_name.text if block.given_name else ""
        own = shares[block.plugin] > 1 or block.plugin in NAMED or given == PROBES
        name = _name(block, problems) if own else block.plugin
        if name in names:
            what = f"a second block is called '{name}'"
            hint = "give each of the blocks of one source a 'name:' of its own"
            problems.append(block.node.problem(block.plugin, what, hint))
        names.append(name)
    return names


def _name(block: _Block, problems: list[Problem]) -> str:
    given = block.given_name
    if given is None or not given.text:
        return block.plugin
    name = derive_id(given.text)
    if not is_id(given.text):
        problems.append(given.problem(f"{block.plugin}.name", f"is '{name}' here", is_error=False))
    return name


def _build(
    block: _Block, name: str, plugin: Plugin, defaults: Node | None, problems: list[Problem]
) -> SourceBlock | None:
    cls = _config_class(block, plugin, problems)
    if cls is None:
        return None
    node = _with_defaults(_without_name(block, name, cls, problems), defaults)
    config = read_config(cls, node, block.plugin, Path(block.node.file).parent, problems)
    problems.extend(_repeated_topics(cls, node, block.plugin))
    problems.extend(_unconverted_images(node, block.plugin))
    if config is None:
        return None
    problems.extend(_notes(config, block))
    return SourceBlock(block.plugin, name, config, block.node.line, block.node.file, node)


def read_config(
    cls: type[Any], node: Node, plugin: str, folder: Path, problems: list[Problem]
) -> Any:
    """Build the configuration of a source; None if it has errors.

    File names of a source are relative to ``folder``, that of ``black_box.yaml``.
    """
    config = build(cls, node, problems, plugin, LEGACY_KEYS.get)
    hook = getattr(config, "in_folder", None)
    return config if hook is None else hook(folder)


def _notes(config: Any, block: _Block) -> Iterator[Problem]:
    """Yield what is wrong with the files that a block names, and notes that are no errors."""
    keys = block.node.mapping or {}
    spellings = {field.name: field_keys(field) for field in dataclasses.fields(config)}
    for hook, is_error in (("wrong_files", True), ("notes", False)):
        for name, what in getattr(config, hook, tuple)():
            key = next(key for key in spellings[name] if key in keys)
            yield keys[key].problem(f"{block.plugin}.{key}", what, is_error=is_error)


def _config_class(block: _Block, plugin: Plugin, problems: list[Problem]) -> type[Any] | None:
    try:
        cls: type[Any] = plugin.load().Config
    except AmberboxError as error:
        problems.append(block.node.problem(block.plugin, error.what, error.hint))
        return None
    return cls


def _without_name(block: _Block, name: str, cls: type[Any], problems: list[Problem]) -> Node:
    """Remove the block's ``name`` where the source's ``Config`` has no such option."""
    given, keys = block.given_name, block.node.mapping
    if given is None or keys is None or any(f.name == "name" for f in dataclasses.fields(cls)):
        return block.node
    if derive_id(given.text) != name:
        what = f"not used: the only '{name}' block is called '{name}'"
        problems.append(given.problem(f"{block.plugin}.name", what, is_error=False))
    return replace(block.node, value={key: keys[key] for key in keys if key != "name"})


def _with_defaults(node: Node, max_frequency: Node | None) -> Node:
    """Set the default in every topic that does not state its own ``max_frequency``."""
    topics = (node.mapping or {}).get("topics")
    if max_frequency is None or node.mapping is None or topics is None or topics.items is None:
        return node
    entries = tuple(_with_frequency(entry, max_frequency) for entry in topics.items)
    return replace(node, value=node.mapping | {"topics": replace(topics, value=entries)})


def _with_frequency(entry: Node, max_frequency: Node) -> Node:
    keys = entry.mapping
    if keys is None:
        return entry
    inner = keys.get("topic")
    if len(keys) == 1 and inner is not None and inner.mapping is not None:
        return replace(entry, value={"topic": _with_frequency(inner, max_frequency)})
    return replace(entry, value={"max_frequency": max_frequency} | keys)


def _topics(node: Node) -> Iterator[tuple[Node, Mapping[str, Node]]]:
    """Yield each topic of a block, and its keys."""
    for place in (node.mapping or {}).get("topics", node).items or ():
        keys = place.mapping or {}
        yield place, keys.get("topic", place).mapping or keys


def _unconverted_images(node: Node, where: str) -> Iterator[Problem]:
    """Yield a note for each topic whose images cannot be converted here."""
    for _, keys in _topics(node):
        if "image" in keys and find_spec("PIL") is None:
            what = (
                "images are kept as they come: the package pillow is not installed here: "
                "pip install 'amberbox[images]'"
            )
            yield keys["image"].problem(f"{where}.topics.image", what, is_error=False)


def _repeated_topics(cls: type[Any], node: Node, where: str) -> Iterator[Problem]:
    """Yield a problem for each topic that is given twice, also if its options are invalid."""
    kind = next(iter(get_args(get_type_hints(cls).get("topics"))), None)
    if not (isinstance(kind, type) and issubclass(kind, TopicOptions)):
        return
    seen: dict[str, int] = {}
    for place, keys in _topics(node):
        name = keys.get("name")
        if name is None or not name.text:
            continue
        if name.text in seen:
            what = f"topic '{name.text}' is given twice, first in line {seen[name.text]}"
            yield place.problem(where, what)
        seen.setdefault(name.text, place.line)
