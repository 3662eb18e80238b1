"""The link process of the agent: sends conclusions, uploads journals, answers fetch requests.

The state of the link is in a small file of the store for ``doctor``, ``status`` and others.
"""

from __future__ import annotations

import asyncio
import json
import os
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from urllib.parse import urlsplit

from amberbox.agent.command_socket import SocketPort
from amberbox.agent.doctor.processes import LINK_STATE_FILE
from amberbox.agent.folder_upload import send_folder
from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.store.live_condition import LiveCondition
from amberbox.blackbox.store.store import Store
from amberbox.core.errors import AmberboxError
from amberbox.core.systemd import Notifier
from amberbox.link import limits
from amberbox.link.client import LinkClient, ServerRequestHandlers
from amberbox.link.connection import link_options, tls_context
from amberbox.link.frames import FetchFrame
from amberbox.link.policy import (
    CopySituation,
    Network,
    allowed_traffic,
    current_network,
)
from amberbox.link.record_reader import LinkEvents
from amberbox.link.uploader import (
    CopyLoop,
    FetchRequests,
    HoldingsCheck,
    HttpTransport,
    JournalCopier,
)
from amberbox.monitoring.current_state import read_heartbeat


@dataclass(frozen=True, slots=True)
class LinkState:
    """State of the connection, error and backlog; ``at_ns`` by the robot's clock."""

    server: str
    connected: bool
    trouble: str
    backlog: int
    copied: int
    at_ns: int
    unknown_frames: int = 0
    """Frames of the server that were ignored: this version does not know them."""

    def short(self) -> str:
        """Return a line on the connection."""
        host = urlsplit(self.server).netloc
        if self.connected:
            return f"linked to {host}{f'; {self.trouble}' if self.trouble else ''}"
        return f"no link to {host}{f': {self.trouble}' if self.trouble else ''}"

    def in_words(self) -> str:
        """Return a line on the connection, with its backlog."""
        waiting = (
            f"; the newest {self.backlog} records are not acknowledged yet" if self.backlog else ""
        )
        copied = f"; {self.copied} journals copied" if self.copied else ""
        return f"{self.short()}{waiting}{copied}"


def write_state(store: Store, state: LinkState) -> None:
    """Write the state file; it need not survive a power cut, so it is not synced."""
    part = store.path / f"{LINK_STATE_FILE}.part"
    with suppress(OSError):  # a full disk: readers see the age of the state
        part.write_text(json.dumps({**asdict(state), "pid": os.getpid()}))
        part.replace(store.path / LINK_STATE_FILE)


_ALIVE_S = 1.0
_NETWORK_S = 5.0
_END_S = 2.0


@dataclass(slots=True)
class _Networks:
    """Caches the current network for a few seconds; thread-safe."""

    look: Callable[[], Network]
    _known: Network = field(default_factory=Network)
    _at_s: float = -1e9

    def __call__(self) -> Network:
        now_s = time.monotonic()
        if now_s - self._at_s >= _NETWORK_S:
            self._known, self._at_s = self.look(), now_s
        return self._known


class LinkProcess:
    """One robot's link with all of its parts; ``run`` until ``stop`` is set.

    Raises UsageError when the folder names no server or holds no key.
    """

    def __init__(
        self,
        folder: RobotFolder,
        store: Store,
        *,
        notifier: Notifier | None = None,
        log: Callable[[str], None] = lambda text: None,
        network: Callable[[], Network] = current_network,
    ) -> None:
        self._folder, self._store, self._log = folder, store, log
        self._notifier = notifier or Notifier()
        self._network = _Networks(network)
        self.options = link_options(folder)
        self._link_events = LinkEvents(store)
        self._dock = LiveCondition(store.path, self.options.docked)
        asked = ServerRequestHandlers(self._fetch, self._want_folder)
        port = SocketPort(store.path)
        self.client = LinkClient(
            store, self.options, asked=asked, port=port, network=self._network,
            monitoring=read_heartbeat,
        )  # fmt: skip
        self._sending = HttpTransport(self.options, self._context)
        copier = JournalCopier(
            store, self.options, self._sending, self._situation, self.client.bucket,
            link_events=self._link_events,
        )  # fmt: skip
        self._holdings = HoldingsCheck(copier, self._contact)
        self._requests = FetchRequests(
            store, self.client.answers.append, self.client.clock.wall_ns, copier.is_settled,
            self._holdings.may_lack, lambda: self.client.left_out,
        )  # fmt: skip
        self.loop = CopyLoop(
            copier, self._requests, self._send_folder, self._may_copy, self._holdings
        )
        self._wanted = threading.Event()
        self._last_line = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Send and upload until ``stop``; then send the durable records, and end."""
        copying = threading.Thread(target=self.loop.run, name="link copy", daemon=True)
        copying.start()
        self._dock.start()
        alive = asyncio.create_task(self._live())
        self._notifier.ready()
        try:
            await self.client.run(stop)
        finally:
            alive.cancel()
            self._dock.close()
            self.loop.copier.stop.set()
            self.loop.wake.set()
            await asyncio.to_thread(copying.join, _END_S)
            self._publish_state()

    def state(self) -> LinkState:
        """Return the state of the link."""
        progress = self.client.progress
        trouble = progress.trouble or self.loop.trouble or self._dock.problem
        return LinkState(
            self.options.url, progress.connected, trouble, progress.backlog,
            self.loop.copied, self.client.clock.wall_ns(), progress.unknown_frames,
        )  # fmt: skip

    async def _live(self) -> None:
        """Notify the watchdog from the loop that does the work; publish changes of the state."""
        while True:
            self.client.progress.backlog_bytes = self.loop.copier.backlog_bytes
            self._publish_state()
            self._notifier.alive(lambda: self.state().in_words())
            await asyncio.sleep(_ALIVE_S)

    def _publish_state(self) -> None:
        state = self.state()
        write_state(self._store, state)
        words = state.short()
        if words != self._last_line:
            self._last_line = words
            self._log(words)

    # -- requests of the server

    def _fetch(self, frame: FetchFrame) -> None:
        self._holdings.look_again()
        self._requests.add(frame)
        self.loop.wake.set()

    def _want_folder(self, config_hash: str) -> None:
        if config_hash == self._folder.config_hash:
            self._wanted.set()
            self.loop.wake.set()

    # -- used by the copying thread

    def _context(self) -> ssl.SSLContext | None:
        return tls_context(self.options.url, self.options.ca, self._store.path)

    def _contact(self) -> int | None:
        """Return the number of this connection; None while there is none."""
        progress = self.client.progress
        return progress.contacts if progress.connected else None

    def _may_copy(self) -> bool:
        return (
            self.client.progress.connected
            and allowed_traffic(self._network(), self.options.metered).copies
        )

    def _situation(self) -> CopySituation:
        return CopySituation(
            self._dock.value, self._network(), self._requests.journals, self.client.left_out
        )

    def _send_folder(self) -> None:
        if not self._wanted.is_set():
            return
        self._wanted.clear()
        try:
            pictures = limits.PICTURES in self.client.server_can
            send_folder(self._folder, self._sending, pictures=pictures)
        except AmberboxError as error:  # retrying would fail as well
            self._link_events.emit("folder_not_sent", error.what)
        except Exception:
            self._wanted.set()
            raise
