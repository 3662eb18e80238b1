"""What is wrong with the values that could be read, whatever the others turn out to be.

The check of a configuration class needs all values. For those that could not be read, values
that they might have had stand in, one set after the other: what is found with each of them is
wrong in any case, and is said together with the rest.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, Union, get_args, get_origin

Finding: TypeAlias = "str | tuple[str, str] | tuple[str, str, str]"
"""A sentence, or the key that it is about and the sentence, and a hint where there is one."""

_BY_TYPE: Mapping[Any, tuple[Any, ...]] = {
    str: ("", "x"),
    int: (0, 1, -(10**18), 10**18),
    float: (0.0, 1.0, -math.inf, math.inf),
    bool: (False, True),
    types.NoneType: (None,),
}


@dataclass(frozen=True)
class Unread:
    """In place of a value that could not be read; ``good`` are the entries of a list that could."""

    good: tuple[Any, ...] = ()


def findings(built: Any) -> Iterator[Finding]:
    """Run the check of an instance, if its class has one."""
    yield from getattr(built, "check", tuple)()


def certain_findings(
    cls: type[Any], values: Mapping[str, Any], unread: Mapping[str, Sequence[Any]]
) -> list[Finding]:
    """Return what is wrong with ``values`` under all stand-ins that ``unread`` names by field."""
    count = max(map(len, unread.values()), default=1)
    sets = [{name: some[n % len(some)] for name, some in unread.items()} for n in range(count)]
    first, *others = [_found(cls, {**values, **some}) for some in sets]
    return [f for f in first if _key(f) not in unread and all(f in found for found in others)]


def _key(finding: Finding) -> str:
    return "" if isinstance(finding, str) else finding[0]


def _found(cls: type[Any], values: Mapping[str, Any]) -> list[Finding]:
    """Collect findings up to where a stand-in does not go."""
    found: list[Finding] = []
    try:
        for finding in findings(cls(**values)):
            found.append(finding)  # what came before an exception counts
    except Exception:  # a stand-in may be of any wrong kind
        return found
    return found


def stand_ins(field: dataclasses.Field[Any], kind: Any) -> tuple[Any, ...]:
    """Give values that a field might have had: its default, and others of its type."""
    default = () if field.default is dataclasses.MISSING else (field.default,)
    return (*default, *_of_type(kind))


def _of_type(kind: Any) -> tuple[Any, ...]:
    origin = get_origin(kind) or kind
    if origin in (Union, types.UnionType):
        return tuple(value for member in get_args(kind) for value in _of_type(member))
    if origin is Literal:
        return get_args(kind)
    if origin in (Sequence, tuple, list):
        return ((), *((value,) for value in _of_type((*get_args(kind), Any)[0])))
    if origin in (Mapping, dict):
        return ({},)
    return _BY_TYPE.get(origin, (object(),))
