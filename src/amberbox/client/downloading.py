"""Files that the server makes: waited for, then saved; what was cut short goes on."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.core.errors import AmberboxError

if TYPE_CHECKING:
    from http.client import HTTPResponse

    from amberbox.client.data_models import Download
    from amberbox.client.fleet import Fleet

Progress = Callable[[float], None]
_PIECE = 1 << 18
_POLLS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
_ATTEMPTS = 3


def waited(
    fleet: Fleet, download: str, progress: Progress | None, limit_s: float | None
) -> Download:
    """Wait until a download is made.

    Raises AmberboxError when it failed, was cancelled, or took longer than ``limit_s``.
    """
    end_s = None if limit_s is None else time.monotonic() + limit_s
    number = 0
    while not (found := fleet.download(download)).is_over:
        if progress is not None:
            progress(found.progress)
        if end_s is not None and time.monotonic() > end_s:
            raise AmberboxError(f"the download {download} is not made after {limit_s:g} s")
        time.sleep(_POLLS_S[min(number, len(_POLLS_S) - 1)])
        number += 1
    if found.state != "done":
        why = f": {found.error}" if found.error else ""
        raise AmberboxError(f"{fleet.url}: the download {found.id} is {found.state}{why}")
    return found


def saved(fleet: Fleet, download: str, target: Path, progress: Progress | None) -> Path:
    """Save a file that is made; ``target`` may be a folder.

    It appears when it is whole. The part of another attempt, ``NAME.ID.part`` beside it, goes on.
    """
    found = fleet.download(download)
    file = target / Path(found.file or download).name if target.is_dir() else target
    part = file.with_name(f"{file.name}.{download}.part")
    for left in reversed(range(_ATTEMPTS)):
        try:
            _append(fleet, found, part, progress)
            break
        except AmberboxError:
            if not left or not part.exists():
                raise
    size = part.stat().st_size
    if size != found.bytes:
        part.unlink()
        raise AmberboxError(f"{found.bytes} bytes were to come, {size} came", "try again")
    part.replace(file)
    return file


def _append(fleet: Fleet, found: Download, part: Path, progress: Progress | None) -> None:
    have = part.stat().st_size if part.exists() else 0
    if have > found.bytes:
        part.unlink()
        have = 0
    if have == found.bytes and part.exists():
        return
    with fleet.wire.stream(f"/downloads/{found.id}/file", have) as answer:
        _take(answer, part, "ab" if have and answer.status == 206 else "wb", found, progress)


def _take(
    answer: HTTPResponse, part: Path, mode: str, found: Download, progress: Progress | None
) -> None:
    with part.open(mode) as opened:
        while piece := answer.read(_PIECE):
            opened.write(piece)
            if progress is not None:
                progress(opened.tell() / max(found.bytes, 1))
        opened.flush()
        os.fsync(opened.fileno())
