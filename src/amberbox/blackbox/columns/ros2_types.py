"""Message types of the ROS 2 distributions: their definitions, and hashes of definitions."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

from amberbox.blackbox.columns.ros_definition import parse_types
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

# ROS 2 distributions whose definitions are known, newest first
DISTRIBUTIONS = (
    "lyrical", "kilted", "jazzy", "iron", "humble", "galactic", "foxy", "eloquent", "dashing",
)  # fmt: skip


def definition_of(distribution: str, type_name: str) -> bytes:
    """Return the definition of a type, with all types in it; empty if it is unknown there."""
    store = _typestore(distribution)
    if type_name not in store.fielddefs:
        return b""
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return str(text).encode()


@cache  # a typestore takes 0.1 s to build and never changes
def _typestore(distribution: str) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores(f"ros2_{distribution}"))


def reads(schema: Schema, message: bytes) -> bool:
    """Return whether a definition reads a CDR message to its last byte."""
    try:
        unroller(Topic("", "cdr", schema), "").rows([message])
    except AmberboxError:
        return False
    return True


def type_hash(schema: Schema) -> str:
    """Return the hash of a definition (REP 2016, ``RIHS01_`` and 64 digits); empty if unknown.

    Types with a ``wstring`` have none here. Raises AmberboxError for text that is no definition.
    """
    from rosbags.typesys import Stores, get_typestore

    store: Any = get_typestore(Stores.EMPTY)
    store.fielddefs = _with_wire_names(parse_types(schema))
    try:
        return str(store.hash_rihs01(schema.name))
    except KeyError:
        return ""


def _with_wire_names(types: Typesdict) -> Typesdict:
    """Name types of services as on the wire: ``rosbags`` puts ``msg/`` into their names."""

    def field(desc: FieldDesc) -> Any:
        kind, rest = desc
        if isinstance(rest, str):
            return kind, _wire_name(rest)
        if isinstance(rest[0], tuple):
            return kind, (field(rest[0]), rest[1])
        return desc

    return {
        _wire_name(name): (constants, [(label, field(desc)) for label, desc in fields])
        for name, (constants, fields) in types.items()
    }


def _wire_name(name: str) -> str:
    return name.replace("/srv/msg/", "/srv/")
