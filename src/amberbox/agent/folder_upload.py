"""Send the robot folder to the server: packed, by its hash, with all secrets masked.

YAML is parsed: values that a configuration class marks as secret, and values with a secret-sounding
key, are masked. Comments are removed that are beside a masked value, sound secret, or contain a
secret. Found secrets are then masked in all files, with everything in the form of a secret.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath

import yaml

from amberbox.blackbox.robot_folder.folder import (
    BLACK_BOX_FILE,
    ROBOT_FILE,
    SOURCES,
    RobotFolder,
    configuration_files,
    hash_files,
)
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE, RobotConfig
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.plugins import Plugin, find
from amberbox.core.redaction import (
    MASK,
    SOUNDS_SECRET,
    redact,
    secret_word_pattern,
    secrets,
    secrets_by_name,
    sounds_secret,
)
from amberbox.core.yaml_nodes import Node, parse_yaml
from amberbox.link.folders import (
    FILES,
    PICTURE_BYTES,
    PICTURES_BYTES,
    UNPACKED_BYTES,
    address,
    is_picture,
    pack,
    travels,
)
from amberbox.link.join_line import LOOKS_LIKE_ONE
from amberbox.link.uploader import CopyError, UploadTransport

WORD = "(masked)"  # replaces a secret within a text, where it breaks no syntax

_YAML = frozenset({".yaml", ".yml"})
_LEAST = 6  # shorter secrets are not searched for elsewhere: they would match any number
_LEAST_IN_COMMENTS = 3
_USER = re.compile(r"((?<![a-zA-Z0-9+.-])[0-9+.-]*+[a-zA-Z][a-zA-Z0-9+.-]*+://)[^/\s@'\"<>]+@")
_QUERY = re.compile(
    rf"([?&]{secret_word_pattern(f'(?:{SOUNDS_SECRET}|key|sig)')}=)[^&\s#'\"<>]+", re.IGNORECASE
)
_PEM = re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*-----|\Z)", re.DOTALL)
_NAMED_VALUE = re.compile(
    rf"(\b{secret_word_pattern(SOUNDS_SECRET)}[\"']?\s*(?:[:=]|\bis\b)\s*)(\"[^\"]*\"|'[^']*'|[^\s\"'<>,;]+)",
    re.IGNORECASE,
)
_OPENING = re.compile(rf"<{secret_word_pattern(SOUNDS_SECRET)}", re.IGNORECASE)


def masked(files: Mapping[str, bytes], known: Collection[str] = ()) -> dict[str, bytes]:
    """Return files of a folder with secrets masked, by name; ``known`` are further secrets.

    A file that cannot be parsed as its type is left out, as its secrets cannot be found.
    """
    found = {secret for secret in known if secret}
    texts: dict[str, str] = {}
    plugins = find(SOURCES, defines=("Config", "Source"))
    for name, data in files.items():
        text = _text(data)
        if text is None:
            continue
        found.update(_passwords(text))
        done = _yaml(name, text, plugins, found) if _is_yaml(name) else mask_text(text)
        if done is not None:
            texts[name] = done
    cleared = {name: _cleared(name, text, found) for name, text in texts.items()}
    return {name: text.encode() for name, text in cleared.items() if text is not None}


def _cleared(name: str, text: str, found: set[str]) -> str | None:
    """Mask known secrets in a text; return None if a YAML file would become unreadable."""
    if _is_yaml(name):
        text = _without_comments(text, found)
    for secret in sorted(found, key=len, reverse=True):
        if len(secret) >= _LEAST:
            text = text.replace(secret, WORD)
    text = mask_by_form(text)
    return text if not _is_yaml(name) or _parsed(name, text) is not None else None


def _yaml(name: str, text: str, plugins: Mapping[str, Plugin], found: set[str]) -> str | None:
    """Mask the values of a YAML file, which are added to ``found``; None if it cannot be read."""
    root = _parsed(name, text)
    if root is None:
        return None
    nodes = list(_secret_nodes(name, root, plugins))
    found.update(leaf.text.strip() for node in nodes for leaf in _leaves(node))
    return redact(text, _outermost(nodes))


def _secret_nodes(name: str, root: Node, plugins: Mapping[str, Plugin]) -> Iterator[Node]:
    yield from secrets_by_name(root)
    if name == ROBOT_FILE:
        yield from secrets(RobotConfig, root)
    elif name == BLACK_BOX_FILE:
        for entry in root.items or (root,):
            for plugin, node in (entry.mapping or {}).items():
                yield from _of_source(plugins.get(plugin), node)


def _of_source(plugin: Plugin | None, node: Node) -> Iterator[Node]:
    """Yield the nodes that a source's configuration class marks as secret; none on load errors."""
    if plugin is None:
        return
    try:
        cls = plugin.load().Config
    except AmberboxError:
        return
    yield from secrets(cls, node)


def _outermost(nodes: Iterable[Node]) -> list[Node]:
    """Return the nodes that are not within others, which are replaced as a whole."""
    chosen: list[Node] = []
    for node in sorted(nodes, key=lambda n: (n.span[0], -n.span[1])):
        if not chosen or node.span[0] >= chosen[-1].span[1]:
            chosen.append(node)
    return chosen


def _without_comments(text: str, known: Collection[str]) -> str:
    """Remove comments beside masked values, and those that suggest or contain a secret."""
    for start, end in reversed(list(_comments(text))):
        line = text[text.rfind("\n", 0, start) + 1 : start]
        comment = text[start:end]
        holds = any(s in comment for s in known if len(s) >= _LEAST_IN_COMMENTS)
        if MASK in line or holds or sounds_secret(comment):
            before = text[:start].rstrip(" ") if line.strip() else f"{text[:start]}#"
            text = before + text[end:]
    return text


def _comments(text: str) -> Iterator[tuple[int, int]]:
    """Yield the spans of comments, from their # to the end of the line."""
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


def mask_text(text: str) -> str:
    """Mask values after a secret-sounding word: ``password: ...``, ``<token>...``."""
    return _NAMED_VALUE.sub(lambda match: match[1] + mask_quoted(match[2]), _elements(text))


def _elements(text: str) -> str:
    """Mask the text of XML elements with a secret-sounding name, in linear time."""
    parts, at, closing = [], 0, -1
    for opening in _OPENING.finditer(text):
        if opening.start() < at or opening.end() <= closing:
            continue  # of several openings before one ">" the first counts
        closing = text.find(">", opening.end())
        if closing < 0:
            break
        end = text.find("<", closing)
        if end > closing + 1 and text.startswith("</", end):
            parts += [text[at : closing + 1], WORD]
            at = end
    return "".join([*parts, text[at:]])


def mask_quoted(written: str) -> str:
    """Return the mask of a value in the quotes that the value was written with."""
    quote = written[0] if written[0] in "\"'" else ""
    return f"{quote}{WORD}{quote}"


def mask_by_form(text: str) -> str:
    """Mask secrets by their form: keys, users and passwords in URLs."""
    text = _PEM.sub(WORD, text)
    text = LOOKS_LIKE_ONE.sub(WORD, text)
    text = _QUERY.sub(rf"\1{WORD}", text)
    return _USER.sub(rf"\1{MASK}@", text)


def _passwords(text: str) -> Iterator[str]:
    """Yield the passwords in URLs."""
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


_FILE_BYTES = 4 << 20  # larger files are not sent: declarations are written by people


def packed_folder(folder: RobotFolder, *, pictures: bool = False) -> bytes:
    """Return the packed folder with secrets masked, and with as many ``pictures`` as are taken.

    Raises AmberboxError when it no longer matches its hash, or is too large.
    """
    files = configuration_files(folder)
    if hash_files(files) != folder.config_hash:
        raise AmberboxError(
            "the folder has changed since it was read", "it is sent once it is read anew"
        )
    chosen = [name for name in sorted(files) if travels(name) and _is_declaration(files[name])]
    read = {name: files[name].read_bytes() for name in chosen[:FILES]}
    if sum(map(len, read.values())) > UNPACKED_BYTES:
        raise AmberboxError(f"the folder has more than {UNPACKED_BYTES} bytes", "move data out")
    drawn = _pictures(files, FILES - len(read)) if pictures else {}
    read |= {name: data for name, data in drawn.items() if _is_svg(name)}
    sent = masked(read, _own_keys(folder))
    sent |= {name: data for name, data in drawn.items() if not _is_svg(name)}
    return pack(sent, pictures=pictures)


def _is_svg(name: str) -> bool:
    return PurePosixPath(name).suffix.lower() == ".svg"


def _pictures(files: Mapping[str, Path], count: int) -> dict[str, bytes]:
    """Return the pictures of experiments, in order of their names, as many as a server takes."""
    found: dict[str, bytes] = {}
    size = 0
    for name in sorted(files):
        if not is_picture(name) or files[name].is_symlink() or len(found) == count:
            continue
        more = files[name].stat().st_size
        if more <= PICTURE_BYTES and size + more <= PICTURES_BYTES:
            found[name] = files[name].read_bytes()
            size += more
    return found


def send_folder(folder: RobotFolder, send: UploadTransport, *, pictures: bool = False) -> None:
    """Send a folder, with ``pictures`` to servers that take them.

    Raises CopyError to retry later, AmberboxError when it cannot be sent.
    """
    packed = packed_folder(folder, pictures=pictures)
    headers = {"Content-Type": "application/octet-stream"}
    reply = send("PUT", address(folder.config_hash), headers, packed)
    if not 200 <= reply.status < 300:
        raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")


def _is_declaration(path: Path) -> bool:
    return path.stat().st_size <= _FILE_BYTES


def _own_keys(folder: RobotFolder) -> list[str]:
    """Return the robot's key, whole and without its prefix."""
    try:
        key = (folder.path / KEY_FILE).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return []
    return [key, key.rpartition("_")[2]]
