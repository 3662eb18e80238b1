"""MD5 sums of ROS 1 message definitions, as nodes compare them before they talk."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping

from amberbox.blackbox.unroll.definition import current_names
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

_SEPARATOR = re.compile(r"^={80}[ \t]*$\n?", re.MULTILINE)
_ARRAY = re.compile(r"\[\d*\]$")
_BUILT_IN = {
    *("bool", "byte", "char", "string", "time", "duration", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}


def md5sum(schema: Schema) -> str:
    """Compute the MD5 sum of a full ``ros1msg`` definition.

    It covers constants, then fields, without comments; a structure counts by its own sum
    (http://wiki.ros.org/ROS/Technical%20Overview). Raises AmberboxError when a type is missing.
    """
    text = current_names(schema.data.decode("utf-8", "replace").replace("\r\n", "\n"))
    first, *rest = _SEPARATOR.split(text)
    root = current_names(schema.name)
    known = {root: first}
    for part in rest:
        head, _, body = part.partition("\n")
        known[head.removeprefix("MSG:").strip()] = body
    return _sum_of(root, known, ())


def _sum_of(name: str, known: Mapping[str, str], inside: tuple[str, ...]) -> str:
    if name not in known or name in inside:
        raise AmberboxError(f"the definition of {name} is missing or contains itself")
    constants, fields = [], []
    for line in known[name].splitlines():
        words = line.partition("#")[0].split(None, 1)
        if len(words) < 2:
            continue
        if "=" in words[1]:
            constants.append(_constant(line))
        else:
            fields.append(_field(words[0], words[1].strip(), name, known, (*inside, name)))
    return hashlib.md5("\n".join([*constants, *fields]).encode()).hexdigest()


def _constant(line: str) -> str:
    """Write a constant as it counts; a string's value reaches to the end of the line."""
    kind, rest = line.split(None, 1)
    text = rest if kind == "string" else rest.partition("#")[0]
    name, _, value = text.partition("=")
    shown = value.lstrip() if kind == "string" else value.strip()
    return f"{kind} {name.strip()}={shown}"


def _field(
    kind: str, name: str, inside: str, known: Mapping[str, str], above: tuple[str, ...]
) -> str:
    bare = _ARRAY.sub("", kind)
    if bare in _BUILT_IN:
        return f"{kind} {name}"
    return f"{_sum_of(_full_name(bare, inside, known), known, above)} {name}"


def _full_name(bare: str, inside: str, known: Mapping[str, str]) -> str:
    if bare == "Header":
        return "std_msgs/Header"
    if "/" in bare:
        return bare
    return f"{inside.partition('/')[0]}/{bare}"
