"""Items and variables that the black box will record, worked out without a device.

They follow from the configured sources, their schemas and what earlier recordings hold.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

from amberbox.blackbox.columns.json_schema import EXACT_COMMENT
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.columns.variables import is_same_or_below
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock
from amberbox.blackbox.robot_folder.folder import SOURCES, RobotFolder
from amberbox.core.detector_items import PREFIX, schemas_of_model
from amberbox.core.errors import AmberboxError
from amberbox.core.names import extend_names, item_name, readable_identifier
from amberbox.core.plugins import get
from amberbox.core.source import TopicOptions
from amberbox.core.topic_selection import is_pattern
from amberbox.core.types import ItemSchema, Schema, Topic


@dataclass(frozen=True)
class RecordedItem:
    """An item that will be recorded. ``schema`` is None where its variables are not known.

    ``complete`` is false where only some variables are known: those of ``variable_names``.
    """

    name: str
    source: str
    topic: str
    options: TopicOptions
    schema: ItemSchema | None = None
    chosen: tuple[str, ...] = ()
    """Variables named in ``black_box.yaml``, where the type is not known."""


class RecordedItems:
    """The items of a robot folder: configured ones, and those that sources announce."""

    def __init__(self, folder: RobotFolder, sources: str = SOURCES) -> None:
        self._folder = folder
        known = [(block, _topics(block, sources)) for block in folder.blocks]
        self.items = tuple(
            _named(item for block, topics in known for item in _items(block, topics))
        )
        self.open = tuple(
            block.name
            for block, topics in known
            if topics is None or any(is_pattern(options.name) for options, _ in topics)
        )
        """Names of the blocks that record topics which they do not list by name."""

    @cached_property
    def by_name(self) -> Mapping[str, RecordedItem]:
        """Return the items by name."""
        return {item.name: item for item in self.items}

    def schema(self, item: RecordedItem) -> ItemSchema | None:
        """Return the variables of an item: by its source or type, else as recorded before."""
        return item.schema if item.schema is not None else self._stored.get(item.name)

    def stored(self, name: str) -> ItemSchema | None:
        """Return the variables of an item that was recorded before."""
        return self.detectors.get(name) or self._stored.get(name)

    @cached_property
    def detectors(self) -> Mapping[str, ItemSchema]:
        """Return the items of the detectors that the folder names a model of."""
        options = self._folder.robot.detection
        return {} if options is None else schemas_of_model(options.file(self._folder.path))

    @property
    def awaits_detectors(self) -> bool:
        """Return whether detectors are configured whose model cannot be read here."""
        return self._folder.robot.detection is not None and not self.detectors

    def is_of_detectors(self, name: str) -> bool:
        """Return whether detectors write an item: the watcher records a copy of it."""
        return name.startswith(PREFIX) and name not in self.by_name

    def rate_hz(self, name: str) -> float | None:
        """Return the rate of an item, Hz: as recorded before, at most that of its filter."""
        item = self.by_name.get(name)
        limit_hz = None if item is None else item.options.max_frequency
        known = [rate for rate in (limit_hz, self._rates.get(name)) if rate is not None]
        return min(known, default=None)

    @cached_property
    def _rates(self) -> Mapping[str, float]:
        """Return rows per second of the items that were recorded before."""
        with suppress(AmberboxError, OSError):
            from amberbox.blackbox.query.record import LocalRecord  # needs the store's readers

            if not self._folder.store_path.is_dir():
                return {}
            infos = LocalRecord(self._folder.store_path).items()
            return {info.name: info.rate_hz for info in infos if info.rate_hz is not None}
        return {}

    @cached_property
    def _stored(self) -> Mapping[str, ItemSchema]:
        """Return the items recorded already; empty without a readable store."""
        with suppress(AmberboxError, OSError):
            return _stored_schemas(self._folder)
        return {}


def _stored_schemas(folder: RobotFolder) -> Mapping[str, ItemSchema]:
    from amberbox.blackbox.store.catalogue import (
        query_catalogue,
        union,  # needs the store's readers
    )

    if not folder.store_path.is_dir():
        return {}

    def tables(catalogue: Any) -> Mapping[str, ItemSchema]:
        found = {name: union(versions) for name, versions in catalogue.schemas.items()}
        plain = {
            name: ItemSchema(table.type, table.columns, {}, table.stamp)
            for name, table in found.items()
        }
        return {name: _with_children(name, found, plain) for name in found}

    return query_catalogue(folder.store_path, tables)


def _with_children(
    name: str, tables: Mapping[str, Any], plain: Mapping[str, ItemSchema]
) -> ItemSchema:
    """Return an item's schema with its child tables, by the end of their names."""
    children = {
        child.removeprefix(f"{name}__"): plain[child]
        for child, table in tables.items()
        if table.parent == name
    }
    return replace(plain[name], children=children)


def _topics(block: SourceBlock, sources: str) -> Sequence[tuple[TopicOptions, Topic | None]] | None:
    """Return the topics of a block, as announced if the source knows them; None for all topics."""
    try:
        module = get(sources, block.plugin).load()
        configured = module.Source(block.config, block.name).topics()
        known = getattr(module, "known_topics", None)
        announced = {} if known is None else {topic.name: topic for topic in known(block.config)}
    except AmberboxError:
        return None
    if not configured:
        return [(TopicOptions(topic.name), topic) for topic in announced.values()] or None
    return [(options, announced.get(options.name)) for options in configured]


def _items(
    block: SourceBlock, topics: Sequence[tuple[TopicOptions, Topic | None]] | None
) -> Iterator[RecordedItem]:
    for options, announced in topics or ():
        if is_pattern(options.name):
            continue
        schema = _schema(announced) if announced is not None else schema_of_type(options.type)
        chosen = () if schema is not None else tuple(options.variable_names)
        name = item_name(block.name, options.name)
        yield RecordedItem(name, block.name, options.name, options, schema, chosen)


def _named(items: Iterable[RecordedItem]) -> Iterator[RecordedItem]:
    """Name items as a new store would: a name that is taken gets a suffix."""
    names: dict[str, str] = {}
    for item in items:
        key = f"{item.source} {item.topic.strip('/')}"
        taken = {name.casefold() for name in names.values()}
        names[key] = item.name
        if item.name.casefold() in taken:
            del names[key]
            names = extend_names(names, [key], lambda name: False, readable_identifier)
        yield replace(item, name=names[key])


def _schema(topic: Topic) -> ItemSchema | None:
    """Return the columns of an announced topic; of a JSON Schema those that it declares."""
    if topic.schema is None:
        return None
    schema = topic.schema
    if schema.encoding == "jsonschema":
        document = json.loads(schema.data) | {"$comment": EXACT_COMMENT}
        schema = Schema(schema.name, schema.encoding, json.dumps(document).encode())
    return unroller(replace(topic, schema=schema)).schema


@lru_cache(maxsize=256)
def schema_of_type(name: str) -> ItemSchema | None:
    """Return the columns of a standard ROS type such as ``nav_msgs/Odometry``; None for others."""
    package, _, kind = name.replace("/msg/", "/").partition("/")
    if not package or not kind:
        return None
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    if f"{package}/msg/{kind}" not in store.fielddefs:
        return None
    text, _ = store.generate_msgdef(f"{package}/msg/{kind}")
    schema = Schema(f"{package}/{kind}", "ros1msg", text.encode())
    return unroller(Topic(name, "ros1", schema)).schema


def chosen_place(item: RecordedItem, text: str) -> bool | None:
    """Return whether ``variable_names`` of an item include a variable or a parent of it.

    None if there are no ``variable_names``.
    """
    if not item.chosen:
        return None
    return any(is_same_or_below(text, entry) for entry in item.chosen)
