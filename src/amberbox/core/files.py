"""Files: written durably, replaced atomically, appended to whole, locked between processes."""

from __future__ import annotations

import fcntl
import os
import select
import stat
import time
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Protocol, TypeVar

from amberbox.core.errors import AmberboxError

_LONGEST_NAME = 255


def below(folder: Path, *names: str) -> Path:
    """Join names, also untrusted ones, to a path inside a folder.

    Each may have several parts (``a/b``). Raises AmberboxError for a name that would lead elsewhere
    (``..``, an absolute path) or that no file can have.
    """
    for name in names:
        if not all(map(_is_file_name, name.split("/"))):
            raise AmberboxError(
                f"{name[:100]!r} is no name of a file below {folder}",
                "it comes from a damaged or forged file: do not use that file",
            )
    return folder.joinpath(*names)


def _is_file_name(part: str) -> bool:
    size = len(part.encode("utf-8", "surrogateescape"))
    return part not in ("", ".", "..") and "\0" not in part and size <= _LONGEST_NAME


def read_at_most(path: Path, most_bytes: int, hint: str) -> bytes:
    """Read a whole file that a person has named.

    Raises AmberboxError for one that cannot be read, or that is longer (with the hint).
    """
    try:
        with path.open("rb") as file:
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise AmberboxError(
            f"cannot read {path}: {error.strerror}", "check the path and its permissions"
        ) from None
    if len(data) > most_bytes:
        raise AmberboxError(f"{path} has more than {most_bytes >> 20} MiB", hint)
    return data


def keep_to_group() -> None:
    """Make what this process creates unreadable for others: folders 0750, files 0640 at most.

    A stricter umask stays. Processes that it starts do the same.
    """
    before = os.umask(0o077)
    os.umask(before | 0o027)


def open_to_all(path: Path) -> str:
    """Return a warning if every user can read a folder, else an empty text."""
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else 0
    return f"everybody on this computer can read {path} (mode {mode:04o})" if mode & 0o007 else ""


def replace_file(path: Path, content: str | bytes) -> None:
    """Write a small file so that a power cut leaves the old or the new one."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    sync_folder(path.parent)


def write_private(path: Path, text: str, mode: int = 0o600) -> None:
    """Write a small private file as ``replace_file`` does; it never has more rights than ``mode``.

    A link at its place is replaced, not followed. Raises OSError.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.unlink(missing_ok=True)
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a new name in a folder survive a power cut."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def sync_file(path: Path) -> None:
    """Make the content of a file survive a power cut; raises FileNotFoundError if it is gone."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fdatasync(fd)
    finally:
        os.close(fd)


def write_all(fd: int, data: bytes) -> None:
    """Write bytes to a file, however many calls of the system that takes."""
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def try_lock(file: IO[str], tries: int = 10, pause_s: float = 0.02) -> bool:
    """Lock a file until it is closed; tries again, as readers hold the lock for a moment."""
    for _ in range(tries):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            time.sleep(pause_s)
        else:
            return True
    return False


def is_file_locked(path: Path) -> bool:
    """Return whether a process holds the lock of a file; it is held for a moment to find out."""
    try:
        with path.open("r") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


ReadableT = TypeVar("ReadableT", bound="int | HasFileno")


class HasFileno(Protocol):
    """A file, a pipe or a socket."""

    def fileno(self) -> int:
        """Return the file descriptor."""


def wait_readable(files: Iterable[ReadableT], timeout_s: float | None = None) -> list[ReadableT]:
    """Wait until one can be read or has ended, at most so long; return those for which it is so.

    Unlike ``select.select`` it takes file descriptors above 1023.
    """
    by_fileno = {one if isinstance(one, int) else one.fileno(): one for one in files}
    waiting = select.poll()
    for number in by_fileno:
        waiting.register(number, select.POLLIN)
    found = waiting.poll(None if timeout_s is None else max(0.0, timeout_s) * 1000.0)
    return [by_fileno[number] for number, _ in found]
