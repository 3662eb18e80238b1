"""Take secrets out of configuration, so that files and listings may leave the robot."""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from amberbox.core.config import WRAPPERS, field_keys
from amberbox.core.fieldtypes import field_types
from amberbox.core.nodes import Node

MASK = "***"
SECRET_WORDS = (
    "password", "passwd", "passphrase", "secret", "token", "credential",
    "api_key", "access_key", "private_key",
)  # fmt: skip
"""What the name of a secret has in it; for ``_`` there may be a space, a hyphen, or nothing."""

SOUNDS_SECRET = "(?:" + "|".join(word.replace("_", "[ _-]?") for word in SECRET_WORDS) + ")"
"""Matches one of these words in a text: a pattern, for ``re.IGNORECASE``."""

_SOUNDS_SECRET = re.compile(SOUNDS_SECRET, re.IGNORECASE)


def word_with(sounds: str) -> str:
    """Return a pattern for a word with one of some words in it, ``SOUNDS_SECRET`` or more.

    Found in linear time: a plain ``\\w*secret\\w*`` would try each ``secret`` of a long word, and
    read on to its end from each. The first one tells as much as the others, but for one with a
    space or hyphen (``API key``), with which the word goes on beyond what ``\\w*`` takes.
    """
    beyond = "|".join(word.replace("_", "[ -]") for word in SECRET_WORDS if "_" in word)
    return rf"(?:(?>\w*?{sounds})|(?>\w*?(?:{beyond})))\w*+"


def sounds_secret(key: str) -> bool:
    """Tell whether what has this name is a secret: ``mqtt_password``, ``apiKey``, ``API key``."""
    return _SOUNDS_SECRET.search(key) is not None


def secrets(cls: type[Any], node: Node) -> Iterator[Node]:
    """Yield the values in a file that the configuration class marks as secret."""
    kinds = field_types(cls)
    for field in dataclasses.fields(cls):
        for key in field_keys(field):
            value = (node.mapping or {}).get(key)
            if value is None:
                continue
            if field.metadata.get("secret"):
                yield value
            else:
                yield from _secrets_below(kinds[field.name], value)


def likely_secrets(node: Node, key: str = "") -> Iterator[Node]:
    """Yield values whose key sounds secret, for blocks of which no class is known."""
    if sounds_secret(key):
        yield node
        return
    for name, value in (node.mapping or {}).items():
        yield from likely_secrets(value, name)
    for entry in node.items or ():
        yield from likely_secrets(entry, key)


def redact(text: str, nodes: Iterable[Node]) -> str:
    """Replace values in the text of their file; comments, layout and anchors stay.

    Of values within each other the outer one is replaced.
    """
    parts, at = [], 0
    for start, end in sorted({node.span for node in nodes}, key=lambda span: (span[0], -span[1])):
        if start >= at and text[start:end].strip():
            parts += [text[at:start], _mask(text[start:end])]
            at = end
    return "".join([*parts, text[at:]])


def as_plain(value: Any) -> Any:
    """Turn a configuration into what JSON can hold, secrets masked."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: _masked(getattr(value, field.name), field)
            for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): as_plain(inner) for key, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [as_plain(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def _mask(written: str) -> str:
    anchor = re.match(r"&\S+\s+", written)
    line_end = "\n" if written.endswith("\n") else ""
    return (anchor[0] if anchor else "") + f"'{MASK}'{line_end}"


def _masked(value: Any, field: dataclasses.Field[Any]) -> Any:
    return MASK if field.metadata.get("secret") and value else as_plain(value)


def _secrets_below(kind: Any, node: Node) -> Iterator[Node]:
    origin = get_origin(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        yield from secrets(kind, node)
    elif origin in (Union, types.UnionType):
        for member in get_args(kind):
            yield from _secrets_below(member, node)
    elif origin in (Sequence, tuple, list):
        for entry in node.items or ():
            yield from _secrets_below(get_args(kind)[0], _inner(entry))
    elif origin in (Mapping, dict):
        for entry in (node.mapping or {}).values():
            yield from _secrets_below(get_args(kind)[1], entry)


def _inner(node: Node) -> Node:
    entries = node.mapping or {}
    if len(entries) == 1 and (key := next(iter(entries))) in WRAPPERS:
        return entries[key]
    return node
