"""Run the demonstration: until Ctrl-C, or through its story, which checks itself."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.errors import AmberboxError
from amberbox.demo.fleet import LiveDemo, OutagePlan, start_tied
from amberbox.server import start
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.signin import CODE_LASTS_NS
from amberbox.server.config import ListenOptions
from amberbox.server.start import StartedServer

HOST = "127.0.0.1"
PORT = 8443
_PORTS = 50  # number of ports that are tried
_NOW_AND_THEN = OutagePlan(60.0, 30.0, 90.0)
_OF_STORY = 0.15  # share of the story for which a robot is disconnected
_MINUTES = CODE_LASTS_NS // 60_000_000_000


def free_port(first: int) -> int:
    """Return the first free port from ``first`` on; raises AmberboxError without one."""
    for port in range(first, min(first + _PORTS, 65536)):
        with closing(socket.socket()) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return port
    raise AmberboxError(f"the ports from {first} on are taken", "name another one with --port")


def run(folder: Path, port: int, seconds: float | None) -> int:
    """Run the demonstration below a folder; ``seconds`` is the length of its story, None for
    people.

    Returns 0 when a person ended it, or every step of the story worked.
    """
    free = free_port(port)
    if free != port:
        print(f"port {port} is taken, so it is {free}")
    stage = LiveDemo(folder, free)
    stage.prepare()
    show = DemoRun(stage, seconds)
    try:
        stage.begin()  # robots and server start in parallel, in nearly the same time
        start.run(stage.data, ListenOptions(HOST, free), begun=show.begin, demo=stage)
    finally:
        stage.close()
    show.raise_if_broken()
    return show.status


@dataclass(eq=False)
class DemoRun:
    """The task beside the server, on its event loop."""

    stage: LiveDemo
    seconds: float | None
    status: int = 0
    _task: asyncio.Task[None] | None = None

    def begin(self, start: StartedServer) -> None:
        """Start the task, once the server answers."""
        url = start.settings.public_url
        self.stage.sign(url)
        self._task = asyncio.get_running_loop().create_task(self._go_on(url))
        self._task.add_done_callback(_end_if_broken)

    def raise_if_broken(self) -> None:
        """Raise the exception of the task, if there is one."""
        if self._task is not None and not self._task.cancelled():
            error = self._task.exception()
            if error is not None:
                raise error

    async def _go_on(self, url: str) -> None:
        if self.seconds is None:
            away = self.stage.cycle_outages(_NOW_AND_THEN, announce, self.stage.relay.was_used)
        else:
            off_s = self.seconds * _OF_STORY
            once = OutagePlan(off_s / 2, off_s, self.seconds)
            away = self.stage.cycle_outages(once, _be_silent, self.stage.broken)
        shown = self._welcome(url) if self.seconds is None else self._show_status(url)
        await asyncio.gather(away, shown)

    async def _welcome(self, url: str) -> None:
        """Print sign-in links, and new ones on each Enter."""
        print(f"\nThree simulated robots run, recorded and watched, at {url}")
        pressed = asyncio.Event()
        asyncio.get_running_loop().add_reader(sys.stdin, _read_line, pressed)
        try:
            while True:
                self._print_links(url)
                await pressed.wait()
                pressed.clear()
        finally:
            asyncio.get_running_loop().remove_reader(sys.stdin)

    def _print_links(self, url: str) -> None:
        print(f"\nSign in with one of these (each works once, within {_MINUTES} minutes):\n")
        for role in reversed(Role):
            print(f"  {role:<11} {url}/in#{self.stage.codes.make(str(role))}")
        print("\nBreak a robot with the bar at the top of each page, and watch what follows."
              "\nWhat robots are to do has to be signed with a person's key: here it is for you."
              "\nA motion has to be confirmed at the robot, too: use the bar."
              "\nEnter prints new links, Ctrl-C ends everything.\n", flush=True)  # fmt: skip

    async def _show_status(self, url: str) -> None:
        """Run the story as a process, then end the server."""
        codes = {str(role): self.stage.codes.make(str(role)) for role in Role}
        story = start_tied(("amberbox.demo",), stdin=subprocess.PIPE)
        try:
            asked = json.dumps({"url": url, "codes": codes}).encode()
            await asyncio.to_thread(story.communicate, asked)
        finally:
            story.terminate()
        self.status = 1 if story.returncode else 0
        os.kill(os.getpid(), signal.SIGTERM)


def announce(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


def _be_silent(text: str) -> None:
    """Print nothing, as the story prints its own steps."""


def _read_line(pressed: asyncio.Event) -> None:
    if sys.stdin.readline():
        pressed.set()
    else:
        asyncio.get_running_loop().remove_reader(sys.stdin)  # stdin is closed


def _end_if_broken(task: asyncio.Task[None]) -> None:
    """End the server when the task has failed; ``run`` raises the reason."""
    if not task.cancelled() and task.exception() is not None:
        os.kill(os.getpid(), signal.SIGTERM)
