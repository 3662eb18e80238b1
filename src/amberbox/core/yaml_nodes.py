"""YAML files as trees that remember the line of every value, for messages that name it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import yaml

from amberbox.core.errors import Problem

Scalar: TypeAlias = str | int | float | bool | None

_FENCE: ContextVar[Path | None] = ContextVar("fence", default=None)
_OURS = Path(__file__).resolve().parents[1]

_MOST_NODES = 200_000  # aliases can multiply a small file without end
_DEEPEST = 60
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_BEFORE = re.compile(r"(?:^|[\[{,\n]|:\s)\s*")
_AFTER = re.compile(r"(?:\[[^\[\]\n]*\]|(?!:\s)[^,\[\]{}\n])*")
_CONSTANTS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **{".inf": float("inf"), "-.inf": float("-inf"), ".nan": float("nan")},
}


@dataclass(frozen=True, slots=True)
class Node:
    """A value in a file: a scalar, a tuple of nodes, or a dict of nodes.

    ``line`` is the line of the key for values of a mapping. ``text`` is a scalar as written,
    without its quotes; ``span`` the characters it takes in the file.
    """

    file: str
    line: int
    value: Scalar | tuple[Node, ...] | dict[str, Node]
    text: str = ""
    span: tuple[int, int] = (0, 0)

    @property
    def mapping(self) -> dict[str, Node] | None:
        """Return the values by key, or None if this is no mapping."""
        return self.value if isinstance(self.value, dict) else None

    @property
    def items(self) -> tuple[Node, ...] | None:
        """Return the entries, or None if this is no list."""
        return self.value if isinstance(self.value, tuple) else None

    @property
    def kind(self) -> str:
        """Return the kind of value, for messages."""
        names = {dict: "a mapping", tuple: "a list", str: "text", bool: "yes/no"}
        return "nothing" if self.value is None else names.get(type(self.value), "a number")

    def problem(self, where: str, what: str, hint: str = "", *, is_error: bool = True) -> Problem:
        """Return a problem at this place in the file."""
        return Problem(self.file, self.line, where, what, hint, is_error)

    def plain(self) -> object:
        """Return the value as plain Python: dict, list, scalar."""
        if isinstance(self.value, dict):
            return {key: node.plain() for key, node in self.value.items()}
        if isinstance(self.value, tuple):
            return [node.plain() for node in self.value]
        return self.value


@contextmanager
def only_below(folder: Path) -> Iterator[None]:
    """Allow reading only YAML files inside a folder and our own, whatever these files refer to.

    Used for folders of other machines: files outside are reported as unreadable.
    """
    token = _FENCE.set(folder.resolve())
    try:
        yield
    finally:
        _FENCE.reset(token)


def load_yaml(path: Path, problems: list[Problem], name: str = "") -> Node | None:
    """Read a YAML file; add its errors to ``problems``.

    ``name`` is the file's name in messages. Returns None if the file cannot be read at all.
    """
    name = name or str(path)
    fence = _FENCE.get()
    if fence is not None and not any(map(path.resolve().is_relative_to, (fence, _OURS))):
        problems.append(Problem(name, 1, "file", "lies outside of the folder, and is not read"))
        return None
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        problems.append(Problem(name, 1, "file", f"cannot be read: {error.strerror}"))
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        problems.append(Problem(name, line, "file", "is not UTF-8 text", "save it as UTF-8"))
    else:
        return parse_yaml(text, name, problems)
    return None


def parse_yaml(text: str, file: str, problems: list[Problem]) -> Node | None:
    """Turn YAML text into a tree; None and a problem if its syntax is wrong."""
    try:
        root = _compose(text)
    except yaml.MarkedYAMLError as error:
        problems.append(_syntax_problem(error, file, text))
    except yaml.reader.ReaderError as error:
        line = text[: error.position].count("\n") + 1
        what = f"the character {error.character!r} is not allowed in YAML"
        problems.append(Problem(file, line, "syntax", what))
    except RecursionError:
        problems.append(Problem(file, 1, "syntax", "is nested too deeply"))
    else:
        if root is None:
            return Node(file, 1, None)
        try:
            return _Reader(file, problems).node(root, 0)
        except _TooLargeError:
            problems.append(Problem(file, 1, "syntax", "is too large", "do its aliases multiply?"))
            return None
    return None


def _compose(text: str) -> yaml.Node | None:
    """Parse with libyaml, ten times as fast, where it gives the same: no error, one byte a sign."""
    fast = getattr(yaml, "CBaseLoader", None)
    if fast is not None and text.isascii():
        with suppress(yaml.YAMLError):  # the pure Python parser has clearer error messages
            quick: yaml.Node | None = yaml.compose(text, Loader=fast)
            return quick
    root: yaml.Node | None = yaml.compose(text, Loader=yaml.BaseLoader)
    return root


def _syntax_problem(error: yaml.MarkedYAMLError, file: str, text: str) -> Problem:
    mark = error.problem_mark or error.context_mark
    what = " ".join(part for part in (error.context, error.problem) if part)
    hint = ""
    if "'\\t'" in what:
        hint = "indent with blanks, not with tabs"
    elif "but got '['" in what and mark is not None:
        hint = f"quote a name that has brackets: {_bracketed(text, mark.index)}"
    elif "mapping values are not allowed" in what:
        hint = "look at the indentation here, or quote a text that contains ': '"
    return Problem(file, mark.line + 1 if mark else 1, "syntax", what, hint)


def _bracketed(text: str, at: int) -> str:
    """Return the text around a bracket that YAML took for a list, in quotes."""
    before, after = _BEFORE.split(text[:at])[-1], _AFTER.match(text, at)
    return f'"{before}{after[0].rstrip() if after else "["}"'


class _TooLargeError(Exception):
    """The tree has more nodes than any configuration written by a person."""


@dataclass
class _Reader:
    """Turns PyYAML's nodes into ours and counts them."""

    file: str
    problems: list[Problem]
    count: int = 0
    open: list[yaml.Node] = field(default_factory=list)

    def node(self, raw: yaml.Node, depth: int) -> Node:
        """Convert one node and all below it."""
        line, span = raw.start_mark.line + 1, (raw.start_mark.index, raw.end_mark.index)
        refusal = self._refusal(raw, depth)
        if refusal:
            self.problems.append(Problem(self.file, line, "syntax", refusal))
            return Node(self.file, line, None, "", span)
        self.open.append(raw)
        try:
            if isinstance(raw, yaml.ScalarNode):
                value = scalar(raw.value) if not raw.style else raw.value
                return Node(self.file, line, value, raw.value, span)
            if isinstance(raw, yaml.MappingNode):
                return Node(self.file, line, self._mapping(raw, depth), "", span)
            entries = tuple(self.node(entry, depth + 1) for entry in raw.value)
            return Node(self.file, line, entries, "", span)
        finally:
            self.open.pop()

    def _refusal(self, raw: yaml.Node, depth: int) -> str:
        self.count += 1
        if self.count > _MOST_NODES:
            raise _TooLargeError
        if any(raw is node for node in self.open):
            return "an alias contains itself"
        if depth > _DEEPEST:
            return "is nested too deeply"
        known = raw.tag.startswith("tag:yaml.org,2002:") and raw.tag[18:] in ("str", "seq", "map")
        return "" if known else f"tags such as {raw.tag} are not supported"

    def _mapping(self, raw: yaml.MappingNode, depth: int) -> dict[str, Node]:
        entries: dict[str, Node] = {}
        merged: dict[str, Node] = {}
        for key, value in raw.value:
            line = key.start_mark.line + 1
            if not isinstance(key, yaml.ScalarNode):
                what = "a key must be a word"
                self.problems.append(Problem(self.file, line, "syntax", what))
            elif key.value == "<<" and not key.style:
                merged = dict(_merged(self.node(value, depth + 1))) | merged
            elif key.value in entries:
                what = f"the key is given twice, first in line {entries[key.value].line}"
                self.problems.append(Problem(self.file, line, key.value, what))
            else:
                entries[key.value] = replace(self.node(value, depth + 1), line=line)
        return merged | entries


def _merged(node: Node) -> Iterator[tuple[str, Node]]:
    """Yield the keys merged by ``<<: *base`` or ``<<: [*a, *b]``; of several the first one
    counts.
    """
    for part in reversed(node.items or (node,)):
        yield from (part.mapping or {}).items()


def scalar(text: str) -> Scalar:
    """Read an unquoted word by YAML 1.2: ``no`` is a word, ``010`` and ``12:30`` are text."""
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if _INTEGER.fullmatch(text):
        return int(text) if len(text) < 100 else text
    if re.fullmatch(r"0x[0-9a-fA-F]+|0o[0-7]+", text):
        return int(text, 0) if len(text) < 100 else text
    return float(text) if _FLOAT.fullmatch(text) and not _leading_zero(text) else text


def _leading_zero(text: str) -> bool:
    """Return whether a number might be octal: ``010`` is 8 for some readers and 10 for others."""
    return re.fullmatch(r"[-+]?0[0-9]+", text) is not None
