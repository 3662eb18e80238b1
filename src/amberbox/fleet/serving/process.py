"""The server's process: one event loop that answers, and the parts that work beside it."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import resource
import signal
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import uvicorn

from amberbox.blackbox.service import Notifier
from amberbox.core.errors import AmberboxError
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.services import Services
from amberbox.fleet.serving import assembly, background
from amberbox.fleet.serving.asgi import ASGIApp
from amberbox.fleet.serving.refusals import RefusingProtocol
from amberbox.fleet.serving.settings import Settings
from amberbox.fleet.serving.slowheaders import PatientProtocol
from amberbox.fleet.serving.wrapping import wrapped
from amberbox.link import limits
from amberbox.link.frames import Bye

GRACE_S = 3.0
"""So long requests that have begun may take when the server is to end."""
_BYE_S = 1.0
_BACKLOG = 2048
_LOOK_S = 1.0
_FILES = 65_536
_PONG_S = 90.0
"""A pong stands behind what its sender said before; under load that is not read at once, and to end
connections then makes it worse. Links and the feed notice silence by themselves, sooner."""


@dataclass(frozen=True, slots=True)
class Told:
    """What the process tells as it goes: that it answers, and that it ends."""

    ready: Callable[[int], None] = lambda port: None
    stopping: Callable[[], None] = lambda: None


def listen(settings: Settings) -> socket.socket:
    """Open the port; raises AmberboxError when it cannot be had."""
    try:
        found = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM,
                                   flags=socket.AI_PASSIVE)  # fmt: skip
        family, kind, protocol, _, address = found[0]
        port = socket.socket(family, kind, protocol)
    except OSError as error:
        raise AmberboxError(
            f"'{settings.host}' is no address of this machine: {error.strerror}", "--host ADDRESS"
        ) from error
    try:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        port.bind(address)
        port.listen(_BACKLOG)
    except OSError as error:
        port.close()
        raise AmberboxError(
            f"cannot listen at {settings.host}, port {settings.port}: {error.strerror}",
            "take another one with --port, or stop who has it",
        ) from error
    return port


async def serve(services: Services, port: socket.socket, told: Told | None = None) -> None:
    """Answer until SIGTERM or Ctrl-C; then say goodbye to robots, and end within seconds.

    Raises DatabaseDamagedError, after the same orderly end, when the database turns out damaged.
    """
    told, stop, notifier = told or Told(), asyncio.Event(), Notifier()
    served = wrapped(services)
    server = _Server(_config(served.app, services.settings))
    services.bus.attach(asyncio.get_running_loop())
    _listen_to_signals(stop, server)
    parts = background.start(assembly.parts(services))
    answering = asyncio.create_task(server.serve([port]))
    alive = asyncio.create_task(_stay_alive(server, notifier, services.links))
    stopping = asyncio.create_task(stop.wait())
    damaged = asyncio.create_task(_until_damaged(services.database))
    try:
        await _until_started(server, answering)
        gc.freeze()  # what is there now stays: the collector need not look at it each time
        gc.enable()
        told.ready(int(port.getsockname()[1]))
        notifier.ready()
        ends = [answering, stopping, damaged]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    finally:
        told.stopping()
        notifier.stopping("ending connections")
        await say_goodbye(services.links)
        server.should_exit = True
        await asyncio.wait([answering])
        for asking in (services.asking, services.preparing):
            asking.close()  # threads that wait for an answer would hold up the loop's end
        for task in (alive, stopping, damaged):
            task.cancel()
        await background.end(parts)
        served.log.close()
    if services.database.damage is not None:
        raise services.database.damage
    if not stop.is_set():
        answering.result()


async def _until_damaged(database: Database) -> None:
    """Wait until damage of the database has shown itself: what is taken then may be lost."""
    while database.damage is None:
        await asyncio.sleep(_LOOK_S)


async def say_goodbye(links: LinkServer) -> None:
    """Tell all robots that the server ends: they try again soon, and lose nothing."""
    everyone = list(links.robots.values())
    goodbyes = [links.send(one.robot, Bye("the server stops")) for one in everyone]
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_BYE_S):
            await asyncio.gather(*goodbyes, return_exceptions=True)
    for one in everyone:
        one.end.closed = True
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_BYE_S):
            await asyncio.gather(*(one.socket.close() for one in everyone), return_exceptions=True)


def raise_file_limit() -> None:
    """Let the process have as many connections and files open as the system allows it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _FILES if hard == resource.RLIM_INFINITY else min(hard, _FILES)
    if soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


class _Server(uvicorn.Server):
    """uvicorn without handlers of its own for signals: ends have an order here."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to the process."""
        yield


def _config(app: ASGIApp, settings: Settings) -> uvicorn.Config:
    return uvicorn.Config(
        app, http=PatientProtocol, ws=RefusingProtocol, lifespan="off", log_config=None,
        access_log=False, server_header=False, proxy_headers=False, timeout_keep_alive=15,
        timeout_graceful_shutdown=int(GRACE_S), ws_max_size=limits.FRAME_BYTES,
        ws_per_message_deflate=False, ws_ping_timeout=_PONG_S, backlog=_BACKLOG,
        log_level="warning", ssl_certfile=settings.certificate, ssl_keyfile=settings.key,
    )  # fmt: skip


def _listen_to_signals(stop: asyncio.Event, server: uvicorn.Server) -> None:
    def end() -> None:
        if stop.is_set():
            server.force_exit = True  # asked twice: do not wait for anybody
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, end)


async def _until_started(server: uvicorn.Server, answering: asyncio.Task[None]) -> None:
    while not server.started and not answering.done():
        await asyncio.sleep(0.005)


async def _stay_alive(server: uvicorn.Server, notifier: Notifier, links: LinkServer) -> None:
    """Tell systemd that the loop goes round."""
    while True:
        notifier.alive(lambda: f"{len(links.robots)} robots connected")
        await asyncio.sleep(1.0)
