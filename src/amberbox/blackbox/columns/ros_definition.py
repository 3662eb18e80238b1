"""Parse message definitions of ROS 1 and ROS 2 into types and constants (with ``rosbags``).

Constants become labels of the integer fields they were written for, and fields of common
messages get the units that their documentation fixes (REP 103).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict
    from rosbags.typesys.msg import MSGParser


HEADER = "std_msgs/msg/Header"
# bytes of the primitives of fixed size
SIZES = {
    "bool": 1,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "int32": 4,
    "uint32": 4,
    "int64": 8,
    "uint64": 8,
    "float32": 4,
    "float64": 8,
    "time": 8,
    "duration": 8,
}

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
FILLER = "structure_needs_at_least_one_member"

_SEPARATOR = re.compile(r"^={80}[ \t]*$\n?", re.MULTILINE)
_CONSTANT = re.compile(r"^[ \t]*[\w/<=]+[ \t]+\w+[ \t]*=.*$", re.MULTILINE)
_OLD_HEADER = re.compile(r"\broslib/(msg/)?Header\b")


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of one field.

    ``base`` is a primitive (``float64``, ``string``, ``wstring``, ``time``, ``duration``) or the
    full name of a structure. ``count`` is None for a single value, 0.. for a fixed array,
    -1 for a sequence.
    """

    base: str
    count: int | None = None

    SEQUENCE = -1


@dataclass(frozen=True, slots=True)
class RosStructure:
    """Fields in wire order, and the constants of a message."""

    fields: tuple[tuple[str, FieldType], ...]
    constants: tuple[tuple[str, str, object], ...] = ()


@dataclass(frozen=True, slots=True)
class RosDefinition:
    """A message type with all structures it needs, by their full names (``pkg/msg/Type``)."""

    root: str
    structures: Mapping[str, RosStructure]


def parse_definition(schema: Schema) -> RosDefinition:
    """Parse a ``ros1msg``, ``ros2msg`` or ``ros2idl`` schema.

    Raises ``AmberboxError`` when the text is no definition or a type in it is missing.
    """
    from rosbags.typesys.msg import normalize_msgtype

    types = parse_types(schema)
    root = normalize_msgtype(with_current_names(schema.name))
    structures: dict[str, RosStructure] = {}
    _collect(root, types, structures, schema, ())
    return RosDefinition(root, structures)


def with_current_names(text: str) -> str:
    """Return a ROS 1 definition, or the name of a type, with ``std_msgs/Header`` for its old name.

    Until ROS Diamondback the type was ``roslib/Header`` (REP 100), with the same fields.
    """
    return _OLD_HEADER.sub("std_msgs/Header", text)


def parse_types(schema: Schema) -> Typesdict:
    """Parse a definition into the types of ``rosbags``; raises as ``parse_definition``."""
    text = schema.data.decode("utf-8", "replace").replace("\r\n", "\n")
    parse = _parse_idl if schema.encoding in ("ros2idl", "omgidl") else _parse_msg
    try:
        return parse(with_current_names(text), with_current_names(schema.name))
    except Exception as error:  # rosbags raises many kinds on text that is no definition
        lines = str(error).splitlines() or [type(error).__name__]
        raise AmberboxError(
            f"cannot read the definition of {schema.name}: {lines[-1]}",
            "the messages are still recorded; their columns need a definition that rosbags reads",
        ) from error


def _parse_msg(text: str, name: str) -> Typesdict:
    from rosbags.typesys import TypesysError
    from rosbags.typesys.base import make_typesdict

    normal = _SEPARATOR.sub("=" * 80 + "\n", text)
    try:
        parsed = _parser()(f"MSG: {name}\n{normal}").specification()
    except TypesysError:  # a constant whose value is none: labels are lost, columns are not
        parsed = _parser()(f"MSG: {name}\n{_CONSTANT.sub('', normal)}").specification()
    return make_typesdict(parsed)


@cache
def _parser() -> type[MSGParser]:
    from rosbags.typesys.msg import MSGParser

    class Parser(MSGParser):
        """Parser of all names that ROS 1 allows: ``kRate=1``, ``A__B=1``, ``MyPackage/My__T``."""

        ConstantName = PackageName = MessageName = MSGParser.MixedSnake

    return Parser


def _parse_idl(text: str, _name: str) -> Typesdict:
    from rosbags.typesys import get_types_from_idl

    types: Typesdict = {}
    for part in _SEPARATOR.split(text):
        body = re.sub(r"\AIDL: .*\n", "", part)
        if body.strip():
            types.update(get_types_from_idl(body))
    return types


_ALIASES = {"char": "uint8", TIME: "time", DURATION: "duration"}
_PRIMITIVES = {*SIZES, "byte", "string", "wstring"}


def _collect(
    name: str,
    types: Typesdict,
    done: dict[str, RosStructure],
    schema: Schema,
    inside: tuple[str, ...],
) -> None:
    if name in done:
        return
    if name in inside or name not in types:
        what = "contains itself" if name in inside else "is missing"
        raise AmberboxError(
            f"the definition of {schema.name} cannot be unrolled: {name} {what}",
            "the messages are still recorded, but have no columns",
        )
    constants, fields = types[name]
    typed = tuple((field, _field_type(desc, types)) for field, desc in fields)
    for _, field_type in typed:
        if field_type.base not in _PRIMITIVES:
            _collect(field_type.base, types, done, schema, (*inside, name))
    done[name] = RosStructure(
        typed, tuple((_ALIASES.get(kind, kind), label, value) for label, kind, value in constants)
    )


def _field_type(desc: FieldDesc, types: Typesdict) -> FieldType:
    from rosbags.interfaces import Nodetype

    if desc[0] == Nodetype.ARRAY:
        return FieldType(_base(desc[1][0], types), desc[1][1])
    if desc[0] == Nodetype.SEQUENCE:
        return FieldType(_base(desc[1][0], types), FieldType.SEQUENCE)
    return FieldType(_base((desc[0], desc[1]), types))


def _base(desc: tuple[object, str | tuple[str, int]], types: Typesdict) -> str:
    """Return the name of a field's type; rosbags treats ``wstring`` in a .msg as a structure."""
    name = desc[1] if isinstance(desc[1], str) else desc[1][0]
    if name not in types and name.endswith("/wstring"):
        return "wstring"
    return _ALIASES.get(name, name)


def field_labels(structure: RosStructure) -> Mapping[str, Mapping[int, str]]:
    """Return labels of fields: the constants that name their values.

    A constant belongs to the fields of its own type whose name it starts with (``STATUS_FIX`` to
    ``status``, the longest such name wins). A field that is the only one of its type and has no
    such constants gets all constants of the type.
    """
    labels: dict[str, dict[int, str]] = {}
    for kind in {kind for kind, _, _ in structure.constants}:
        constants = [
            (label, value)
            for constant_kind, label, value in structure.constants
            if constant_kind == kind and isinstance(value, int) and not isinstance(value, bool)
        ]
        fields = [name for name, field in structure.fields if field.base == kind]
        shares: dict[str, list[tuple[str, int]]] = {}
        for label, value in constants:
            owners = [name for name in fields if label.upper().startswith(f"{name.upper()}_")]
            if owners:
                shares.setdefault(max(owners, key=len), []).append((label, value))
        claimed = {name: _by_value(share) for name, share in shares.items()}
        if not claimed and len(fields) == 1 and constants:
            claimed = {fields[0]: _by_value(constants)}
        labels.update(claimed)
    return labels


def _by_value(constants: Sequence[tuple[str, int]]) -> dict[int, str]:
    """Return labels by value; of several labels for one value the first counts."""
    return {value: label for label, value in reversed(constants)}


_FIELD_UNITS = {
    "geometry_msgs/Pose": {"position": "m"},
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Transform": {"translation": "m"},
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "Nm"},
    "sensor_msgs/Imu": {"angular_velocity": "rad/s", "linear_acceleration": "m/s^2"},
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/LaserScan": {
        "angle_min": "rad",
        "angle_max": "rad",
        "angle_increment": "rad",
        "time_increment": "s",
        "scan_time": "s",
        "range_min": "m",
        "range_max": "m",
        "ranges": "m",
    },
    "sensor_msgs/Range": {
        "field_of_view": "rad",
        "min_range": "m",
        "max_range": "m",
        "range": "m",
    },
    "sensor_msgs/BatteryState": {
        "voltage": "V",
        "current": "A",
        "charge": "Ah",
        "capacity": "Ah",
        "design_capacity": "Ah",
        "temperature": "°C",
        "cell_voltage": "V",
        "cell_temperature": "°C",
    },
    "sensor_msgs/NavSatFix": {"latitude": "deg", "longitude": "deg", "altitude": "m"},
    "sensor_msgs/Temperature": {"temperature": "°C"},
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "nav_msgs/MapMetaData": {"resolution": "m"},
}


def known_unit(structure: str, field: str) -> str:
    """Return the unit of a field (and all below it); empty where the type does not fix one."""
    return _FIELD_UNITS.get(structure.replace("/msg/", "/"), {}).get(field, "")
