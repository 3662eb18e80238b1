"""Join a server: check its line, write it into the robot folder, and try the connection.

``robot.yaml`` keeps its comments and its order; the key is in a file beside it.
"""

from __future__ import annotations

import asyncio
import re
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.robot_folder.folder import ROBOT_FILE, RobotFolder, load_folder
from amberbox.blackbox.robot_folder.robot_yaml import KEY_FILE, url_problem
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store.store import Store, create_store
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.errors import Problem, UsageError
from amberbox.core.files import replace_file, write_private
from amberbox.core.version import __version__
from amberbox.core.yaml_nodes import Node, parse_yaml
from amberbox.link.connection import (
    LinkDownError,
    LinkOptions,
    LinkRefusedError,
    dial,
    greet,
    tls_context,
)
from amberbox.link.frames import Bye, FrameError, Hello, encode
from amberbox.link.join_line import JoinLine
from amberbox.link.record_reader import ReachReader

SERVER = "server"


def with_server(text: str, values: dict[str, str], drop: Sequence[str] = ()) -> str:
    """Return the text of a ``robot.yaml`` with these keys under ``server``, without those in
    ``drop``.

    Raises UsageError where that is impossible without changing the rest.
    """
    for key in reversed(values):  # each new line comes before the others
        text = _with(text, key, values[key])
    for key in drop:
        text = _without(text, key)
    server = _server(text)
    present = {key: node.value for key, node in ((server and server.mapping) or {}).items()}
    if set(drop) & set(present) or any(present.get(key) != value for key, value in values.items()):
        lines = "".join(f"\n  {key}: {value}" for key, value in values.items())
        raise UsageError(
            f"{ROBOT_FILE} is written in a way that cannot be changed safely",
            f"write into it by hand, then try again:\n{SERVER}:{lines}",
        )
    return text


def write_key(folder: Path, key: str) -> None:
    """Write the key atomically, readable by its owner only."""
    write_private(folder / KEY_FILE, f"{key}\n")


def write_robot_file(folder: Path, text: str) -> None:
    """Replace ``robot.yaml``, keeping its permissions."""
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
    start = server.span[0]  # a line before the first key of the block, with its indent
    indent = text[text.rfind("\n", 0, start) + 1 : start]
    return f"{text[:start]}{key}: {value}\n{indent}{text[start:]}"


def _without(text: str, key: str) -> str:
    """Remove a key on a line of its own, or in a mapping in braces."""
    server = _server(text)
    node = (server.mapping or {}).get(key) if server is not None else None
    if node is None or server is None:
        return text
    if text[server.span[0]] == "{":
        start, end = server.span
        value = re.escape(text[node.span[0] : node.span[1]])
        inner = re.sub(rf",?\s*\b{key}:\s*{value}", "", text[start:end])
        return text[:start] + re.sub(r"^\{\s*,\s*", "{", inner) + text[end:]
    start = text.rfind("\n", 0, node.span[0]) + 1
    end = text.find("\n", node.span[1])
    return text[:start] + (text[end + 1 :] if end >= 0 else "")


def _server(text: str) -> Node | None:
    problems: list[Problem] = []
    root = parse_yaml(text, ROBOT_FILE, problems)
    if any(problem.is_error for problem in problems):
        return None
    return (root.mapping or {}).get(SERVER) if root is not None else None


_CLOCK_NS = 60 * NS


@dataclass(frozen=True, slots=True)
class HelloResult:
    """The result of a connection; ``ahead_ns`` is the server's clock minus the robot's."""

    ahead_ns: int = 0

    @property
    def clock_note(self) -> str:
        """Return a description of the error of the robot's clock; empty below a minute."""
        if abs(self.ahead_ns) < _CLOCK_NS:
            return ""
        minutes, side = abs(self.ahead_ns) / NS / 60, "behind" if self.ahead_ns > 0 else "ahead of"
        about = f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:,.0f} h"
        return f"this computer's clock is {about} {side} the server's"


async def try_hello(
    options: LinkOptions, store: Store, context: ssl.SSLContext | None, clock: Clock
) -> HelloResult:
    """Connect, send Hello, and close the connection.

    Raises LinkRefusedError when the server refuses this robot, LinkDownError when it cannot be
    reached or is not an Amberbox server.
    """
    line = await dial(options, context)
    try:
        hello = Hello(
            options.robot,
            store.id,
            clock.boot_id(),
            ReachReader(store).state(),
            options.config_hash,
            clock.wall_ns(),
            clock.boot_ns(),
            __version__,
            public_key=public_key(store.path) or "",
        )
        welcome = await greet(line, hello)
        await line.send(encode(Bye("only a try")))
        return HelloResult(welcome.server_wall_ns - clock.wall_ns())
    except FrameError as error:
        raise LinkDownError(f"the server did not answer as an Amberbox server: {error}") from error
    finally:
        await line.close()


@dataclass(frozen=True, slots=True)
class JoinResult:
    """Result of joining: whether the server was reached, and lines for the user."""

    reached: bool
    lines: tuple[str, ...]


def join(
    path: Path, line: JoinLine, *, replace: bool = False, clock: Clock | None = None
) -> JoinResult:
    """Make a robot folder report to a server.

    A server that cannot be reached now is configured all the same, since its line contains what to
    trust. Raises UsageError, and writes nothing, where the line is for another robot, another
    server is configured without ``replace``, or the server is not the one of the line, or refuses
    the key.
    """
    folder = load_folder(path)
    _agree(folder, line, replace=replace)
    ca = {"ca": f"sha256:{line.ca}"} if line.ca else {}
    drop = ("token",) if ca else ("token", "ca")
    text = with_server(_text_of(folder.path), {"url": line.url, **ca}, drop)
    reached, lines = _tried(folder, line, clock or SystemClock())
    write_key(folder.path, line.key)
    write_robot_file(folder.path, text)
    return JoinResult(reached, (f"{folder.path / ROBOT_FILE} names {line.url} now", *lines))


def _agree(folder: RobotFolder, line: JoinLine, *, replace: bool) -> None:
    """Raise UsageError for a line of another robot, or one that would replace a server."""
    wrong = url_problem(line.url)
    if wrong:
        raise UsageError(f"the server's address {wrong}", "ask the server for another line")
    if line.robot != folder.robot.id:
        raise UsageError(
            f"the line is for the robot '{line.robot}', this folder is '{folder.robot.id}'",
            f"write 'id: {line.robot}' into {ROBOT_FILE} if they are the same robot",
        )
    known = folder.robot.server
    if known is not None and not replace and _place(known.url) != _place(line.url):
        raise UsageError(
            f"{folder.path / ROBOT_FILE} names another server, {known.url}",
            "add --replace to leave that one for this",
        )


def _place(url: str) -> str:
    return url.rstrip("/").lower()


def _text_of(folder: Path) -> str:
    path = folder / ROBOT_FILE
    return path.read_bytes().decode("utf-8-sig") if path.exists() else ""


def _tried(folder: RobotFolder, line: JoinLine, clock: Clock) -> tuple[bool, tuple[str, ...]]:
    """Connect once; return whether it succeeded, and lines for the user."""
    options = LinkOptions(line.url, line.robot, line.key, line.ca, config_hash=folder.config_hash)
    store = create_store(folder.store_path)
    try:
        context = tls_context(options.url, options.ca, store.path)
        trial = asyncio.run(try_hello(options, store, context, clock))
    except LinkRefusedError as error:
        raise UsageError(
            f"the server does not take this robot: {error}",
            f"add it there again: amberbox serve add-robot {line.robot}",
        ) from error
    except (LinkDownError, OSError) as error:
        return False, (f"it cannot be reached now: {error}", *_why(error))
    note = trial.clock_note
    return True, ("it knows this robot", *((note,) if note else ()))


def _why(error: Exception) -> tuple[str, ...]:
    """Return lines that explain a failed connection: the clock, the certificate, or the network."""
    if "CERTIFICATE_VERIFY_FAILED" not in str(error):
        return ("the link goes on trying; nothing is lost meanwhile",)
    if "not yet valid" in str(error) or "expired" in str(error):
        return ("is this computer's clock right? amberbox doctor tells",)
    return ("the server is not the one of the line, or has another name in its certificate",)
