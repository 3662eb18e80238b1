"""Typed answers of a server. Times are RFC 3339 texts; ``time_ns`` converts them.

The types are those of ``core.api``, read so that client and server may differ in version: unknown
fields are ignored, missing ones are empty, and a new word of an enumeration is plain text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from types import GenericAlias, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin
from typing import get_type_hints as type_hints

import msgspec
import numpy as np

from amberbox.core import api
from amberbox.core.timestamps import format_time
from amberbox.core.types import IntArray, Missing

if TYPE_CHECKING:
    from amberbox.core.api import *  # noqa: F403 - old paths give every answer

_EMPTY: Mapping[Any, Any] = {str: "", bool: False, int: 0, float: 0.0, tuple: ()}


class Answer(msgspec.Struct, frozen=True, kw_only=True, rename=api.json_name):
    """The base of all answers; ``from_`` is ``from`` in JSON."""


@cache
def struct_of(kind: Any) -> Any:
    """Return a frozen msgspec type with the fields and properties of a type of ``core.api``."""
    hints = type_hints(kind, include_extras=True)
    members = [(field.name, *_member(hints[field.name], field)) for field in fields(kind)]
    members.sort(key=len)  # required fields first, as Python requires
    properties = {name: one for name, one in vars(kind).items() if isinstance(one, property)}
    namespace = {"__doc__": kind.__doc__, **properties}
    return msgspec.defstruct(
        kind.__name__, members, bases=(Answer,), module=__name__, namespace=namespace, frozen=True
    )


def _member(hint: Any, field: Field[Any]) -> tuple[Any, ...]:
    """Return type and, if an answer may lack it, default of a field."""
    kind = _lenient(hint)
    missing = next((one for one in get_args(hint)[1:] if isinstance(one, Missing)), None)
    if field.default is not MISSING:
        return kind, field.default
    if missing is None and field.default_factory is MISSING:
        return (kind,)
    if get_origin(kind) is Mapping:
        return kind, msgspec.field(default_factory=dict)
    empty = _EMPTY.get(get_origin(kind) or kind)
    return kind, empty if missing is None or missing.default is None else missing.default


def _lenient(hint: Any) -> Any:
    """Return the type that also accepts values of another version of the server."""
    origin, inner = get_origin(hint), get_args(hint)
    if is_dataclass(hint):
        kind: Any = hint
        return struct_of(kind)
    if origin is Annotated:
        return _lenient(inner[0])
    if origin is Literal:
        return str
    if origin is Sequence:
        return GenericAlias(tuple, (_lenient(inner[0]), ...))
    if origin is Mapping:
        return GenericAlias(Mapping, tuple(map(_lenient, inner)))
    if origin in (Union, UnionType):
        return Union[tuple(map(_lenient, inner))]  # noqa: UP007 - of any number of types
    return hint


if not TYPE_CHECKING:
    kinds = [one for one in vars(api).values() if is_dataclass(one) and one is not Missing]
    globals().update({kind.__name__: struct_of(kind) for kind in kinds})

Time = int | str | None
"""Nanoseconds since the Unix epoch, or a text: RFC 3339, an epoch, ``now-10m``, ``-10m``."""


def time_ns(text: str) -> int:
    """Return a time that the server wrote, in nanoseconds since the Unix epoch."""
    return int(times_ns([text])[0])


def times_ns(texts: list[str]) -> IntArray:
    """Return times that the server wrote, in nanoseconds since the Unix epoch."""
    plain = np.array([text.removesuffix("Z") for text in texts], "datetime64[ns]")
    return plain.astype(np.int64)


def maybe_ns(text: str | None) -> int | None:
    """Return a time in nanoseconds since the Unix epoch; None for None."""
    return None if text is None else time_ns(text)


def time_text(moment: Time) -> str:
    """Return a time as a parameter of a request: empty for None, a text unchanged."""
    if moment is None:
        return ""
    return moment if isinstance(moment, str) else format_time(moment)
