"""The robot's trust file: who may command what, at which highest risk, with which key.

``robot.yaml`` names it (``commands:``). It is read for each command, so that what is taken out of
it counts at once, and it never leaves the robot. Whoever may write it may move the robot, so a file
that others may write is not used.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.core.command import RISKS, CommandError, Risk, key_id, parse_key_text
from amberbox.core.config import Finding, build, raise_errors
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.options import option
from amberbox.core.yaml_nodes import parse_yaml

_MOST_BYTES = 1 << 20
_SERVER = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_PATTERN = re.compile(r"[A-Za-z0-9_.*?-]{1,64}")


@dataclass(frozen=True)
class TrustedPerson:
    """What one person may order."""

    key: str = option(doc="public key, ed25519:BASE64, as 'amberbox sign' shows it")
    risk: Risk = option(doc="highest risk of the person's commands")
    actions: Sequence[str] = option(("*",), "names of actions; * stands for anything")

    def check(self) -> Iterator[Finding]:
        """Yield each option with an invalid value, and why."""
        try:
            parse_key_text(self.key)
        except CommandError as error:
            yield "key", error.what, error.hint
        for pattern in self.actions:
            if not _PATTERN.fullmatch(pattern):
                yield "actions", f"'{pattern}' is no name of an action", "write dock, or drive_*"

    def may(self, action: str, risk: Risk) -> bool:
        """Return whether the person may order an action at a risk."""
        named = any(fnmatchcase(action, pattern) for pattern in self.actions)
        return named and RISKS.index(risk) <= RISKS.index(self.risk)


@dataclass(frozen=True)
class CommandTrust:
    """Everything in a trust file."""

    server: str = option(doc="id of the server whose commands count")
    people: Mapping[str, TrustedPerson] = option(doc="who may command, by name")
    confirm: Literal["code", "button"] = option("code", "how a motion is confirmed at the robot")

    def check(self) -> Iterator[Finding]:
        """Yield each option with an invalid value, and why; one key has one person."""
        if not _SERVER.fullmatch(self.server):
            yield "server", f"'{self.server}' is no id of a server"
        owners: dict[str, str] = {}
        for name, person in self.people.items():
            other = owners.setdefault(person.key, name)
            if other != name:
                yield "people", f"{name} and {other} have the same key"

    def person(self, key: str) -> tuple[str, bytes, TrustedPerson] | None:
        """Return name, public key and rights of the owner of a key, by the key's id."""
        for name, person in self.people.items():
            public = parse_key_text(person.key)
            if key_id(public) == key:
                return name, public, person
        return None


def trust_path(folder: RobotFolder) -> Path | None:
    """Return the path of a folder's trust file; None where ``robot.yaml`` names none."""
    named = folder.robot.commands
    return folder.path / Path(named).expanduser() if named else None


def read_trust(path: Path) -> CommandTrust:
    """Read a trust file.

    Raises ConfigurationError with all that is wrong in it, AmberboxError when it cannot be read or
    others may write it.
    """
    text = _read(path)
    problems: list[Problem] = []
    root = parse_yaml(text, str(path), problems)
    found = build(CommandTrust, root, problems) if root is not None else None
    raise_errors(problems)
    assert found is not None, "a file without errors has been read"
    return found


def _read(path: Path) -> str:
    try:
        # not blocking: a pipe at its place would be waited for
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        with os.fdopen(fd, "rb") as file:
            about = os.fstat(fd)
            folder = path.resolve().parent
            unsafe = _unsafe(path, about) or _unsafe(folder, folder.stat())
            if not stat.S_ISREG(about.st_mode):
                unsafe = f"the trust file {path} is no file"
            if unsafe:
                raise AmberboxError(unsafe, f"chmod go-w {path} {folder}")
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise AmberboxError(f"the trust file {path} has more than {_MOST_BYTES} bytes")
        return content.decode("utf-8-sig")
    except OSError as error:
        raise AmberboxError(
            f"the trust file {path} cannot be read: {error.strerror}",
            "'commands:' in robot.yaml names it",
        ) from error
    except UnicodeDecodeError as error:
        raise AmberboxError(f"the trust file {path} is not UTF-8 text") from error


def _unsafe(path: Path, about: os.stat_result) -> str:
    """Return why others could change a file, or put another one into a folder; else nothing."""
    mode = stat.S_IMODE(about.st_mode)
    if about.st_uid not in (0, os.geteuid()):
        return f"{path} belongs to another user (uid {about.st_uid}), who could change it"
    if mode & 0o022 and not (stat.S_ISDIR(about.st_mode) and mode & stat.S_ISVTX):
        return f"others may write to {path} (mode {mode:04o}), and so command this robot"
    return ""
