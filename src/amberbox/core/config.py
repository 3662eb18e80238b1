"""Configuration: YAML files become frozen dataclasses, and all that is wrong is said at once.

A configuration class is a frozen dataclass whose fields are declared with
``core.options.option``. It may define ``check(self)`` that yields what is wrong with the values
together: a sentence, or ``(key, sentence)`` to name the line of that key, or these and a hint. A
type with a ``from_text`` class method (such as ``Expression``) is built from the text as written.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from amberbox.core.errors import AmberboxError, ConfigurationError, Problem
from amberbox.core.fieldtypes import field_types
from amberbox.core.nodes import Node, load_yaml, parse_yaml, scalar
from amberbox.core.standins import Finding, Unread, certain_findings, findings, stand_ins
from amberbox.core.units import in_unit, known_units

__all__ = ["Node", "build", "did_you_mean", "field_keys", "load_yaml", "parse_yaml", "refuse"]

T = TypeVar("T")
Legacy = Callable[[str], "str | None"]
"""Answers with a note for a key that older files have and we do not need, by its path
(``ros.topics.metadata``), or None if it does not know the key."""

WRAPPERS = frozenset(
    {"topic", "element", "listener", "interface_specification", "mapping", "output"}
)
"""Single keys that the paper's format wraps around the entries of a list."""

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


def refuse(problems: Sequence[Problem]) -> None:
    """Raise ConfigurationError if there is an error among the problems."""
    if any(problem.is_error for problem in problems):
        raise ConfigurationError(problems)


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return ``; did you mean 'x'?`` for the nearest other word that is known, or nothing."""
    near = _nearest(word, known)
    return f"; did you mean '{near}'?" if near is not None else ""


def _nearest(word: str, known: Collection[str]) -> str | None:
    lower = {name.lower(): name for name in known if name != word}
    near = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.6)
    return lower[near[0]] if near else None


def field_keys(field: dataclasses.Field[Any]) -> tuple[str, ...]:
    """Return the spellings of a key: its name, then its aliases."""
    return (field.name, *field.metadata.get("aliases", ()))


def _failed(value: Any) -> bool:
    return isinstance(value, Unread)


@dataclass(frozen=True)
class _Context:
    """What goes along down the tree."""

    problems: list[Problem]
    legacy: Legacy

    def fail(self, node: Node, where: str, what: str, hint: str = "") -> Any:
        """Note an error and return the mark of failure."""
        self.problems.append(node.problem(where or "file", what, hint))
        return _FAILED


@dataclass(frozen=True)
class _Marks:
    """What ``option`` says about a value, as far as reading it needs to know."""

    unit: str = ""
    secret: bool = False
    doc: str = ""
    expected: str = ""
    """What a union expects as a whole, while its members are tried."""

    def show(self, node: Node) -> str:
        """Describe a wrong value without giving a secret away."""
        is_word = node.mapping is None and node.items is None and node.value is not None
        return f"{node.kind} '{node.text}'" if is_word and not self.secret else node.kind


def _dataclass(ctx: _Context, cls: type[Any], node: Node, where: str) -> Any:
    entries = {} if node.value is None else node.mapping
    if entries is None:
        return ctx.fail(node, where, f"expected a mapping (key: value), got {node.kind}")
    fields = [field for field in dataclasses.fields(cls) if field.init]
    kinds = field_types(cls)
    known = [key for field in fields for key in field_keys(field)]
    unknown = _unknown_keys(ctx, known, entries, where)
    values: dict[str, Any] = {}
    for field in fields:
        value = _field(ctx, field, kinds[field.name], (node, entries), where)
        values |= {} if value is dataclasses.MISSING else {field.name: value}
    if not unknown and not any(map(_failed, values.values())):
        return _instance(ctx, cls, values, node, where)
    misspelt = {_nearest(key, known) for key in unknown}
    _tell(ctx, _certain(cls, values, kinds, misspelt), node, where)
    return _FAILED


def _certain(
    cls: type[Any],
    values: Mapping[str, Any],
    kinds: Mapping[str, Any],
    misspelt: Collection[str | None],
) -> Sequence[Finding]:
    """Judge what could be read; a value under a misspelt key is there, but not known."""
    read = {name: value for name, value in values.items() if not _failed(value)}
    read |= {name: v.good for name, v in values.items() if _failed(v) and v.good}
    unread = {
        field.name: stand_ins(field, kinds[field.name])
        for field in dataclasses.fields(cls)
        if field.name not in read
        and (field.name in values or not {*field_keys(field)}.isdisjoint(misspelt))
    }
    return certain_findings(cls, read, unread)


def _unknown_keys(
    ctx: _Context, known: Sequence[str], entries: Mapping[str, Node], where: str
) -> list[str]:
    """Return the keys that nobody knows, each of which is an error."""
    return [k for k, value in entries.items() if not _known_key(ctx, k, value, known, where)]


def _known_key(ctx: _Context, key: str, value: Node, known: Sequence[str], where: str) -> bool:
    if key in known:
        return True
    path = _join(where, key)
    note = ctx.legacy(_without_indices(path))
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


def _instance(ctx: _Context, cls: type[Any], values: dict[str, Any], node: Node, where: str) -> Any:
    """Make the instance and run the class's own check on the values together."""
    try:
        built = cls(**values)
    except AmberboxError as error:
        return ctx.fail(node, where, error.what, error.hint)
    except ValueError as error:
        return ctx.fail(node, where, str(error))
    found = list(findings(built))
    _tell(ctx, found, node, where)
    return built if not found else _FAILED


def _tell(ctx: _Context, found: Sequence[Finding], node: Node, where: str) -> None:
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
    return _scalar(ctx, kind, node, where, marks)


def _union(ctx: _Context, kind: Any, node: Node, where: str, marks: _Marks) -> Any:
    """Take the first member that fits: one of exactly this type before one that converts.

    Where none fits, report what is wrong for the member of the same shape: mapping, list or word.
    """
    members = [member for member in get_args(kind) if member is not types.NoneType]
    if node.value is None and len(members) < len(get_args(kind)):
        return None
    if len(members) == 1:
        return _value(ctx, members[0], node, where, marks)
    names = " or ".join(type_text(member) for member in members)
    alike: list[list[Problem]] = []
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
            alike.append(attempt.problems)
    if not alike:
        return ctx.fail(node, where, f"expected {names}, got {marks.show(node)}", marks.doc)
    ctx.problems.extend(max(alike, key=_said))
    return _FAILED


def _said(problems: Iterable[Problem]) -> int:
    """Return how much problems say, to choose the reading that explains most."""
    return max((len(problem.what) for problem in problems), default=0)


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


def _scalar(ctx: _Context, kind: Any, node: Node, where: str, marks: _Marks) -> Any:
    what = f"expected {marks.expected or type_text(kind)}, got {marks.show(node)}"
    if node.mapping is not None or node.items is not None or node.value is None:
        return ctx.fail(node, where, what, marks.doc)
    try:
        return _from_scalar(kind, node, marks.unit)
    except AmberboxError as error:
        return ctx.fail(node, where, error.what, error.hint)
    except ValueError as error:
        return ctx.fail(node, where, what + _reason(error, kind, node, marks), marks.doc)


def _reason(error: ValueError, kind: Any, node: Node, marks: _Marks) -> str:
    """Say why a word is no value of a type; of a share in percent, which number it is."""
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
        return _to_bool(node)
    if kind in (int, float):
        return _to_number(kind, node, unit)
    raise TypeError(f"configuration classes cannot hold {kind}")


def _to_bool(node: Node) -> bool:
    value = node.value if isinstance(node.value, bool) else _YES_NO.get(node.text.lower())
    if value is None:
        raise ValueError
    return value


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
    """Name a type for people: ``text``, ``a number``, ``a list of text``."""
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


def _without_indices(path: str) -> str:
    return ".".join(part.split("[")[0] for part in path.split("."))
