"""Peers that notifications go to: a mail server and a web server, each in a thread of its own."""

from __future__ import annotations

import asyncio
import base64
import threading
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email import message_from_bytes, policy
from email.message import Message
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from amberbox.testing.clock import PATIENCE_S


@dataclass
class MailServer:
    """Implements as much SMTP (RFC 5321) as a sender needs; refuses a given number of times."""

    port: int = 0
    mails: list[Message] = field(default_factory=list)
    recipients: list[str] = field(default_factory=list)
    logins: list[bytes] = field(default_factory=list)
    refuse: int = 0
    offer: tuple[str, ...] = ("AUTH PLAIN",)

    async def talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Talk to one client."""
        writer.write(b"220 test ESMTP\r\n")
        while line := await reader.readline():
            verb = line[:4].upper()
            if verb == b"QUIT":
                break
            if verb == b"DATA":
                writer.write(b"354 go on\r\n")
                data = await reader.readuntil(b"\r\n.\r\n")
                self.mails.append(message_from_bytes(data[:-5], policy=policy.default))
            writer.write(self._answer(verb, line))
            await writer.drain()
        writer.close()

    def _answer(self, verb: bytes, line: bytes) -> bytes:
        if verb == b"EHLO":
            lines = ["test", *self.offer]
            marks = ["-"] * (len(lines) - 1) + [" "]
            return "".join(f"250{m}{t}\r\n" for m, t in zip(marks, lines, strict=True)).encode()
        if verb == b"AUTH":
            self.logins.append(base64.b64decode(line.split()[2]))
            return b"235 welcome\r\n"
        if verb == b"RCPT":
            self.recipients.append(line.decode().split("<")[1].split(">")[0])
            if self.refuse > 0:
                self.refuse -= 1
                return b"451 later\r\n"
        return b"250 fine\r\n"


@contextmanager
def mail_server() -> Iterator[MailServer]:
    """Run a mail server on loopback."""
    peer, ready, stop = MailServer(), threading.Event(), threading.Event()

    async def serve() -> None:
        server = await asyncio.start_server(peer.talk, "127.0.0.1", 0)
        peer.port = server.sockets[0].getsockname()[1]
        ready.set()
        await asyncio.to_thread(stop.wait)
        server.close()

    with _running(serve()):
        ready.wait(PATIENCE_S)
        try:
            yield peer
        finally:
            stop.set()


@contextmanager
def _running(work: Coroutine[Any, Any, None]) -> Iterator[None]:
    thread = threading.Thread(target=asyncio.run, args=(work,))
    thread.start()
    try:
        yield
    finally:
        thread.join(PATIENCE_S)


@dataclass
class Hook:
    """The requests to a web server, and its answers."""

    url: str = ""
    bodies: list[bytes] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)
    status: int = 204
    location: str = ""


@contextmanager
def hook_server() -> Iterator[Hook]:
    """Run a web server on loopback."""
    hook = Hook()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            hook.bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
            hook.headers.append(dict(self.headers))
            hook.paths.append(self.path)
            self.send_response(hook.status)
            if hook.location:
                self.send_header("Location", hook.location)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Suppress the log."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    hook.url = f"http://127.0.0.1:{server.server_port}/alarms?of=fleet"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield hook
    finally:
        server.shutdown()
        thread.join(PATIENCE_S)
        server.server_close()
