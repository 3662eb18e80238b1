"""The ``ethercat`` block of ``black_box.yaml``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.ethercat.images import InterfaceOptions
from amberbox.core.config import build, raise_errors
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.files import read_at_most
from amberbox.core.options import option
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml

BLOCK = "ethercat"
_MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class EtherCatOptions:
    """The ``ethercat`` block: one or more segments."""

    interfaces: Sequence[InterfaceOptions] = option(doc="the segments")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; opens nothing."""
        if not self.interfaces:
            yield "interfaces", "names no interface"
        names = [one.interface for one in self.interfaces]
        for name in sorted({n for n in names if names.count(n) > 1}):
            yield "interfaces", f"{name} is there twice"
        topics = [topic.name for topic in self.listed()]
        for name in sorted({n for n in topics if topics.count(n) > 1}):
            yield "interfaces", f"two messages are called '{name}'; name them by *_data_items"

    def prefix(self, interface: InterfaceOptions) -> str:
        """Return what the names of ``bus`` and others begin with, where there are several."""
        return "" if len(self.interfaces) == 1 else f"{interface.interface}/"

    def listed(self) -> Sequence[TopicOptions]:
        """Return the topics of all segments, each with its filters; ``bus`` has none."""
        found = []
        for one in self.interfaces:
            for way in ("output", "input"):
                topic = one.topic(way)
                if topic is not None:
                    options = getattr(one, f"{way}_data_items")
                    found.append(options or TopicOptions(topic.name))
            raw = () if one.datagrams == "none" else ("datagrams",)
            found += [TopicOptions(self.prefix(one) + n) for n in ("bus", "al_status", *raw)]
        return found


def read_block(path: Path) -> EtherCatOptions:
    """Read the ``ethercat`` block of a file such as ``black_box.yaml``; raises AmberboxError."""
    text = read_at_most(path, _MOST_BYTES, "pass black_box.yaml")
    problems: list[Problem] = []
    root = parse_yaml(text.decode("utf-8", "replace"), str(path), problems)
    raise_errors(problems)
    entries = (root.items or (root,)) if root is not None else ()
    blocks = [found for e in entries if (found := (e.mapping or {}).get(BLOCK)) is not None]
    if len(blocks) != 1:
        raise AmberboxError(
            f"{path} has {len(blocks) or 'no'} blocks '{BLOCK}:'",
            "docs/robot/sources.md shows the block",
        )
    built = build(EtherCatOptions, blocks[0], problems, BLOCK)
    raise_errors(problems)
    assert built is not None
    return built
