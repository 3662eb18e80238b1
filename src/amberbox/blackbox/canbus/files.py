"""The files that describe a CAN bus: DBC files, and EDS or DCF files of its CANopen nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.canbus.dbc import read_dbc
from amberbox.blackbox.canbus.definition import CanDefinition, CanDefinitions, Frames
from amberbox.blackbox.canbus.eds import read_eds
from amberbox.core.files import read_at_most

MOST_BYTES = 32 << 20
"""A longer DBC or EDS file is refused."""


def read_definitions(
    dbc: Sequence[Path], nodes: Sequence[CanopenNode] = (), frames: Frames = "unknown"
) -> CanDefinitions:
    """Read DBC and EDS files; raises AmberboxError with file and line."""
    found: list[CanDefinition] = []
    for path in dbc:
        found += read_dbc(path, read_text(path))
    for node in nodes:
        text = None if node.eds is None else read_text(node.eds)
        found += read_eds(node.name, node.id, node.eds, text)
    return CanDefinitions(found, frames)


@dataclass(frozen=True, slots=True)
class CanopenNode:
    """A CANopen node: its number on the bus, its name in topics, its EDS or DCF file."""

    id: int
    name: str
    eds: Path | None = None


def parse_node(text: str) -> CanopenNode:
    """Read ``ID=FILE`` or ``ID``; raises ValueError."""
    number, _, path = text.partition("=")
    return CanopenNode(node_number(number), f"node_{int(number, 0)}", Path(path) if path else None)


def node_number(text: str) -> int:
    """Read the number of a CANopen node, 1 to 127; raises ValueError."""
    number = int(text, 0)
    if not 1 <= number <= 127:
        raise ValueError(f"{text} is no number of a CANopen node; they are 1 to 127")
    return number


def read_text(path: Path) -> str:
    """Read a file of definitions; both formats are older than UTF-8."""
    data = read_at_most(path, MOST_BYTES, "pass the definitions of one bus")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")
