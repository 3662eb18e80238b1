"""Simulated robots: small clients that speak the link's protocol and copy real journals."""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
import time
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import msgspec
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from amberbox.core.clock import NS
from amberbox.link import limits, uploads
from amberbox.link.connection import LinkOptions, authorization, socket_url
from amberbox.link.frames import (
    START,
    Ack,
    BeatFrame,
    DurableFrame,
    Hello,
    JournalPosition,
    RowsFrame,
    RunEnd,
    Welcome,
    WriterReach,
    encode,
    from_server,
)
from amberbox.link.uploader import HttpTransport, upload_headers
from benchmarks.fleetload.making import BOOT, CHANGING, COMPONENTS, Recording, Sealed
from benchmarks.fleetload.servers import Server

_TURN_S = 0.25
_TURN_ROWS = 5


@dataclass
class Heard:
    """What came of what was sent: when each changed status was sent, and how long it took."""

    sent_s: dict[tuple[str, int], float] = field(default_factory=dict)
    ages_s: list[float] = field(default_factory=list)
    acks_s: list[float] = field(default_factory=list)
    copied: int = 0
    refused: list[str] = field(default_factory=list)


@dataclass
class Robot:
    """One simulated robot; ``late_s`` is how long after the others it begins."""

    name: str
    server: Server
    recording: Recording
    heard: Heard
    context: ssl.SSLContext | None
    late_s: float = 0.0
    epoch: int = 0
    number: int = 0
    acked: int = 0
    at: int = 0
    """Rows that were sent."""
    _sent_s: dict[int, float] = field(default_factory=dict)
    _socket: Any = None

    @property
    def options(self) -> LinkOptions:
        """How the server is reached."""
        return LinkOptions(self.server.url, self.name, self.server.keys[self.name])

    @property
    def waiting(self) -> int:
        """Frames that are not acknowledged."""
        return self.number - self.acked

    async def greet(self) -> None:
        """Connect and say hello."""
        self._socket = await connect(
            socket_url(self.server.url), ssl=self.context, compression=None, ping_interval=None,
            additional_headers=authorization(self.options), max_size=limits.FRAME_BYTES,
            open_timeout=60,
        )  # fmt: skip
        hello = Hello(
            self.name, self.recording.store.id, BOOT, {"watch": _reach(0)}, "", time.time_ns(),
            time.monotonic_ns(), "bench", public_key=self.recording.public_key,
        )  # fmt: skip
        await self._socket.send(encode(hello))
        welcome = from_server(await self._socket.recv())
        assert isinstance(welcome, Welcome), welcome
        self.epoch = welcome.epoch

    async def live(self, seconds: float, threads: ThreadPoolExecutor) -> None:
        """Talk for so long, and copy journals as they are due."""
        listening = asyncio.create_task(self._listen())
        await self._beat_for(self.late_s)
        copying = asyncio.create_task(self._copy(threads, seconds))
        began_s = time.monotonic()
        turns = round(seconds / _TURN_S)
        for turn in range(turns):
            await asyncio.sleep(max(began_s + turn * _TURN_S - time.monotonic(), 0.0))
            await self._say(turn)
        while not copying.done():
            await self._beat_for(limits.BEAT_S)
        copying.result()
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)

    async def idle(self, greeted: asyncio.Barrier, enough: asyncio.Event) -> None:
        """Connect, and say nothing but that it is there, until it is enough."""
        await self.greet()
        listening = asyncio.create_task(self._listen())
        waiting = asyncio.create_task(greeted.wait())
        while not enough.is_set():
            await self._beat_for(limits.BEAT_S)
        await waiting
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)

    async def _beat_for(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            await self._socket.send(encode(self._beat()))
            await asyncio.sleep(min(limits.BEAT_S, left_s))

    async def leave(self) -> None:
        """Close the connection."""
        with contextlib.suppress(ConnectionClosed):
            await self._socket.close()

    async def _say(self, turn: int) -> None:
        rows = self.recording.rows[self.at : self.at + _TURN_ROWS]
        if rows and self.waiting < limits.WINDOW:
            now_s = time.monotonic()
            self.number += 1
            self._sent_s[self.number] = now_s
            for n in range(self.at, self.at + len(rows)):
                if n % COMPONENTS < CHANGING:
                    self.heard.sent_s[self.name, n] = now_s
            self.at += len(rows)
            upto = {"watch": JournalPosition(1, rows[-1].seq + 1)}
            await self._socket.send(encode(RowsFrame(self.epoch, self.number, list(rows), upto)))
        if turn % 4 == 3:
            end = self.recording.rows[self.at - 1].seq + 1
            await self._socket.send(encode(DurableFrame(self.epoch, {"watch": _reach(end)})))
            await self._socket.send(encode(self._beat()))

    def _beat(self) -> BeatFrame:
        return BeatFrame(self.epoch, time.time_ns(), time.monotonic_ns(), 0, 0, NS // 1000)

    async def _listen(self) -> None:
        while True:
            frame = from_server(await self._socket.recv())
            if isinstance(frame, Ack):
                for number in range(self.acked + 1, frame.number + 1):
                    self.heard.acks_s.append(time.monotonic() - self._sent_s.pop(number))
                self.acked = max(self.acked, frame.number)

    async def _copy(self, threads: ThreadPoolExecutor, seconds: float) -> None:
        began_s, loop = time.monotonic(), asyncio.get_running_loop()
        for one in self.recording.sealed:
            if one.after_s > seconds:
                return
            await asyncio.sleep(max(began_s + one.after_s - time.monotonic(), 0.0))
            verdict = await loop.run_in_executor(threads, self.copy, one)
            self.heard.copied += 1
            if verdict.state != "verified":
                self.heard.refused.append(verdict.reason)

    def copy(self, one: Sealed) -> uploads.Verdict:
        """Copy a journal with the robot's own code for requests; blocks."""
        sending = HttpTransport(self.options, lambda: self.context)
        address, about = (
            uploads.address(self.recording.store.id, one.name),
            upload_headers(one.path),
        )
        try:
            at, content = sending("HEAD", address, about, b"").offset, one.path.read_bytes()
            while at < len(content):
                piece = memoryview(content)[at : at + limits.PIECE_BYTES]
                more = {uploads.OFFSET: str(at), uploads.CRC: str(zlib.crc32(piece))}
                at = sending("PATCH", address, about | more, piece).offset
            reply = sending("POST", address, about, msgspec.json.encode(one.proof))
            return msgspec.json.decode(reply.body, type=uploads.Verdict)
        finally:
            sending.close()


async def listen(server: Server, context: ssl.SSLContext | None, heard: Heard) -> None:
    """Listen to the feed as a page does, and note how old statuses are when they come."""
    headers = {"Authorization": f"Bearer {server.token}"}
    address = f"{server.url.replace('http', 'ws', 1)}/api/v1/feed"
    async with connect(
        address, ssl=context, additional_headers=headers, max_size=None, compression=None
    ) as feed:
        await feed.send('{"kinds": ["status"]}')
        async for text in feed:
            now_s = time.monotonic()
            for message in json.loads(text):
                if message["kind"] == "status":
                    _note(heard, message["robot"], message["data"], now_s)


def _note(heard: Heard, robot: str, statuses: Sequence[Any], now_s: float) -> None:
    for status in statuses:
        sent_s = heard.sent_s.pop((robot, status["outputs"]["number"]), None)
        if sent_s is not None:
            heard.ages_s.append(now_s - sent_s)


def _reach(end: int) -> WriterReach:
    at = JournalPosition(1, end)
    return WriterReach(START, at, at, (RunEnd(1, BOOT, end, closed=False),))
