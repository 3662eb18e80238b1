"""The robot's agent: tells the server what is concluded, copies journals, and does what it asks."""

from __future__ import annotations

import asyncio
import ssl
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from amberbox.blackbox.folder.folder import RobotFolder
from amberbox.blackbox.service import Notifier
from amberbox.blackbox.store import Store
from amberbox.core.errors import AmberboxError
from amberbox.link.frames import Fetch
from amberbox.robot.folder.sending import send_folder
from amberbox.robot.link.client import Asked, LinkClient
from amberbox.robot.link.copying import Copier, HttpSending
from amberbox.robot.link.copyloop import CopyLoop
from amberbox.robot.link.copyrule import Situation
from amberbox.robot.link.docking import Dock
from amberbox.robot.link.fetching import Requests
from amberbox.robot.link.holdings import Holdings
from amberbox.robot.link.network import Network, allowed, current_network
from amberbox.robot.link.options import LinkOptions, options_of
from amberbox.robot.link.remarks import Remarks
from amberbox.robot.link.state import LinkState, write_state
from amberbox.robot.link.tls import context_for

_ALIVE_S = 1.0
_NETWORK_S = 5.0
_END_S = 2.0


@dataclass(slots=True)
class _Networks:
    """The network of now, asked for no more often than every few seconds; for any thread."""

    look: Callable[[], Network]
    _known: Network = field(default_factory=Network)
    _at_s: float = -1e9

    def __call__(self) -> Network:
        now_s = time.monotonic()
        if now_s - self._at_s >= _NETWORK_S:
            self._known, self._at_s = self.look(), now_s
        return self._known


class Agent:
    """One robot's link with all that belongs to it; ``run`` until ``stop`` is set.

    Raises UsageError when the folder names no server or holds no key.
    """

    def __init__(
        self,
        folder: RobotFolder,
        store: Store,
        *,
        notifier: Notifier | None = None,
        say: Callable[[str], None] = lambda text: None,
        network: Callable[[], Network] = current_network,
    ) -> None:
        self._folder, self._store, self._say = folder, store, say
        self._notifier = notifier or Notifier()
        self._network = _Networks(network)
        self.options = options_of(folder)
        self._remarks = Remarks(store)
        self._dock = Dock(store.path, self.options.docked)
        asked = Asked(self._fetch, self._want_folder)
        self.client = LinkClient(store, self.options, asked=asked, network=self._network)
        self._sending = HttpSending(self.options, self._context)
        copier = Copier(
            store, self.options, self._sending, self._situation, self.client.bucket,
            remarks=self._remarks,
        )  # fmt: skip
        self._holdings = Holdings(copier, self._contact)
        self._requests = Requests(
            store, self.client.answers.append, self.client.clock.wall_ns, copier.is_settled,
            self._holdings.may_lack,
        )  # fmt: skip
        self.loop = CopyLoop(
            copier, self._requests, self._send_folder, self._may_copy, self._holdings
        )
        self._wanted = threading.Event()
        self._said = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Link and copy until ``stop``; then send what is durable, and end."""
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
            self._end_copying()
            await asyncio.to_thread(copying.join, _END_S)
            self._tell()

    def state(self) -> LinkState:
        """Return how the link is doing."""
        progress = self.client.progress
        trouble = progress.trouble or self.loop.trouble or self._dock.problem
        return LinkState(
            self.options.url, progress.connected, trouble, progress.backlog,
            self.loop.copied, self.client.clock.wall_ns(),
        )  # fmt: skip

    async def _live(self) -> None:
        """Give signs of life from the loop that does the work, and say what has changed."""
        while True:
            self.client.progress.backlog_bytes = self.loop.copier.backlog_bytes
            self._tell()
            self._notifier.alive(lambda: self.state().in_words())
            await asyncio.sleep(_ALIVE_S)

    def _tell(self) -> None:
        state = self.state()
        write_state(self._store, state)
        words = state.short()
        if words != self._said:
            self._said = words
            self._say(words)

    def _end_copying(self) -> None:
        self.loop.copier.stop.set()
        self.loop.wake.set()

    # -- what the server asks

    def _fetch(self, frame: Fetch) -> None:
        self._holdings.look_again()
        self._requests.add(frame)
        self.loop.wake.set()

    def _want_folder(self, config_hash: str) -> None:
        if config_hash == self._folder.config_hash:
            self._wanted.set()
            self.loop.wake.set()

    # -- what the copying thread asks

    def _context(self) -> ssl.SSLContext | None:
        return context_for(self.options.url, self.options.ca, self._store.path)

    def _contact(self) -> int | None:
        """Number this connection; None while there is none."""
        progress = self.client.progress
        return progress.contacts if progress.connected else None

    def _may_copy(self) -> bool:
        return self.client.progress.connected and self._allowed(self.options)

    def _allowed(self, options: LinkOptions) -> bool:
        return allowed(self._network(), options.metered).copies

    def _situation(self) -> Situation:
        return Situation(self._dock.docked, self._network(), self._requests.journals)

    def _send_folder(self) -> None:
        if not self._wanted.is_set():
            return
        self._wanted.clear()
        try:
            send_folder(self._folder, self._sending)
        except AmberboxError as error:  # it will not go another time either
            self._remarks.say("folder_not_sent", error.what)
        except Exception:
            self._wanted.set()
            raise
