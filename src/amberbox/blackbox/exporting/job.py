"""One export under way: what is read, where it goes, what is told about it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from amberbox.blackbox.exporting.looking import Looking
from amberbox.blackbox.exporting.report import ExportReport
from amberbox.blackbox.exporting.view import View
from amberbox.core.errors import UsageError

Progress = Callable[[float], None]
Compression = Literal["none", "bz2", "lz4"]


@dataclass(frozen=True)
class ExportOptions:
    """How a file is written: ``raw_text`` for CSV, ``compression`` for ROS 1 bags."""

    raw_text: bool = False
    compression: Compression = "none"


@dataclass(frozen=True)
class Job:
    """What every form of export is given."""

    looking: Looking
    view: View
    target: Path | None
    report: ExportReport
    progress: Progress
    options: ExportOptions

    @property
    def path(self) -> Path:
        """The target of a form that cannot go to the terminal."""
        assert self.target is not None
        return self.target


@contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """Give a path beside the target to write to; it becomes the target when all went well."""
    part = _part_of(target)
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Give a folder beside the target to write to; it becomes the target when all went well.

    Raises UsageError when something is at the target already.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UsageError(f"{target} is there already", "choose a folder that does not exist yet")
    part = _part_of(target)
    part.mkdir()
    try:
        yield part
        if target.exists():
            target.rmdir()
        part.replace(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _part_of(target: Path) -> Path:
    """Name what is written first; no other export and no file of the user has this name."""
    return target.with_name(f"{target.name}.{os.getpid()}.part")


def size_of(target: Path) -> int:
    """Bytes of a file, or of the files in a folder."""
    files = target.iterdir() if target.is_dir() else [target]
    return sum(file.stat().st_size for file in files)
