"""Take secrets out of configuration, so that files and listings may leave the robot."""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from amberbox.core.config import WRAPPERS, field_keys, field_types
from amberbox.core.yaml_nodes import Node

MASK = "***"
# in names of secrets; for ``_`` also a space, a hyphen, or nothing
SECRET_WORDS = (
    "password", "passwd", "passphrase", "secret", "token", "credential",
    "api_key", "access_key", "private_key",
)  # fmt: skip

# pattern of one of these words, for ``re.IGNORECASE``
SOUNDS_SECRET = "(?:" + "|".join(word.replace("_", "[ _-]?") for word in SECRET_WORDS) + ")"

_SOUNDS_SECRET = re.compile(SOUNDS_SECRET, re.IGNORECASE)


def secret_word_pattern(sounds: str) -> str:
    """Return a pattern for a word with one of some words in it, ``SOUNDS_SECRET`` or more.

    Found in linear time: a plain ``\\w*secret\\w*`` would try each ``secret`` of a long word, and
    read on to its end from each. The first one is enough, except for one with a space or hyphen
    (``API key``), with which the word goes on beyond what ``\\w*`` takes.
    """
    beyond = "|".join(word.replace("_", "[ -]") for word in SECRET_WORDS if "_" in word)
    return rf"(?:(?>\w*?{sounds})|(?>\w*?(?:{beyond})))\w*+"


def sounds_secret(key: str) -> bool:
    """Return whether a key names a secret: ``mqtt_password``, ``apiKey``, ``API key``."""
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


def secrets_by_name(node: Node, key: str = "") -> Iterator[Node]:
    """Yield values whose key suggests a secret, for blocks without a known class."""
    if sounds_secret(key):
        yield node
        return
    for name, value in (node.mapping or {}).items():
        yield from secrets_by_name(value, name)
    for entry in node.items or ():
        yield from secrets_by_name(entry, key)


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


def masked_values(value: Any) -> Any:
    """Convert a configuration to JSON-compatible values, secrets masked."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: MASK
            if field.metadata.get("secret") and getattr(value, field.name)
            else masked_values(getattr(value, field.name))
            for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): masked_values(inner) for key, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [masked_values(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def _mask(written: str) -> str:
    anchor = re.match(r"&\S+\s+", written)
    line_end = "\n" if written.endswith("\n") else ""
    return (anchor[0] if anchor else "") + f"'{MASK}'{line_end}"


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
