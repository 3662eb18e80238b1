"""What ``amberbox check`` says of a folder: asked anew when the folder has changed."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from amberbox.core.errors import Problem

_SECONDS = 60.0
_STORE = "store"


class _Report(msgspec.Struct):
    problems: list[Problem] = []


@dataclass
class Checks:
    """The last word on each folder."""

    _known: dict[Path, tuple[float, tuple[Problem, ...]]] = field(default_factory=dict)

    async def of(self, folder: Path) -> tuple[Problem, ...]:
        """Return the findings about a folder; what it brings along runs in a process of its own."""
        changed = await asyncio.to_thread(_changed, folder)
        known = self._known.get(folder)
        if known is None or known[0] != changed:
            self._known[folder] = known = changed, tuple(await _check(folder))
        return known[1]


def _changed(folder: Path) -> float:
    """Return when a file of the folder changed last; not those that it records."""
    times = [folder.stat().st_mtime]
    for path in folder.iterdir():
        if path.name == _STORE or path.name.startswith("."):
            continue
        times.append(path.stat().st_mtime)
        times += [below.stat().st_mtime for below in path.rglob("*") if path.is_dir()]
    return max(times)


async def _check(folder: Path) -> Sequence[Problem]:
    command = (sys.executable, "-m", "amberbox", "check", "--json", str(folder))
    process = await asyncio.create_subprocess_exec(
        *command, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        async with asyncio.timeout(_SECONDS):
            out, _ = await process.communicate()
        return msgspec.json.decode(out, type=_Report).problems
    except (TimeoutError, msgspec.MsgspecError):
        what = "could not be checked: 'amberbox check' of it does not end, or says nothing"
        return [Problem(str(folder), 1, "folder", what)]
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
