"""Options of a configuration class: their declaration, and the table of all of them.

An option is a default, one line of documentation and marks (unit, secret, aliases). Listings and
the checks of the documentation read the table.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Union, get_args, get_origin

from amberbox.core.config import field_types, type_text

_REQUIRED: Any = object()


def option(
    default: Any = _REQUIRED,
    doc: str = "",
    *,
    unit: str = "",
    secret: bool = False,
    aliases: Sequence[str] = (),
) -> Any:
    """Declare one key of a configuration class.

    Without ``default`` the key is required. ``secret`` values never leave the robot folder.
    ``aliases`` are other spellings that are accepted, such as the paper's.
    """
    metadata = {"doc": doc, "unit": unit, "secret": secret, "aliases": tuple(aliases)}
    if default is _REQUIRED:
        return dataclasses.field(metadata=metadata)
    if isinstance(default, dict | list):
        kind = type(default)
        return dataclasses.field(default_factory=lambda: kind(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True)
class OptionRow:
    """One key; ``default`` is text as one would write it, None if the key is required."""

    key: str
    type: str
    default: str | None
    unit: str
    doc: str
    secret: bool
    aliases: tuple[str, ...]


def describe(cls: type[Any], prefix: str = "") -> Iterator[OptionRow]:
    """Yield every key, keys of nested classes as ``topics[].name``."""
    kinds = field_types(cls)
    for field in dataclasses.fields(cls):
        kind = kinds[field.name]
        inner, step = _nested(kind)
        yield OptionRow(
            prefix + field.name,
            _type_name(kind, inner, step),
            _default(field, inner),
            field.metadata.get("unit", ""),
            field.metadata.get("doc", ""),
            field.metadata.get("secret", False),
            tuple(field.metadata.get("aliases", ())),
        )
        if inner is not None:
            yield from describe(inner, f"{prefix}{field.name}{step}.")


def _nested(kind: Any) -> tuple[type[Any] | None, str]:
    """Find the configuration class inside a type, and how its keys are reached."""
    origin, args = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return (None if hasattr(kind, "from_text") else kind), ""
    if origin in (Union, types.UnionType):
        found = [_nested(member) for member in args]
        return next((hit for hit in found if hit[0] is not None), (None, ""))
    if origin in (Sequence, tuple, list):
        inner, step = _nested(args[0])
        return inner, f"[]{step}"
    if origin in (Mapping, dict):
        inner, step = _nested(args[1])
        return inner, f".NAME{step}"
    return None, ""


def _type_name(kind: Any, inner: type[Any] | None, step: str) -> str:
    if inner is None:
        return type_text(kind)
    return "a list of mappings" if step.startswith("[]") else "a mapping"


def _default(field: dataclasses.Field[Any], inner: type[Any] | None) -> str | None:
    if field.default_factory is not dataclasses.MISSING:
        return _text(field.default_factory())
    if field.default is dataclasses.MISSING:
        return None
    return "" if inner is not None else _text(field.default)


def _text(value: Any) -> str:
    if value is None or value == "" or value == () or value == {}:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:g}" if isinstance(value, float) else str(value)
