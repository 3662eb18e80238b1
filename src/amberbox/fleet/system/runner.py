"""Keeps one folder of the system level running: started again, later each time, when it ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from amberbox.link.backoff import Backoff

State = Literal["off", "running", "waiting"]
HEALTHY_S = 60.0
END_S = 12.0


def command_of(folder: Path) -> list[str]:
    """Return the command that runs a folder."""
    return [sys.executable, "-m", "amberbox.fleet.system.child", str(os.getpid()), str(folder)]


@dataclass
class Runner:
    """One folder and its process; ``trouble`` is what it said last before it ended."""

    folder: Path
    command: Sequence[str] = ()
    backoff: Backoff = field(default_factory=lambda: Backoff(least_s=1.0, most_s=60.0))
    state: State = "off"
    restarts: int = 0
    trouble: str = ""
    _process: asyncio.subprocess.Process | None = None

    async def run(self) -> None:
        """Run until cancelled; what runs then is told to end, and killed if it does not."""
        loop = asyncio.get_running_loop()
        while True:
            began_s = loop.time()
            try:
                await self._once()
            except OSError as error:
                self.trouble = f"cannot be started: {error.strerror}"
            if loop.time() - began_s > HEALTHY_S:
                self.backoff.succeeded()
            self.state, self.restarts = "waiting", self.restarts + 1
            await asyncio.sleep(self.backoff.failed())

    async def _once(self) -> None:
        process = self._process = await asyncio.create_subprocess_exec(
            *(self.command or command_of(self.folder)), stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        self.state = "running"
        try:
            await self._listen(process)
            status = await process.wait()
            self.trouble = self.trouble or f"it ended with status {status}"
        finally:
            await _end(process)
            self._process = None
            self.state = "off"

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        """Read what it prints, so that it never waits for us; remember the last of its troubles."""
        assert process.stderr is not None
        while line := await _line(process.stderr):
            text = line.decode("utf-8", "replace").strip()
            if "error:" in text:
                self.trouble = text.partition("error:")[2].strip()[:500]

    def kill(self) -> None:
        """End what is left, when the loop is gone."""
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGTERM)


async def _line(stream: asyncio.StreamReader) -> bytes:
    try:
        return await stream.readline()
    except ValueError:  # a line without an end
        return b"..."


async def _end(process: asyncio.subprocess.Process) -> None:
    """Ask a process to end, and kill it when it does not."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(END_S):
            await process.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
