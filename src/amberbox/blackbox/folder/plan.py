"""What a robot folder would record, item by item, as far as the configuration tells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from amberbox.blackbox.folder.blocks import SourceBlock
from amberbox.blackbox.folder.folder import SOURCES, RobotFolder
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.names import extend_names, item_name, readable
from amberbox.core.plugins import get
from amberbox.core.source import TopicOptions


@dataclass(frozen=True)
class PlannedItem:
    """One data item to come; ``type`` is empty where only the bus knows it."""

    item: str
    source: str
    topic: str
    type: str
    max_frequency: float | None
    keep: str
    variables: tuple[str, ...]


def planned_items(
    folder: RobotFolder, problems: list[Problem], sources: str = SOURCES
) -> list[PlannedItem]:
    """List the topics named in the configuration; a source that names none records everything.

    Sources are made but not run, so nothing is opened; one that refuses becomes a problem.
    """
    items = [item for block in folder.blocks for item in _items(block, problems, sources)]
    names: dict[str, str] = {}
    return [_named(item, names) for item in items]


def _named(item: PlannedItem, names: dict[str, str]) -> PlannedItem:
    """Name an item as a new store would: a name that is taken gets a suffix."""
    key = f"{item.source} {item.topic.strip('/')}"
    if item.item.casefold() in {name.casefold() for name in names.values()}:
        names.update(extend_names(names, [key], lambda name: False, readable))
        return replace(item, item=names[key])
    names[key] = item.item
    return item


def _items(block: SourceBlock, problems: list[Problem], sources: str) -> Iterator[PlannedItem]:
    try:
        source = get(sources, block.plugin).load().Source(block.config, block.name)
        topics = source.topics()
    except AmberboxError as error:
        problems.append(Problem(block.file, block.line, block.name, error.what, error.hint))
        return
    yield from (_item(block.name, topic) for topic in topics)


def _item(source: str, topic: TopicOptions) -> PlannedItem:
    return PlannedItem(
        item_name(source, topic.name),
        source,
        topic.name,
        topic.type,
        topic.max_frequency,
        topic.keep,
        tuple(topic.variable_names),
    )
