"""The server's process: creates the services, runs the event loop and the background services."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import resource
import signal
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import h11
import uvicorn
from sqlalchemy import select
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.core.pacing import Backoff
from amberbox.core.systemd import Notifier
from amberbox.link import limits
from amberbox.link.frames import Bye
from amberbox.server.accounts.passwords import Passwords
from amberbox.server.alarms.manager import Alarms
from amberbox.server.app import wrapped
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.maintenance import ArchiveMaintenance
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.config import ServerSettings
from amberbox.server.data.downloads import DownloadService
from amberbox.server.data.missions import OpenedStores
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.experiments.judge import RunJudge
from amberbox.server.experiments.robot_runs import RobotRuns
from amberbox.server.experiments.runner import ExperimentRunner
from amberbox.server.experiments.shelf import ExperimentShelf
from amberbox.server.ingest.fetches import FetchService
from amberbox.server.ingest.folders import FolderService
from amberbox.server.ingest.link_server import LinkHooks, LinkServer, SessionRevocation
from amberbox.server.ingest.uploads import IncomingJournal, UploadService
from amberbox.server.ingest.verification import VerificationResult
from amberbox.server.journals import JournalKey
from amberbox.server.knowledge.explanations import Explained, publish_diagnoses
from amberbox.server.learning.following import FollowService
from amberbox.server.learning.models import LearningService
from amberbox.server.live.feed import Feed
from amberbox.server.live.views import FleetState
from amberbox.server.record_orders import RecordOrders
from amberbox.server.schema import STORE
from amberbox.server.services.context import Services
from amberbox.server.services.experiments import answer_diagnosis
from amberbox.server.system import SystemLevel
from amberbox.server.web.page import Warming
from amberbox.server.workers.pool import RequestThreads, WorkerPool


class BackgroundService(Protocol):
    """A service that runs in the background as long as the server does."""

    async def run(self) -> None:
        """Work until cancelled; after an exception, which is logged, it is called again after a
        delay.
        """

    def close(self) -> None:
        """Close processes and files; called once, after ``run`` has ended."""


# After this many seconds without failure, the restart delay is reset
HEALTHY_S = 60.0


async def keep_running(part: BackgroundService, backoff: Backoff | None = None) -> None:
    """Run a background service until it returns or is cancelled; after a failure restart it."""
    waits = backoff or Backoff(least_s=1.0, most_s=60.0)
    loop = asyncio.get_running_loop()
    while True:
        began_s = loop.time()
        try:
            await part.run()
            return
        except AmberboxError as error:  # the database is busy or damaged, the disk is full
            name = type(part).__name__
            logging.getLogger(__name__).error("%s failed and starts again: %s", name, error.what)
        except Exception:  # an error in one service must not stop the server
            name = type(part).__name__
            logging.getLogger(__name__).exception("%s failed and starts again", name)
        if loop.time() - began_s >= HEALTHY_S:
            waits.succeeded()
        await asyncio.sleep(waits.failed())


def start(parts: Sequence[BackgroundService]) -> list[asyncio.Task[None]]:
    """Start all background services; return their tasks."""
    return [asyncio.create_task(keep_running(part), name=type(part).__name__) for part in parts]


async def end(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancel all background services and wait for them."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def make_services(
    folder: Path,
    settings: ServerSettings,
    clock: Clock | None = None,
    passwords: Passwords | None = None,
) -> Services:
    """Create all services over an existing data folder; nothing is started."""
    clock = clock or SystemClock()
    database = ServerDatabase(folder / FILE, clock)
    bus = EventBus()
    publish_diagnoses(bus)
    archive = FolderArchive(folder, database, clock)
    worker_pool = WorkerPool(folder)
    robot_worker_pool = WorkerPool.for_robots(folder)
    folders = FolderService(folder, database, bus, clock, robot_worker_pool)
    links = LinkServer(database, _hooks(bus, folders), clock)
    bus.on("command", lambda change: links.send_commands(change.robot))
    state = FleetState(database, archive, bus, links, folders, robot_worker_pool)
    feed = Feed(database, bus, clock, links, state)
    shelf = ExperimentShelf(folder, database, folders, clock)
    runner = ExperimentRunner(database, bus, clock, links, feed, shelf)
    upload_service = UploadService(
        folder,
        database,
        partial(_public_key, database),
        clock,
        verified=partial(_keep, archive, bus),
    )
    keeping = ArchiveMaintenance(folder, database, bus, clock, archive)
    services = Services(
        folder=folder,
        settings=settings,
        clock=clock,
        database=database,
        passwords=passwords or Passwords(),
        bus=bus,
        archive=archive,
        links=links,
        upload_service=upload_service,
        folders=folders,
        worker_pool=worker_pool,
        robot_worker_pool=robot_worker_pool,
        explained=Explained(database, archive, bus, clock, worker_pool, robot_worker_pool),
        jobs=DownloadService(folder, database, bus, clock),
        learning=LearningService(folder, database, bus, clock),
        following=FollowService(folder, database, bus, worker_pool),
        fetches=FetchService(folder, database, bus, clock, links),
        alarms=Alarms(database, bus, clock, settings.public_url),
        record_orders=RecordOrders(database, bus, clock),
        feed=feed,
        runner=runner,
        judge=RunJudge(database, bus, clock, runner.register, shelf, worker_pool),
        robot_runs=RobotRuns(OpenedStores(database, archive), bus, clock, shelf),
        system=SystemLevel(folder, bus, clock, links),
        keeping=keeping,
        revocation=SessionRevocation(database, bus, clock, links),
        threads=RequestThreads(),
    )
    services.judge.answer = partial(answer_diagnosis, services)
    return services


def parts(services: Services) -> Sequence[BackgroundService]:
    """Return the background services."""
    return (
        services.folders, services.worker_pool, services.explained, services.jobs,
        services.learning, services.following, services.fetches, services.alarms,
        services.record_orders, services.feed, services.runner, services.judge,
        services.robot_runs, services.system, services.keeping, services.revocation, Warming(),
    )  # fmt: skip


def close(services: Services) -> None:
    """Close all services, each before those that it needs."""
    for part in reversed(parts(services)):
        part.close()
    services.robot_worker_pool.close()
    services.links.close()
    services.threads.close()
    services.upload_service.close()
    services.passwords.close()
    services.database.close()


def _hooks(bus: EventBus, folders: FolderService) -> LinkHooks:
    return LinkHooks(
        rows=lambda robot, store, rows: bus.publish(
            ServerChange("rows", robot, {"store_id": store, "rows": rows})
        ),
        admitted=lambda hello, admission: bus.publish(
            ServerChange("connected", hello.robot, {"hello": hello, "admission": admission})
        ),
        gone=lambda robot: bus.publish(ServerChange("gone", robot)),
        live=lambda robot, values: bus.publish(ServerChange("live", robot, {"values": values})),
        has=lambda robot, store, has: bus.publish(
            ServerChange("has", robot, {"store_id": store, "id": has.id, "files": has.files})
        ),
        wants_folder=folders.wants,
        commands=lambda robot, ids: bus.publish(ServerChange("answered", robot, {"ids": ids})),
        lease=lambda robot, ids: bus.publish(ServerChange("lease", robot, {"ids": ids})),
    )


def _public_key(database: ServerDatabase, robot: str, store_id: str) -> str:
    """Return the signing key that a robot stated for a store; empty if unknown."""
    chosen = select(STORE.c.public_key).where(STORE.c.robot == robot, STORE.c.store_id == store_id)
    return str(database.scalar(chosen) or "")


def _keep(
    archive: FolderArchive,
    bus: EventBus,
    incoming: IncomingJournal,
    result: VerificationResult,
    path: Path,
) -> None:
    """Move a verified journal into the archive, and publish its state."""
    state = "aside"
    if path.is_relative_to(archive.layout.journals):
        key = JournalKey(incoming.robot, incoming.store_id, incoming.journal, incoming.sha256)
        archive.put(key, path, is_checked=result.signed)  # sealed and signed: all of it holds
        state = "verified"
    details = {"store_id": incoming.store_id, "journal": incoming.journal, "state": state}
    bus.publish(ServerChange("journal", incoming.robot, details))


# Time limit in seconds from connecting, or from a request's first byte, to the end of its headers
HEADERS_S = 10.0


class PatientProtocol(H11Protocol):
    """uvicorn's HTTP protocol with a time limit for request headers, which it lacks."""

    _waiting: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Start the timer for the first request."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Receive bytes; stop the timer once a request's headers are complete."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._stop_waiting()
        elif self._waiting is None and self.conn.trailing_data[0]:
            self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _wait(self) -> None:
        loop = asyncio.get_running_loop()
        self._waiting = loop.call_later(HEADERS_S, self._give_up)

    def _stop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _give_up(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()


class RefusingProtocol(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket protocol, without its log error for each refused handshake.

    uvicorn takes refusals for unfinished handshakes; robots that may not connect yet retry often.
    """

    async def send(self, message: Any) -> None:
        """Send a message; mark the handshake as complete after a complete refusal."""
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body"):
            self.handshake_complete = True


# Time limit in seconds for running requests when the server stops
GRACE_S = 3.0
_BYE_S = 1.0
_BACKLOG = 2048
_LOOK_S = 1.0
_FILES = 65_536
# A long limit for pongs: a pong waits behind data that is read late under load, and closing
# connections would add load. Links and the feed detect silence by themselves, and sooner.
_PONG_S = 90.0


@dataclass(frozen=True, slots=True)
class LifecycleHooks:
    """Callbacks of the process: when it answers requests, and when it ends."""

    ready: Callable[[int], None] = lambda port: None
    stopping: Callable[[], None] = lambda: None


def listen(settings: ServerSettings) -> socket.socket:
    """Open the listening socket; raises AmberboxError when the address cannot be used."""
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


async def serve(
    services: Services, port: socket.socket, hooks: LifecycleHooks | None = None
) -> None:
    """Serve until SIGTERM or Ctrl-C; then close links with Bye, and stop within seconds.

    Raises DatabaseDamagedError, after the same shutdown, when the database turns out damaged.
    """
    hooks, stop, notifier = hooks or LifecycleHooks(), asyncio.Event(), Notifier()
    app = wrapped(services)
    server = _Server(_config(app, services.settings))
    services.bus.attach(asyncio.get_running_loop())
    _listen_to_signals(stop, server)
    parts_ = start(parts(services))
    answering = asyncio.create_task(server.serve([port]))
    alive = asyncio.create_task(_stay_alive(server, notifier, services.links))
    stopping = asyncio.create_task(stop.wait())
    damaged = asyncio.create_task(_until_damaged(services.database))
    try:
        await _until_started(server, answering)
        gc.freeze()  # objects from the start stay: the collector need not scan them each time
        gc.enable()
        hooks.ready(int(port.getsockname()[1]))
        notifier.ready()
        ends = [answering, stopping, damaged]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    finally:
        hooks.stopping()
        notifier.stopping("ending connections")
        await send_goodbye(services.links)
        server.should_exit = True
        await asyncio.wait([answering])
        for worker_pool in (services.worker_pool, services.robot_worker_pool):
            worker_pool.close()  # threads waiting for a worker would delay the end of the loop
        for task in (alive, stopping, damaged):
            task.cancel()
        await end(parts_)
        app.close()
    if services.database.damage is not None:
        raise services.database.damage
    if not stop.is_set():
        answering.result()


async def _until_damaged(database: ServerDatabase) -> None:
    """Wait until damage of the database is detected."""
    while database.damage is None:
        await asyncio.sleep(_LOOK_S)


async def send_goodbye(links: LinkServer) -> None:
    """Send Bye to all robots, so that they reconnect soon, and close their sockets."""
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
    """Raise the soft limit of open files to what the system allows, at most ``_FILES``."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _FILES if hard == resource.RLIM_INFINITY else min(hard, _FILES)
    if soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


class _Server(uvicorn.Server):
    """uvicorn without its own signal handlers, since shutdown has a fixed order here."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to the process."""
        yield


def _config(app: ASGIApp, settings: ServerSettings) -> uvicorn.Config:
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
            server.force_exit = True  # second signal: do not wait for connections
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, end)


async def _until_started(server: uvicorn.Server, answering: asyncio.Task[None]) -> None:
    while not server.started and not answering.done():
        await asyncio.sleep(0.005)


async def _stay_alive(server: uvicorn.Server, notifier: Notifier, links: LinkServer) -> None:
    """Notify systemd every second that the event loop runs."""
    while True:
        notifier.alive(lambda: f"{len(links.robots)} robots connected")
        await asyncio.sleep(1.0)
