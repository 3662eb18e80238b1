"""Write the server into ``robot.yaml``, its comments and order untouched, and the key beside it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from amberbox.blackbox.folder.folder import ROBOT_FILE
from amberbox.blackbox.folder.server import KEY_FILE
from amberbox.core.errors import Problem, UsageError
from amberbox.core.files import replace_file, write_private
from amberbox.core.nodes import Node, parse_yaml

SERVER = "server"


def with_server(text: str, values: dict[str, str], drop: Sequence[str] = ()) -> str:
    """Return the text of a ``robot.yaml`` with these keys under ``server``; ``drop`` goes.

    Raises UsageError where that cannot be done without touching the rest.
    """
    for key in reversed(values):  # each new line comes before the others
        text = _with(text, key, values[key])
    for key in drop:
        text = _without(text, key)
    server = _server(text)
    said = {key: node.value for key, node in ((server and server.mapping) or {}).items()}
    if set(drop) & set(said) or any(said.get(key) != value for key, value in values.items()):
        lines = "".join(f"\n  {key}: {value}" for key, value in values.items())
        raise UsageError(
            f"{ROBOT_FILE} is written in a way that cannot be changed safely",
            f"write into it by hand, then try again:\n{SERVER}:{lines}",
        )
    return text


def write_key(folder: Path, key: str) -> None:
    """Write the key so that its owner alone can read it, and a power cut leaves old or new."""
    write_private(folder / KEY_FILE, f"{key}\n")


def write_robot_file(folder: Path, text: str) -> None:
    """Replace ``robot.yaml``; it keeps who may read it."""
    path = folder / ROBOT_FILE
    mode = path.stat().st_mode & 0o777 if path.exists() else 0o644
    replace_file(path, text)
    path.chmod(mode)


def _with(text: str, key: str, value: str) -> str:
    server = _server(text)
    keys = (server.mapping or {}) if server is not None else {}
    if server is None or not keys:
        bare = re.sub(rf"(?m)^{SERVER}:[ \t]*\n?", "", text) if server is not None else text
        end = "" if not bare or bare.endswith("\n") else "\n"
        return f"{bare}{end}\n{SERVER}:\n  {key}: {value}\n"
    if key in keys:
        place = keys[key].span
        return text[: place[0]] + value + text[place[1] :]
    if text[server.span[0]] == "{":
        return f"{text[: server.span[0] + 1]}{key}: {value}, {text[server.span[0] + 1 :]}"
    return _line_before(text, server, f"{key}: {value}")


def _line_before(text: str, server: Node, line: str) -> str:
    """Put a line before the first key of the block, indented as that is."""
    start = server.span[0]
    indent = text[text.rfind("\n", 0, start) + 1 : start]
    return f"{text[:start]}{line}\n{indent}{text[start:]}"


def _without(text: str, key: str) -> str:
    """Take a key out that stands in a line of its own, or in a mapping in braces."""
    server = _server(text)
    node = (server.mapping or {}).get(key) if server is not None else None
    if node is None or server is None:
        return text
    if text[server.span[0]] == "{":
        start, end = server.span
        inner = re.sub(rf",?\s*\b{key}:\s*{re.escape(_written(text, node))}", "", text[start:end])
        return text[:start] + re.sub(r"^\{\s*,\s*", "{", inner) + text[end:]
    start = text.rfind("\n", 0, node.span[0]) + 1
    end = text.find("\n", node.span[1])
    return text[:start] + (text[end + 1 :] if end >= 0 else "")


def _written(text: str, node: Node) -> str:
    return text[node.span[0] : node.span[1]]


def _server(text: str) -> Node | None:
    problems: list[Problem] = []
    root = parse_yaml(text, ROBOT_FILE, problems)
    if any(problem.is_error for problem in problems):
        return None
    return (root.mapping or {}).get(SERVER) if root is not None else None
