"""Texts of ROS 1 definitions: the MD5 sums that nodes compare, and types that a text leaves out.

Both follow http://wiki.ros.org/ROS/Technical%20Overview. They work on the text, because a sum
covers numbers as they were written (``0x10``).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from amberbox.blackbox.columns.ros_definition import with_current_names
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

_SEPARATOR = re.compile(r"^={80}[ \t]*$\n?", re.MULTILINE)
_PARTING = "=" * 80 + "\n"
_DEEPEST = 100  # types inside of types; those of ROS have six levels
_ARRAY = re.compile(r"\[\d*\]$")
_BUILT_IN = {
    *("bool", "byte", "char", "string", "time", "duration", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}


def md5sum(schema: Schema) -> str:
    """Compute the MD5 sum of a full ``ros1msg`` definition.

    It covers constants, then fields, without comments; a structure counts by its own sum.
    Raises AmberboxError when a type is missing.
    """
    return hashlib.md5(_counted(schema).encode()).hexdigest()


def service_md5sum(request: Schema, response: Schema) -> str:
    """Compute the MD5 sum of a service from the full definitions of its two messages."""
    return hashlib.md5((_counted(request) + _counted(response)).encode()).hexdigest()


def _counted(schema: Schema) -> str:
    text = with_current_names(schema.data.decode("utf-8", "replace").replace("\r\n", "\n"))
    root = with_current_names(schema.name)
    return _SumWriter(_parts(root, text)).counted(root, ())


def _parts(root: str, text: str) -> dict[str, str]:
    """Split a full definition into the texts of its types, by name."""
    first, *rest = _SEPARATOR.split(text)
    known = {root: first}
    for part in rest:
        head, _, body = part.partition("\n")
        known[head.removeprefix("MSG:").strip()] = body
    return known


class _SumWriter:
    """Writes the texts of which sums are taken; each type of a definition is summed once."""

    def __init__(self, known: Mapping[str, str]) -> None:
        self._known = known
        self._sums: dict[str, str] = {}

    def counted(self, name: str, inside: tuple[str, ...]) -> str:
        """Return the text of which a type's sum is taken."""
        if name not in self._known or name in inside or len(inside) > _DEEPEST:
            raise AmberboxError(f"the definition of {name} is missing or contains itself")
        constants, fields = [], []
        for line in self._known[name].splitlines():
            words = line.partition("#")[0].split(None, 1)
            if len(words) < 2:
                continue
            if "=" in words[1]:
                constants.append(_constant(line))
            else:
                fields.append(self._field(words[0], words[1].strip(), (*inside, name)))
        return "\n".join([*constants, *fields])

    def _field(self, kind: str, name: str, inside: tuple[str, ...]) -> str:
        bare = _ARRAY.sub("", kind)
        if bare in _BUILT_IN:
            return f"{kind} {name}"
        full = _full_name(bare, inside[-1])
        if full not in self._sums:
            text = self.counted(full, inside)
            self._sums[full] = hashlib.md5(text.encode()).hexdigest()
        return f"{self._sums[full]} {name}"


def _constant(line: str) -> str:
    """Write a constant as it counts; a string's value reaches to the end of the line."""
    kind, rest = line.split(None, 1)
    text = rest if kind == "string" else rest.partition("#")[0]
    name, _, value = text.partition("=")
    shown = value.lstrip() if kind == "string" else value.strip()
    return f"{kind} {name.strip()}={shown}"


def _full_name(bare: str, inside: str) -> str:
    if bare == "Header":
        return "std_msgs/Header"
    if "/" in bare:
        return bare
    return f"{inside.partition('/')[0]}/{bare}"


def with_needed_types(schema: Schema) -> Schema:
    """Add the standard types of ROS 1 that a definition names and does not hold itself.

    A type that is not standard either stays missing: ``parse_definition`` names it.
    """
    text = with_current_names(schema.data.decode("utf-8", "replace").replace("\r\n", "\n"))
    root = with_current_names(schema.name)
    known = _parts(root, text)
    waiting = [(root, kind) for kind in _kinds(known[root])]
    added: dict[str, str] = {}
    done = set()
    while waiting:
        inside, bare = waiting.pop(0)
        name = _full_name(bare, inside)
        if name in done:
            continue
        done.add(name)
        part = known[name] if name in known else _standard(name)
        if part is None:
            continue
        if name not in known:
            added[name] = part
        waiting += [(name, kind) for kind in _kinds(part)]
    ended = "".join(f"{_PARTING}MSG: {name}\n{part}" for name, part in added.items())
    whole = text if not ended or text.endswith("\n") or not text else f"{text}\n"
    return Schema(root, "ros1msg", (whole + ended).encode())


def standard_definition(name: str) -> Schema | None:
    """Return the full definition of a standard type of ROS 1 such as ``nav_msgs/Path``, or None."""
    text = _standard(name)
    return None if text is None else with_needed_types(Schema(name, "ros1msg", text.encode()))


def standard_names() -> list[str]:
    """Return the names of all standard types of ROS 1."""
    return sorted(name.replace("/msg/", "/") for name in _noetic().fielddefs)


def _kinds(part: str) -> Iterator[str]:
    """Yield the structures that the fields of one type name."""
    for line in part.splitlines():
        words = line.partition("#")[0].split(None, 1)
        if len(words) == 2 and "=" not in words[1]:
            bare = _ARRAY.sub("", words[0])
            if bare not in _BUILT_IN:
                yield bare


def _standard(name: str) -> str | None:
    """Return the text of a standard type without those that it needs."""
    full, types = name.replace("/", "/msg/"), _noetic()
    if full not in types.fielddefs:
        return None
    text, _ = types.generate_msgdef(full, ros_version=1)
    return str(text).partition(_PARTING)[0]


@cache  # takes 0.1 s to build and never changes
def _noetic() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)
