"""Types of ROS 1 messages, services and actions: MD5 sums, and messages from and to JSON values.

A message is a mapping of its fields; fields that are left out are zero or empty, as in rospy.
Definitions and messages come from peers: every size is limited before memory is taken for it.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from struct import Struct, unpack
from struct import error as StructError  # noqa: N812 (``error`` alone says too little)
from typing import Any

from amberbox.blackbox.columns.ros1_text import (
    md5sum,
    service_md5sum,
    standard_definition,
    standard_names,
    with_needed_types,
)
from amberbox.blackbox.columns.ros_definition import (
    FILLER,
    SIZES,
    FieldType,
    RosDefinition,
    parse_definition,
)
from amberbox.blackbox.sources.ros1.master import TcprosError
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.types import Schema

MOST_BYTES = 16 << 20  # of an encoded message
MOST_VALUES = 1 << 20  # of a message, lists of numbers not counted
MOST_DEFINITION_BYTES = 1 << 18
MOST_PROBLEMS = 20

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/[A-Za-z]\w*", re.ASCII)
UNGIVEN: Any = object()
"""In place of a value that is not known yet: the field is checked by its name only."""

_CODES = {
    "bool": "?", "int8": "b", "byte": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_PACKERS = {kind: Struct(f"<{code}") for kind, code in _CODES.items()}
_LENGTH = Struct("<I")
_TIMES = {"time": Struct("<II"), "duration": Struct("<ii")}
_SECONDS = {"time": (0, 2**32 - 1), "duration": (-(2**31), 2**31 - 1)}


def _range(kind: str) -> tuple[int, int]:
    """Return the least and the greatest number of an integer type."""
    bits = 8 * (1 if kind == "byte" else SIZES[kind])
    return (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


_RANGES = {kind: _range(kind) for kind in _CODES if kind != "bool" and not kind.startswith("f")}


@dataclass(frozen=True)
class MessageType:
    """A message type: its name (``nav_msgs/Path``), MD5 sum, full definition and fields."""

    name: str
    md5sum: str
    definition: str
    fields: RosDefinition = field(repr=False)

    def encode(self, value: Mapping[str, Any], now_ns: int = 0) -> bytes:
        """Write a message; times that are given as ``now`` become ``now_ns``.

        Raises UsageError with every field that is unknown, of another type or out of range.
        """
        writer = _MessageWriter(self.fields, now_ns)
        try:
            writer.structure(self.fields.root, value, "")
        except _TooLargeError as error:
            writer.problems.append(str(error))
        if writer.problems:
            raise UsageError(f"no message of {self.name}: {'; '.join(writer.problems)}")
        return bytes(writer.out)

    def decode(self, data: bytes) -> dict[str, Any]:
        """Read a message; bytes become base64, times ``secs`` and ``nsecs``; raise TcprosError."""
        reader = _MessageReader(self.fields, data)
        try:
            found = reader.structure(self.fields.root)
        except (StructError, UnicodeDecodeError, _TooLargeError) as error:
            raise TcprosError(f"a message of {self.name} does not fit its type: {error}") from error
        if reader.at != len(data):
            left = len(data) - reader.at
            raise TcprosError(f"a message of {self.name} does not fit its type: {left} bytes left")
        return found


@dataclass(frozen=True)
class ServiceType:
    """A service: its name (``std_srvs/Trigger``), MD5 sum, and its two messages."""

    name: str
    md5sum: str
    request: MessageType
    response: MessageType


@dataclass(frozen=True)
class ActionType:
    """An action of actionlib (``actionlib/TestAction``): the messages on three of its topics."""

    name: str
    goal: MessageType
    result: MessageType
    feedback: MessageType


def message_type(name: str, definition: str = "") -> MessageType:
    """Return a message type, by the definition given or the standard one of ROS 1.

    A definition may leave out standard types. Raises UsageError for a type that is not known and
    a definition that cannot be read.
    """
    if not _TYPE_NAME.fullmatch(name):
        raise UsageError(f"'{name}' is not the name of a type", "write PACKAGE/TYPE")
    if len(definition) > MOST_DEFINITION_BYTES:
        raise UsageError(f"the definition of {name} is longer than {MOST_DEFINITION_BYTES} bytes")
    if definition:
        schema = with_needed_types(Schema(name, "ros1msg", definition.encode("utf-8", "replace")))
    else:
        standard = standard_definition(name)
        if standard is None:
            hint = "give its text under 'definition:'"
            raise UsageError(f"{name} is not known{did_you_mean(name, standard_names())}", hint)
        schema = standard
    return _of_schema(schema)


def is_standard(name: str) -> bool:
    """Return whether a type is known without a definition."""
    return standard_definition(name) is not None


def _of_schema(schema: Schema) -> MessageType:
    try:
        fields = parse_definition(schema)
        checksum = md5sum(schema)
    except RecursionError as error:
        raise UsageError(f"the types of {schema.name} are nested too deep") from error
    except AmberboxError as error:
        raise UsageError(error.what, "check the text under 'definition:'") from error
    return MessageType(schema.name, checksum, schema.data.decode(), fields)


_SERVICES = {
    "std_srvs/Empty": "---",
    "std_srvs/Trigger": "---\nbool success\nstring message",
    "std_srvs/SetBool": "bool data\n---\nbool success\nstring message",
}
_ACTIONS = {
    "move_base_msgs/MoveBaseAction": (
        "geometry_msgs/PoseStamped target_pose\n---\n---\ngeometry_msgs/PoseStamped base_position"
    ),
}


def service_type(name: str, definition: str = "") -> ServiceType:
    """Return a service type by its definition: request, a line ``---``, response.

    Peers tell only the sum of a service, so a service that is not in ``std_srvs`` needs its text.
    """
    text = definition or _SERVICES.get(name, "")
    if not text:
        hint = "give its text (request, ---, response) under 'definition:'"
        raise UsageError(f"the service {name} is not known{did_you_mean(name, _SERVICES)}", hint)
    request, response = _divided(name, text, 2)
    both = message_type(f"{name}Request", request), message_type(f"{name}Response", response)
    schemas = [Schema(each.name, "ros1msg", each.definition.encode()) for each in both]
    return ServiceType(name, service_md5sum(*schemas), *both)


def action_type(name: str, definition: str = "") -> ActionType:
    """Return an action type by its definition: goal, ``---``, result, ``---``, feedback."""
    if not name.endswith("Action"):
        raise UsageError(f"'{name}' is not the name of an action", "write PACKAGE/NAMEAction")
    text = definition or _ACTIONS.get(name, "")
    if text:
        base = name.removesuffix("Action")
        parts = _divided(name, text, 3)
        goal, result, feedback = (
            message_type(f"{name}{word}", _wrapped(base, word, part))
            for word, part in zip(("Goal", "Result", "Feedback"), parts, strict=True)
        )
        return ActionType(name, goal, result, feedback)
    if not is_standard(f"{name}Goal"):
        hint = "give its text (goal, ---, result, ---, feedback) under 'definition:'"
        known = [n.removesuffix("Goal") for n in standard_names() if n.endswith("ActionGoal")]
        near = did_you_mean(name, [*known, *_ACTIONS])
        raise UsageError(f"the action {name} is not known{near}", hint)
    return ActionType(name, *(message_type(f"{name}{w}") for w in ("Goal", "Result", "Feedback")))


def _divided(name: str, text: str, count: int) -> list[str]:
    """Split the text of a service or action; types after a line of ``=`` belong to all parts."""
    own, separator, others = text.partition("=" * 80)
    parts = re.split(r"^---[ \t]*$\n?", own, flags=re.MULTILINE)
    if len(parts) != count:
        raise UsageError(
            f"the definition of {name} has {len(parts)} parts, not {count}", "divide it by '---'"
        )
    return [f"{part.rstrip()}\n{separator}{others}" for part in parts]


def _wrapped(base: str, word: str, part: str) -> str:
    """Write the message that carries a goal, result or feedback on its topic."""
    kind = base.partition("/")[2]
    line = "actionlib_msgs/GoalID goal_id" if word == "Goal" else "actionlib_msgs/GoalStatus status"
    separator = "=" * 80
    return (
        f"std_msgs/Header header\n{line}\n{kind}{word} {word.lower()}\n"
        f"{separator}\nMSG: {base}{word}\n{part}"
    )


class _TooLargeError(Exception):
    """A message that takes more memory than is allowed."""


@dataclass
class _Budget:
    """Counts values and bytes, so that no length in a definition or message fills the memory."""

    values: int = 0

    def spend(self, count: int = 1) -> None:
        self.values += count
        if self.values > MOST_VALUES:
            raise _TooLargeError(f"more than {MOST_VALUES} values")


@dataclass
class _MessageWriter:
    definition: RosDefinition
    now_ns: int
    out: bytearray = field(default_factory=bytearray)
    problems: list[str] = field(default_factory=list)
    budget: _Budget = field(default_factory=_Budget)

    def refuse(self, path: str, what: str) -> None:
        self.problems.append(f"{path or 'the message'} {what}")
        if len(self.problems) >= MOST_PROBLEMS:
            raise _TooLargeError("and more")

    def add(self, data: bytes) -> None:
        self.room(len(data))
        self.out += data

    def room(self, size: int) -> None:
        if len(self.out) + size > MOST_BYTES:
            raise _TooLargeError(f"more than {MOST_BYTES} bytes")

    def structure(self, name: str, value: Any, path: str) -> None:
        self.budget.spend()
        fields = self.definition.structures[name].fields
        given = {} if value is UNGIVEN else value
        if not isinstance(given, Mapping):
            self.refuse(path, f"must have the fields of {_short(name)}, {_shown(value)} has none")
            return
        known = [member for member, _ in fields if member != FILLER]
        for key in given:
            if key not in known:
                near = did_you_mean(str(key), known)
                self.refuse(_below(path, key), f"is no field of {_short(name)}{near}")
        for member, kind in fields:
            if member != FILLER:
                self.member(kind, given.get(member, UNGIVEN), _below(path, member))

    def member(self, kind: FieldType, value: Any, path: str) -> None:
        if kind.count is None:
            self.single(kind.base, value, path)
            return
        fixed = kind.count >= 0
        if value is UNGIVEN and fixed and kind.base in SIZES:
            self.room(SIZES[kind.base] * kind.count)
            self.out += bytes(SIZES[kind.base] * kind.count)
            return
        items = self.items(kind, value, path)
        if items is None:
            return
        if fixed and value is not UNGIVEN and len(items) != kind.count:
            self.refuse(path, f"must have {kind.count} values, not {len(items)}")
            return
        if not fixed:
            self.add(_LENGTH.pack(len(items)))
        if isinstance(items, bytes):
            self.add(items)
            return
        for index, item in enumerate(items):
            self.single(kind.base, item, f"{path}/{index}")

    def items(self, kind: FieldType, value: Any, path: str) -> Sequence[Any] | None:
        """Return the values of a list or array, bytes as they are; None if there are none."""
        if value is UNGIVEN:
            count = max(0, kind.count or 0)
            self.budget.spend(count)
            return [UNGIVEN] * count
        if isinstance(value, str) and kind.base == "uint8":
            try:
                return base64.b64decode(value, validate=True)
            except ValueError:
                self.refuse(path, "must be a list of numbers or their bytes as base64")
                return None
        if isinstance(value, str | Mapping) or not isinstance(value, Sequence):
            self.refuse(path, f"must be a list, not {_shown(value)}")
            return None
        return value

    def single(self, base: str, value: Any, path: str) -> None:
        if base in self.definition.structures:
            self.structure(base, value, path)
            return
        self.budget.spend()
        if base in _TIMES:
            self.time(base, value, path)
        elif base == "string":
            self.text(value, path)
        elif base in _PACKERS:
            self.number(base, value, path)
        else:
            self.refuse(path, f"is a {base}, which ROS 1 does not have")

    def number(self, base: str, value: Any, path: str) -> None:
        packer = _PACKERS[base]
        if value is UNGIVEN:
            self.add(bytes(packer.size))
        elif base == "bool":
            if isinstance(value, bool):
                self.add(packer.pack(value))
            else:
                self.refuse(path, f"must be true or false, not {_shown(value)}")
        elif isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(path, f"must be a number, not {_shown(value)}")
        elif base in _RANGES:
            low, high = _RANGES[base]
            if isinstance(value, float) and not value.is_integer():
                self.refuse(path, f"must be a whole number, not {value}")
            elif not low <= value <= high:
                what = f"must be between {low} and {high} ({base}), not {_shown(value)}"
                self.refuse(path, what)
            else:
                self.add(packer.pack(int(value)))
        else:
            try:
                self.add(packer.pack(value))
            except (OverflowError, StructError):
                self.refuse(path, f"is too large for {base}: {_shown(value)}")

    def text(self, value: Any, path: str) -> None:
        text = "" if value is UNGIVEN else value
        if not isinstance(text, str):
            self.refuse(path, f"must be a text, not {_shown(value)}")
            return
        try:
            data = text.encode()
        except UnicodeEncodeError:
            self.refuse(path, "holds half a character")
            return
        self.add(_LENGTH.pack(len(data)) + data)

    def time(self, base: str, value: Any, path: str) -> None:
        total_ns = self.nanoseconds(base, value)
        if total_ns is None:
            wanted = "seconds, 'now' or" if base == "time" else "seconds or"
            self.refuse(path, f"must be {wanted} {{secs: , nsecs: }}, not {_shown(value)}")
            return
        secs, nsecs = divmod(total_ns, NS)
        low, high = _SECONDS[base]
        if low <= secs <= high:
            self.add(_TIMES[base].pack(secs, nsecs))
        else:
            self.refuse(path, f"must be between {low} and {high} seconds, not {_shown(secs)}")

    def nanoseconds(self, base: str, value: Any) -> int | None:
        """Return a time in nanoseconds; None for what is none."""
        if value is UNGIVEN:
            return 0
        if value == "now" and base == "time":
            return self.now_ns
        if isinstance(value, Mapping):
            parts = [value.get(key, 0) for key in ("secs", "nsecs")]
            if value.keys() - {"secs", "nsecs"} or not all(type(part) is int for part in parts):
                return None
            return parts[0] * NS + parts[1] if 0 <= parts[1] < NS else None
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            return None
        return value * NS if isinstance(value, int) else round(value * NS)


@dataclass
class _MessageReader:
    definition: RosDefinition
    data: bytes
    at: int = 0
    budget: _Budget = field(default_factory=_Budget)

    def structure(self, name: str) -> dict[str, Any]:
        self.budget.spend()
        fields = self.definition.structures[name].fields
        return {member: self.member(kind) for member, kind in fields if member != FILLER}

    def member(self, kind: FieldType) -> Any:
        base = kind.base
        if kind.count is None:
            return self.single(base)
        count = kind.count if kind.count >= 0 else self.unpack(_LENGTH)[0]
        if base == "uint8":
            return base64.b64encode(self.take(count)).decode()
        if base in _PACKERS:
            size = _PACKERS[base].size
            return list(unpack(f"<{count}{_CODES[base]}", self.take(size * count)))
        self.budget.spend(count)
        return [self.single(base) for _ in range(count)]

    def single(self, base: str) -> Any:
        if base in self.definition.structures:
            return self.structure(base)
        if base in _TIMES:
            secs, nsecs = self.unpack(_TIMES[base])
            return {"secs": secs, "nsecs": nsecs}
        if base == "string":
            return self.take(self.unpack(_LENGTH)[0]).decode("utf-8", "replace")
        if base not in _PACKERS:
            raise _TooLargeError(f"ROS 1 has no {base}")
        return self.unpack(_PACKERS[base])[0]

    def unpack(self, struct: Struct) -> tuple[Any, ...]:
        found = struct.unpack_from(self.data, self.at)
        self.at += struct.size
        return found

    def take(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise _TooLargeError(f"it ends {size - len(self.data) + self.at} bytes too early")
        self.at += size
        return self.data[self.at - size : self.at]


def _below(path: str, member: object) -> str:
    return f"{path}/{member}" if path else str(member)


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _shown(value: Any) -> str:
    """Show a value in one short line."""
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, Iterable) and not isinstance(value, str):
        return "a list"
    try:
        text = repr(value)
    except ValueError:  # Python does not print an integer of more than 4300 digits
        return "an endless number"
    return text if len(text) <= 40 else f"{text[:40]}..."
