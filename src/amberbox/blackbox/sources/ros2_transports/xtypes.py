"""Type objects of DDS (XTypes), as some writers send them, as definitions of ROS 2 messages."""

from __future__ import annotations

import re
import typing
from collections.abc import Mapping
from typing import Any

from amberbox.blackbox.sources.ros2_transports.names import type_of_dds
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

MOST_TYPES = 500
MOST_FIELDS = 5000  # of all types in a definition

_FIELD = re.compile(r"[a-z]\w{0,254}", re.ASCII | re.IGNORECASE)
_SEPARATOR = "=" * 80
_PLAIN: Mapping[Any, str] = {
    **{
        kind + bits: kind + bits
        for kind, sizes in (("int", "8 16 32 64"), ("uint", "8 16 32 64"), ("float", "32 64"))
        for bits in sizes.split()
    },
    "byte": "byte",
    "char": "char",
    bool: "bool",
    str: "string",
}


def schema_of_type(root: Any) -> Schema:
    """Return the definition that a type of the package ``cyclonedds`` amounts to.

    Constants and default values are not part of it. Raises AmberboxError for what ROS 2 has none
    of: unions, maps, optional members, several dimensions.
    """
    texts: dict[str, str] = {}
    waiting, fields = [root], 0
    while waiting:
        one = waiting.pop()
        name = _type_name(one)
        if name in texts:
            continue
        lines = []
        for label, hint in typing.get_type_hints(one, include_extras=True).items():
            if not _FIELD.fullmatch(label):
                raise AmberboxError(f"{name} has a field without a proper name")
            written, inner = _written(hint, name, label)
            lines.append(f"{written} {label}\n")
            waiting += [inner] if inner is not None else []
        texts[name] = "".join(lines)
        fields += len(lines)
        if len(texts) > MOST_TYPES or fields > MOST_FIELDS:
            raise AmberboxError(f"{_type_name(root)} has too many types or fields")
    root_name = _type_name(root)
    text = texts.pop(root_name)
    rest = (f"{_SEPARATOR}\nMSG: {name}\n{texts[name]}" for name in sorted(texts))
    return Schema(root_name, "ros2msg", "".join([text, *rest]).encode())


def _type_name(one: Any) -> str:
    name = type_of_dds(str(getattr(one, "__idl_typename__", "")).replace(".", "::"))
    if not name:
        raise AmberboxError("a type in it is none of ROS 2")
    return name


def _written(hint: Any, owner: str, label: str) -> tuple[str, Any]:
    """Return a field's type as a definition writes it, and the struct in it if there is one."""
    detail = getattr(hint, "__metadata__", (hint,))[0]
    kind = type(detail).__name__
    if kind in ("array", "sequence"):
        inner, struct = _written(detail.subtype, owner, label)
        if "[" in inner:
            raise AmberboxError(f"{owner} has a list of lists in {label}")
        if kind == "array":
            return f"{inner}[{int(detail.length)}]", struct
        bound = f"<={int(detail.max_length)}" if detail.max_length else ""
        return f"{inner}[{bound}]", struct
    if kind == "bounded_str":
        return f"string<={int(detail.max_length)}", None
    if isinstance(detail, str | type) and detail in _PLAIN:
        return _PLAIN[detail], None
    if hasattr(detail, "__idl_typename__") and hasattr(detail, "__idl__"):
        return _type_name(detail), detail
    raise AmberboxError(f"{owner} has something in {label} that ROS 2 does not know")
