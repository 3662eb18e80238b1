"""Take secrets out of the files of a robot folder, so that they may leave it.

YAML is read: values that a configuration class marks as secret, and values whose key sounds like
one, are masked. Comments go that stand beside a masked value, sound secret, or hold a secret. What
was found is then looked for in all files, with all that is a secret by its form.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import yaml

from amberbox.blackbox.folder.folder import BLACK_BOX_FILE, ROBOT_FILE, SOURCES
from amberbox.blackbox.folder.robot import RobotConfig
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.nodes import Node, parse_yaml
from amberbox.core.plugins import Plugin, find
from amberbox.core.redaction import (
    MASK,
    SOUNDS_SECRET,
    likely_secrets,
    redact,
    secrets,
    sounds_secret,
    word_with,
)
from amberbox.link.keys import LOOKS_LIKE_ONE

WORD = "(masked)"
"""Stands for a secret within a text, where it breaks no syntax."""

_YAML = frozenset({".yaml", ".yml"})
_LEAST = 6
"""Shorter secrets are not looked for in other places: they would be found in every number."""
_LEAST_IN_COMMENTS = 3
_USER = re.compile(r"((?<![a-zA-Z0-9+.-])[0-9+.-]*+[a-zA-Z][a-zA-Z0-9+.-]*+://)[^/\s@'\"<>]+@")
_QUERY = re.compile(
    rf"([?&]{word_with(f'(?:{SOUNDS_SECRET}|key|sig)')}=)[^&\s#'\"<>]+", re.IGNORECASE
)
_PEM = re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*-----|\Z)", re.DOTALL)
_SAID = re.compile(
    rf"(\b{word_with(SOUNDS_SECRET)}[\"']?\s*(?:[:=]|\bis\b)\s*)(\"[^\"]*\"|'[^']*'|[^\s\"'<>,;]+)",
    re.IGNORECASE,
)
_OPENING = re.compile(rf"<{word_with(SOUNDS_SECRET)}", re.IGNORECASE)


@dataclass
class _Found:
    """The secrets of a folder as they are found, and the files that are being masked."""

    secrets: set[str] = field(default_factory=set)
    texts: dict[str, str] = field(default_factory=dict)

    def note(self, node: Node) -> None:
        """Remember a masked value, wherever else it stands."""
        for inner in _leaves(node):
            self.secrets.add(inner.text.strip())


def masked(files: Mapping[str, bytes], known: Collection[str] = ()) -> dict[str, bytes]:
    """Return files of a folder without their secrets, by name; ``known`` are secrets, too.

    A file that cannot be read as what its name says is left out: nobody could tell what is in it.
    """
    found = _Found({secret for secret in known if secret})
    plugins = find(SOURCES, defines=("Config", "Source"))
    for name, data in files.items():
        text = _text(data)
        if text is None:
            continue
        found.secrets.update(_passwords(text))
        done = _yaml(name, text, plugins, found) if _is_yaml(name) else _plain(text)
        if done is not None:
            found.texts[name] = done
    cleared = {name: _cleared(name, text, found) for name, text in found.texts.items()}
    return {name: text.encode() for name, text in cleared.items() if text is not None}


def _cleared(name: str, text: str, found: _Found) -> str | None:
    """Take known secrets out of everything; None where a YAML file would not be one any more."""
    if _is_yaml(name):
        text = _without_comments(text, found.secrets)
    for secret in sorted(found.secrets, key=len, reverse=True):
        if len(secret) >= _LEAST:
            text = text.replace(secret, WORD)
    text = _by_form(text)
    return text if not _is_yaml(name) or _parsed(name, text) is not None else None


def _yaml(name: str, text: str, plugins: Mapping[str, Plugin], found: _Found) -> str | None:
    """Mask the values of a YAML file; None if it cannot be read."""
    root = _parsed(name, text)
    if root is None:
        return None
    nodes = list(_secret_nodes(name, root, plugins))
    for node in nodes:
        found.note(node)
    return redact(text, _outermost(nodes))


def _secret_nodes(name: str, root: Node, plugins: Mapping[str, Plugin]) -> Iterator[Node]:
    yield from likely_secrets(root)
    if name == ROBOT_FILE:
        yield from secrets(RobotConfig, root)
    elif name == BLACK_BOX_FILE:
        for entry in root.items or (root,):
            for plugin, node in (entry.mapping or {}).items():
                yield from _of_source(plugins.get(plugin), node)


def _of_source(plugin: Plugin | None, node: Node) -> Iterator[Node]:
    """Yield what a source's configuration marks; one that cannot be loaded marks nothing."""
    if plugin is None:
        return
    try:
        cls = plugin.load().Config
    except AmberboxError:
        return
    yield from secrets(cls, node)


def _outermost(nodes: Iterable[Node]) -> list[Node]:
    """Leave out what lies within others, which are replaced as a whole."""
    chosen: list[Node] = []
    for node in sorted(nodes, key=lambda n: (n.span[0], -n.span[1])):
        if not chosen or node.span[0] >= chosen[-1].span[1]:
            chosen.append(node)
    return chosen


def _without_comments(text: str, known: Collection[str]) -> str:
    """Take out comments beside masked values, and those that sound secret or hold a secret."""
    for start, end in reversed(list(_comments(text))):
        line = text[text.rfind("\n", 0, start) + 1 : start]
        said = text[start:end]
        holds = any(s in said for s in known if len(s) >= _LEAST_IN_COMMENTS)
        if MASK in line or holds or sounds_secret(said):
            before = text[:start].rstrip(" ") if line.strip() else f"{text[:start]}#"
            text = before + text[end:]
    return text


def _comments(text: str) -> Iterator[tuple[int, int]]:
    """Give where comments stand: from their # to the end of the line."""
    at = 0
    for token in yaml.scan(text, Loader=yaml.SafeLoader):
        yield from _in_gap(text, at, token.start_mark.index)
        at = max(at, token.end_mark.index)
    yield from _in_gap(text, at, len(text))


def _in_gap(text: str, start: int, end: int) -> Iterator[tuple[int, int]]:
    while (sign := text.find("#", start, end)) >= 0:
        stop = text.find("\n", sign)
        start = len(text) if stop < 0 else stop
        yield sign, start


def _plain(text: str) -> str:
    """Mask what a text says to be a secret: ``password: ...``, ``<token>...``."""
    return _SAID.sub(lambda match: match[1] + _quoted_as(match[2]), _elements(text))


def _elements(text: str) -> str:
    """Mask the text of XML elements whose name sounds secret; each sign is looked at once."""
    parts, at, closing = [], 0, -1
    for opening in _OPENING.finditer(text):
        if opening.start() < at or opening.end() <= closing:
            continue  # of several before one ">" the first one counts
        closing = text.find(">", opening.end())
        if closing < 0:
            break
        end = text.find("<", closing)
        if end > closing + 1 and text.startswith("</", end):
            parts += [text[at : closing + 1], WORD]
            at = end
    return "".join([*parts, text[at:]])


def _quoted_as(written: str) -> str:
    quote = written[0] if written[0] in "\"'" else ""
    return f"{quote}{WORD}{quote}"


def _by_form(text: str) -> str:
    """Mask what is a secret by its form: keys, users and passwords in addresses."""
    text = _PEM.sub(WORD, text)
    text = LOOKS_LIKE_ONE.sub(WORD, text)
    text = _QUERY.sub(rf"\1{WORD}", text)
    return _USER.sub(rf"\1{MASK}@", text)


def _passwords(text: str) -> Iterator[str]:
    """Give the passwords that stand in addresses."""
    for match in _USER.finditer(text):
        password = match[0].partition("://")[2][:-1].partition(":")[2]
        if password:
            yield password


def _parsed(name: str, text: str) -> Node | None:
    problems: list[Problem] = []
    node = parse_yaml(text, name, problems)
    return None if any(problem.is_error for problem in problems) else node


def _leaves(node: Node) -> Iterator[Node]:
    inner = (node.mapping or {}).values() if node.mapping is not None else node.items
    if inner is None:
        yield node
    for part in inner or ():
        yield from _leaves(part)


def _text(data: bytes) -> str | None:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None


def _is_yaml(name: str) -> bool:
    return PurePosixPath(name).suffix.lower() in _YAML
