"""People with open pages, in a process of their own: they listen until the input ends.

``python -m benchmarks.feedload.viewers URL COUNT SESSION ...`` says ``ready`` when each has its
snapshot, and at the end what they heard, as JSON. A page that is refused ends it with a reason.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

import httpx
import msgspec
from websockets.asyncio.client import ClientConnection, connect

from amberbox.server.http.auth import COOKIE
from benchmarks.feedload.fleet import SENT
from benchmarks.feedload.viewing import Page, Piece, pages

START_S = 25.0


class Heard(msgspec.Struct):
    """What all of them heard: how late each change came, in ms; bytes and pieces."""

    began_s: float = 0.0
    seconds: float = 0.0
    late_ms: list[float] = []
    bytes: int = 0
    pieces: int = 0


@dataclass
class Viewer:
    """Somebody who looks at a page."""

    page: Page
    cookie: str
    client: httpx.AsyncClient
    heard: Heard
    group: asyncio.TaskGroup
    waiting: set[str] = field(default_factory=set)
    again: set[str] = field(default_factory=set)

    async def look(self, line: ClientConnection) -> None:
        """Take what comes, and fetch what it makes stale."""
        while True:
            text = await line.recv()
            now_ns = time.time_ns()
            self.heard.bytes += len(text)
            for message in msgspec.json.decode(text):
                self._take(message, now_ns)

    async def begin(self) -> None:
        """Fetch everything once, as the page did when it was opened: the server is warm then."""
        page = self.page
        for piece in (*page.regular, *page.news, *page.events, *page.resting):
            await self._fetch(piece.path.format(robot=(page.robots or ["r0"])[0]))

    async def repeat(self, piece: Piece, phase: float) -> None:
        """Fetch what is fetched again and again; ``phase`` from 0 to 1 is when it begins."""
        await asyncio.sleep(phase * piece.every_s)
        while True:
            await self._fetch(piece.path)
            await asyncio.sleep(piece.every_s)

    def _take(self, message: Mapping[str, Any], now_ns: int) -> None:
        kind, robot, data = message["kind"], message["robot"], message["data"]
        if kind == "status":
            sent_us = data[-1]["outputs"][SENT]
            self.heard.late_ms.append((now_ns / 1000 - sent_us) / 1000)
        if kind == "levels" and not self._stale(self.page.news, robot):
            self._stale(self.page.resting, robot)
        if kind == "event":
            self._stale(self.page.events, robot)

    def _stale(self, pieces: Sequence[Piece], robot: str) -> bool:
        """Fetch pieces at once, or when their time has come; tell whether all are at once."""
        paths = {piece.path.format(robot=robot): piece.every_s for piece in pieces}
        waiting = self.waiting & paths.keys()
        self.again |= waiting
        for path in paths.keys() - waiting:
            self.waiting.add(path)
            self.group.create_task(self._keep(path, paths[path]))
        return not waiting

    async def _keep(self, path: str, every_s: float) -> None:
        while True:
            self.again.discard(path)
            await self._fetch(path)
            await asyncio.sleep(every_s)
            if path not in self.again:
                self.waiting.remove(path)
                return

    async def _fetch(self, path: str) -> None:
        headers = {"Accept": "text/html", "Cookie": self.cookie}
        answer = await self.client.get(path, headers=headers)
        answer.raise_for_status()
        self.heard.pieces += 1


async def _main(url: str, count: int, sessions: Sequence[str]) -> None:
    """Look until the input ends; one that fails ends all."""
    heard = Heard()
    looking = asyncio.create_task(_look(url, count, sessions, heard))
    ended = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
    await asyncio.wait([looking, ended], return_when=asyncio.FIRST_COMPLETED)
    if looking.done():
        looking.result()
    heard.seconds = time.monotonic() - heard.began_s
    print(msgspec.json.encode(heard).decode())
    looking.cancel()


async def _look(url: str, count: int, sessions: Sequence[str], heard: Heard) -> None:
    opened = pages(count)
    cookies = [f"{COOKIE}={sessions[number % len(sessions)]}" for number in range(count)]
    async with httpx.AsyncClient(base_url=url, timeout=20) as client, asyncio.TaskGroup() as group:
        viewers = [Viewer(*one, client, heard, group) for one in zip(opened, cookies, strict=True)]
        await asyncio.gather(*(viewer.begin() for viewer in viewers))
        lines = await asyncio.gather(*map(_line, repeat(url), cookies, opened))
        heard.pieces = 0
        for number, (viewer, line) in enumerate(zip(viewers, lines, strict=True)):
            group.create_task(viewer.look(line))
            for piece in viewer.page.regular:
                group.create_task(viewer.repeat(piece, number / count))
        heard.began_s = time.monotonic()
        print("ready", flush=True)


async def _line(url: str, cookie: str, page: Page) -> ClientConnection:
    """Open the feed of a page and wait for its snapshot."""
    headers = {"Cookie": cookie, "Origin": url}
    address = f"ws{url.removeprefix('http')}/api/v1/feed"
    async with asyncio.timeout(START_S):
        line = await connect(address, additional_headers=headers, max_size=None, compression=None)
        await line.send(json.dumps({"robots": page.robots, "kinds": page.kinds}))
        await line.recv()
    return line


if __name__ == "__main__":
    asyncio.run(_main(sys.argv[1], int(sys.argv[2]), sys.argv[3:]))
