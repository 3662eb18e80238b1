"""Configuration: YAML files become frozen dataclasses; all errors are reported at once.

A configuration class is a frozen dataclass whose fields are declared with ``core.options.option``.
It may define ``check(self)`` that yields problems of the values in combination: a sentence, or
``(key, sentence)`` to name the line of that key, or these and a hint. A type with a ``from_text``
class method (such as ``Expression``) is built from the text as written.

``check`` needs all values. Those that could not be read are replaced by plausible values, one set
after the other; only problems found with every set are certain, and are reported.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin

from amberbox.core.errors import (
    AmberboxError,
    ConfigurationError,
    Problem,
    did_you_mean,
    nearest_word,
)
from amberbox.core.units import in_unit, known_units
from amberbox.core.yaml_nodes import Node, scalar

_known: dict[type[Any], Mapping[str, Any]] = {}


def field_types(cls: type[Any]) -> Mapping[str, Any]:
    """Return the types of a dataclass' fields by name."""
    found = _known.get(cls)
    if found is None:
        found = _known[cls] = typing.get_type_hints(cls)
    return found


# sentence; or key and sentence; or these and a hint
Finding: TypeAlias = "str | tuple[str, str] | tuple[str, str, str]"

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


def check_findings(built: Any) -> Iterator[Finding]:
    """Run the check of an instance, if its class has one."""
    yield from getattr(built, "check", tuple)()


def certain_findings(
    cls: type[Any], values: Mapping[str, Any], unread: Mapping[str, Sequence[Any]]
) -> list[Finding]:
    """Return the problems of ``values`` that remain for every stand-in of an ``unread`` field."""
    count = max(map(len, unread.values()), default=1)
    sets = [{name: some[n % len(some)] for name, some in unread.items()} for n in range(count)]
    first, *others = [_found(cls, {**values, **some}) for some in sets]
    return [f for f in first if _key(f) not in unread and all(f in found for found in others)]


def _key(finding: Finding) -> str:
    return "" if isinstance(finding, str) else finding[0]


def _found(cls: type[Any], values: Mapping[str, Any]) -> list[Finding]:
    """Return the findings up to the first exception that a stand-in causes."""
    found: list[Finding] = []
    try:
        for finding in check_findings(cls(**values)):
            found.append(finding)  # what came before an exception counts
    except Exception:  # a stand-in may be of any wrong kind
        return found
    return found


def stand_ins(field: dataclasses.Field[Any], kind: Any) -> tuple[Any, ...]:
    """Return values that a field might have had: its default, and others of its type."""
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


T = TypeVar("T")
# Returns a note for a known but unneeded key of older files, by its path
# (``ros.topics.metadata``), or None.
Legacy = Callable[[str], "str | None"]

# single keys that the paper's format wraps around entries of a list
WRAPPERS = frozenset(
    {"topic", "element", "listener", "interface_specification", "mapping", "output"}
)

_FAILED: Any = Unread()
_PERCENT = re.compile(r"(\d+\.?\d*|\.\d+)\s*%")
_YES_NO = {"yes": True, "on": True, "true": True, "no": False, "off": False, "false": False}


def build(
    cls: type[T],
    node: Node,
    problems: list[Problem],
    where: str = "",
    legacy: Legacy = lambda path: None,
) -> T | None:
    """Make an instance of a configuration class from a mapping.

    Everything wrong is added to ``problems``; the result is None if anything was. Keys known to
    ``legacy`` become notes.
    """
    built = _dataclass(_Context(problems, legacy), cls, node, where)
    return None if _failed(built) else typing.cast(T, built)


def raise_errors(problems: Sequence[Problem]) -> None:
    """Raise ConfigurationError if any of the problems is an error."""
    if any(problem.is_error for problem in problems):
        raise ConfigurationError(problems)


def field_keys(field: dataclasses.Field[Any]) -> tuple[str, ...]:
    """Return the spellings of a key: its name, then its aliases."""
    return (field.name, *field.metadata.get("aliases", ()))


def _failed(value: Any) -> bool:
    return isinstance(value, Unread)


@dataclass(frozen=True)
class _Context:
    """The state that is passed down the tree while it is read."""

    problems: list[Problem]
    legacy: Legacy

    def fail(self, node: Node, where: str, what: str, hint: str = "") -> Any:
        """Report an error and return the marker of failure."""
        self.problems.append(node.problem(where or "file", what, hint))
        return _FAILED


@dataclass(frozen=True)
class _Marks:
    """The metadata of ``option`` that reading a value needs."""

    unit: str = ""
    secret: bool = False
    doc: str = ""
    expected: str = ""
    """The value that a union expects as a whole, while its members are tried."""

    def show(self, node: Node) -> str:
        """Return a wrong value as text for a message; secrets are masked."""
        is_word = node.mapping is None and node.items is None and node.value is not None
        return f"{node.kind} '{node.text}'" if is_word and not self.secret else node.kind


def _dataclass(ctx: _Context, cls: type[Any], node: Node, where: str) -> Any:
    entries = {} if node.value is None else node.mapping
    if entries is None:
        return ctx.fail(node, where, f"expected a mapping (key: value), got {node.kind}")
    fields = [field for field in dataclasses.fields(cls) if field.init]
    kinds = field_types(cls)
    known = [key for field in fields for key in field_keys(field)]
    unknown = [k for k, value in entries.items() if not _known_key(ctx, k, value, known, where)]
    values: dict[str, Any] = {}
    for field in fields:
        value = _field(ctx, field, kinds[field.name], (node, entries), where)
        values |= {} if value is dataclasses.MISSING else {field.name: value}
    if not unknown and not any(map(_failed, values.values())):
        # Make the instance and run the class's own check on the values together.
        try:
            built = cls(**values)
        except AmberboxError as error:
            return ctx.fail(node, where, error.what, error.hint)
        except ValueError as error:
            return ctx.fail(node, where, str(error))
        found = list(check_findings(built))
        _report(ctx, found, node, where)
        return built if not found else _FAILED
    misspelt = {nearest_word(key, known) for key in unknown}
    # Judge what could be read; a value under a misspelt key is there, but not known.
    read = {name: value for name, value in values.items() if not _failed(value)}
    read |= {name: v.good for name, v in values.items() if _failed(v) and v.good}
    unread = {
        field.name: stand_ins(field, kinds[field.name])
        for field in dataclasses.fields(cls)
        if field.name not in read
        and (field.name in values or not {*field_keys(field)}.isdisjoint(misspelt))
    }
    _report(ctx, certain_findings(cls, read, unread), node, where)
    return _FAILED


def _known_key(ctx: _Context, key: str, value: Node, known: Sequence[str], where: str) -> bool:
    if key in known:
        return True
    path = _join(where, key)
    note = ctx.legacy(".".join(part.split("[")[0] for part in path.split(".")))
    if note is not None:
        ctx.problems.append(value.problem(path, note, is_error=False))
        return True
    what = f"unknown key '{key}'{did_you_mean(key, known)}"
    ctx.fail(value, where, what, _unknown_key_hint(key, value, known))
    return False


def _unknown_key_hint(key: str, value: Node, known: Sequence[str]) -> str:
    if key in WRAPPERS and value.value is None:
        return f"indent the lines that belong to '{key}:' further"
    if did_you_mean(key, known):
        return ""
    return f"known keys: {', '.join(known)}" if known else "no keys are known here"


def _field(
    ctx: _Context,
    field: dataclasses.Field[Any],
    kind: Any,
    parent: tuple[Node, Mapping[str, Node]],
    where: str,
) -> Any:
    node, entries = parent
    given = [key for key in field_keys(field) if key in entries]
    meta = field.metadata
    marks = _Marks(meta.get("unit", ""), meta.get("secret", False), meta.get("doc", ""))
    if len(given) > 1:
        what = f"'{given[0]}' and '{given[1]}' are the same key; give one"
        return ctx.fail(entries[given[1]], where, what)
    if given:
        return _value(ctx, kind, entries[given[0]], _join(where, given[0]), marks)
    has_default = (field.default, field.default_factory) != (dataclasses.MISSING,) * 2
    if has_default:
        return dataclasses.MISSING
    doc = field.metadata.get("doc", "")
    return ctx.fail(node, where, f"the key '{field.name}' is missing", doc)


def _report(ctx: _Context, found: Sequence[Finding], node: Node, where: str) -> None:
    for finding in found:
        key, what, *hint = ("", finding) if isinstance(finding, str) else finding
        place = (node.mapping or {}).get(key, node)
        ctx.fail(place, _join(where, key) if key else where, what, *hint)


def _value(ctx: _Context, kind: Any, node: Node, where: str, marks: _Marks) -> Any:
    origin = get_origin(kind) or kind
    if kind is Any:
        return node.plain()
    if origin in (Union, types.UnionType):
        return _union(ctx, kind, node, where, marks)
    if origin is Literal:
        return _literal(ctx, get_args(kind), node, where, marks)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type) and not _has_text_form(kind):
        return _dataclass(ctx, kind, node, where)
    if origin in (Sequence, tuple, list):
        return _sequence(ctx, (*get_args(kind), Any)[0], node, where, marks)
    if origin in (Mapping, dict):
        return _mapping(ctx, (*get_args(kind), Any, Any)[1], node, where, marks)
    what = f"expected {marks.expected or type_text(kind)}, got {marks.show(node)}"
    if node.mapping is not None or node.items is not None or node.value is None:
        return ctx.fail(node, where, what, marks.doc)
    try:
        return _from_scalar(kind, node, marks.unit)
    except AmberboxError as error:
        return ctx.fail(node, where, error.what, error.hint)
    except ValueError as error:
        return ctx.fail(node, where, what + _reason(error, kind, node, marks), marks.doc)


def _union(ctx: _Context, kind: Any, node: Node, where: str, marks: _Marks) -> Any:
    """Convert to the first member that fits: one of exactly this type before one that converts.

    If none fits, report the problem for the member of the same shape: mapping, list or scalar.
    """
    members = [member for member in get_args(kind) if member is not types.NoneType]
    if node.value is None and len(members) < len(get_args(kind)):
        return None
    if len(members) == 1:
        return _value(ctx, members[0], node, where, marks)
    names = " or ".join(type_text(member) for member in members)
    same_shape: list[list[Problem]] = []
    for member in sorted(members, key=lambda member: not _is_exactly(member, node)):
        attempt = _Context([], ctx.legacy)
        is_word = _shape(member) is str
        value = _value(
            attempt, member, node, where, replace(marks, expected=names) if is_word else marks
        )
        if not _failed(value):
            ctx.problems.extend(attempt.problems)
            return value
        if _shape(member) is _shape_of(node):
            same_shape.append(attempt.problems)
    if not same_shape:
        return ctx.fail(node, where, f"expected {names}, got {marks.show(node)}", marks.doc)
    ctx.problems.extend(
        max(same_shape, key=lambda found: max((len(p.what) for p in found), default=0))
    )
    return _FAILED


def _shape(kind: Any) -> type:
    """Return the shape in YAML that values of a type have: ``dict``, ``tuple`` or ``str``."""
    origin = get_origin(kind) or kind
    if origin in (Mapping, dict) or (dataclasses.is_dataclass(kind) and not _has_text_form(kind)):
        return dict
    return tuple if origin in (Sequence, tuple, list) else str


def _shape_of(node: Node) -> type | None:
    if node.value is None:
        return None
    return type(node.value) if isinstance(node.value, dict | tuple) else str


def _is_exactly(kind: Any, node: Node) -> bool:
    origin = get_origin(kind) or kind
    return type(node.value) is origin or _shape(kind) is _shape_of(node) is not str


def _literal(ctx: _Context, choices: tuple[Any, ...], node: Node, where: str, m: _Marks) -> Any:
    for choice in choices:
        same = type(node.value) is type(choice) and node.value == choice
        if same or (isinstance(choice, str) and node.text == choice):
            return choice
    names = [str(choice) for choice in choices]
    suggestion = did_you_mean(node.text, names)
    expected = m.expected or f"one of {', '.join(names)}"
    return ctx.fail(node, where, f"expected {expected}, got {m.show(node)}{suggestion}", m.doc)


def _sequence(ctx: _Context, kind: Any, node: Node, where: str, marks: _Marks) -> Any:
    if node.items is None:
        hint = f"write it as a list: [{node.text}]" if node.text and not marks.secret else marks.doc
        return ctx.fail(node, where, f"expected a list, got {marks.show(node)}", hint)
    values = tuple(
        _value(ctx, kind, _unwrapped(entry, kind), f"{where}[{index}]", marks)
        for index, entry in enumerate(node.items)
    )
    good = tuple(value for value in values if not _failed(value))
    return values if len(good) == len(values) else Unread(good)


def _unwrapped(node: Node, kind: Any) -> Node:
    """Take ``{...}`` out of ``topic: {...}`` where the entries are mappings."""
    entries = node.mapping or {}
    if len(entries) != 1 or not dataclasses.is_dataclass(kind):
        return node
    key, inner = next(iter(entries.items()))
    return inner if key in WRAPPERS and inner.mapping is not None else node


def _mapping(ctx: _Context, kind: Any, node: Node, where: str, marks: _Marks) -> Any:
    if node.mapping is None:
        what = f"expected a mapping (key: value), got {marks.show(node)}"
        return ctx.fail(node, where, what, marks.doc)
    values = {
        key: _value(ctx, kind, value, _join(where, key), marks)
        for key, value in node.mapping.items()
    }
    return _FAILED if any(map(_failed, values.values())) else values


def _reason(error: ValueError, kind: Any, node: Node, marks: _Marks) -> str:
    """Describe why a word is no value of a type, with the number that a percentage means."""
    is_plain = kind is float and not marks.unit and not marks.secret
    percent = _PERCENT.fullmatch(node.text) if is_plain else None
    if percent is not None:
        return f"; did you mean {float(percent[1]) / 100:g}?"
    return f", which {error}" if str(error) else ""


def _from_scalar(kind: Any, node: Node, unit: str) -> Any:
    """Convert one value; nothing is rounded or cut. Raises ValueError."""
    if _has_text_form(kind):
        return kind.from_text(node.text)
    if kind is str:
        return node.text
    if kind is Path:
        return Path(node.text)
    if kind is bool:
        value = node.value if isinstance(node.value, bool) else _YES_NO.get(node.text.lower())
        if value is None:
            raise ValueError
        return value
    if kind in (int, float):
        return _to_number(kind, node, unit)
    raise TypeError(f"configuration classes cannot hold {kind}")


def _to_number(kind: type[int] | type[float], node: Node, unit: str) -> int | float:
    value = node.value
    if isinstance(value, str):
        value = scalar(value)
    if isinstance(value, str) and known_units(unit) and value[:1] in "+-.0123456789":
        exact = in_unit(value, unit)
        value = int(exact) if exact.denominator == 1 else float(exact)
    if isinstance(value, str) and value.lstrip("+-").isdigit():
        raise ValueError("some programs read as octal: write it without leading zeros")
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError
    return _lossless(kind, value)


def _lossless(kind: type[int] | type[float], value: int | float) -> int | float:
    if isinstance(value, float) and math.isnan(value):
        raise ValueError("is not a number")
    if kind is int and math.isinf(value):
        raise ValueError("is not finite")
    if kind is int and value != value // 1:
        raise ValueError("is not whole")
    try:
        converted = kind(value)
    except OverflowError:
        raise ValueError("is too large") from None
    if converted != value:
        raise ValueError("has too many digits")
    return converted


def type_text(kind: Any) -> str:
    """Return the name of a type for messages: ``text``, ``a number``, ``a list of text``."""
    names = {str: "text", int: "a whole number", float: "a number", bool: "yes or no"}
    names |= {Path: "a path", Any: "anything", types.NoneType: "nothing"}
    if kind in names:
        return names[kind]
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(str(choice) for choice in args)
    if origin in (Union, types.UnionType):
        return " or ".join(type_text(member) for member in args if member is not types.NoneType)
    if origin in (Sequence, tuple, list):
        return f"a list of {type_text(args[0]).removeprefix('a ')}"
    if origin in (Mapping, dict):
        return f"a mapping to {type_text(args[1])}"
    return "a mapping" if not _has_text_form(kind) else f"an {kind.__name__}".lower()


def _has_text_form(kind: Any) -> bool:
    return callable(getattr(kind, "from_text", None))


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key
