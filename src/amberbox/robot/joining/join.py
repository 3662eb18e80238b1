"""Join a server: check its line, write it down, and try it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.folder.folder import ROBOT_FILE, RobotFolder, load_folder
from amberbox.blackbox.folder.server import url_problem
from amberbox.blackbox.store import create_store
from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import UsageError
from amberbox.link.joining import JoinLine
from amberbox.robot.joining.trial import try_hello
from amberbox.robot.joining.writing import with_server, write_key, write_robot_file
from amberbox.robot.link.dialing import LinkDownError, RefusedError
from amberbox.robot.link.options import LinkOptions
from amberbox.robot.link.tls import context_for


@dataclass(frozen=True, slots=True)
class Joined:
    """What came of it: ``reached`` the server now or not, and what there is to say."""

    reached: bool
    lines: tuple[str, ...]


def join(
    path: Path, line: JoinLine, *, replace: bool = False, clock: Clock | None = None
) -> Joined:
    """Make a robot folder report to a server.

    A server that cannot be reached now is written down all the same: its line says whom to trust.
    Raises UsageError, and writes nothing, where the line is for another robot, another server is
    there without ``replace``, or the server is not the one of the line, or refuses the key.
    """
    folder = load_folder(path)
    _agree(folder, line, replace=replace)
    ca = {"ca": f"sha256:{line.ca}"} if line.ca else {}
    drop = ("token",) if ca else ("token", "ca")
    text = with_server(_text_of(folder.path), {"url": line.url, **ca}, drop)
    reached, lines = _tried(folder, line, clock or SystemClock())
    write_key(folder.path, line.key)
    write_robot_file(folder.path, text)
    return Joined(reached, (f"{folder.path / ROBOT_FILE} names {line.url} now", *lines))


def _agree(folder: RobotFolder, line: JoinLine, *, replace: bool) -> None:
    """Refuse a line for another robot, and to put a server in another one's place."""
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
    """Say hello once; tell whether that worked, and what there is to say."""
    options = LinkOptions(line.url, line.robot, line.key, line.ca, config_hash=folder.config_hash)
    store = create_store(folder.store_path)
    try:
        context = context_for(options.url, options.ca, store.path)
        trial = asyncio.run(try_hello(options, store, context, clock))
    except RefusedError as error:
        raise UsageError(
            f"the server does not take this robot: {error}",
            f"add it there again: amberbox serve add-robot {line.robot}",
        ) from error
    except (LinkDownError, OSError) as error:
        return False, (f"it cannot be reached now: {error}", *_why(error))
    note = trial.clock_note
    return True, ("it knows this robot", *((note,) if note else ()))


def _why(error: Exception) -> tuple[str, ...]:
    """Say what is behind a failed check of a certificate, where that can be told."""
    if "CERTIFICATE_VERIFY_FAILED" not in str(error):
        return ("the link goes on trying; nothing is lost meanwhile",)
    if "not yet valid" in str(error) or "expired" in str(error):
        return ("is this computer's clock right? amberbox doctor tells",)
    return ("the server is not the one of the line, or has another name in its certificate",)
