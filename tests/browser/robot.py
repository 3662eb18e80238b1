"""Robots that are linked with a real store and the robot's own client, controlled by tests."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.store.derived_journal import DerivedJournal, EncodedRecord, event
from amberbox.blackbox.store.store import WriterLock, create_store
from amberbox.core.clock import NS
from amberbox.core.pacing import Backoff
from amberbox.core.types import Level, Output, Status
from amberbox.link.client import LinkClient
from amberbox.link.connection import LinkOptions
from amberbox.link.policy import Network
from amberbox.monitoring.current_state import read_heartbeat
from amberbox.monitoring.findings import Finding, HealthState, Transition, encoded, record_of
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.records import FakeItem, FakeRun

_REPEAT_S = 1.0
_END_S = PATIENCE_S
Row = tuple[str, bytes]


class Robot:
    """One robot: findings of its watcher are written to its journal, and sent over the link.

    While it is connected it repeats all its statuses each second, as watchers do.
    """

    def __init__(self, store: Path, clock: RobotClock, options: LinkOptions) -> None:
        self.name = options.robot
        self.clock = clock
        self.repeats = True
        """False for a robot whose link holds, while its watcher is silent."""
        self.statuses: dict[tuple[str, str], Status] = {}
        """The present status of each component and mode."""
        self._options = options
        self._store = create_store(store)
        self._lock = WriterLock(self._store, "watch")
        self._journal = DerivedJournal(
            self._store, "watch", robot=self.name, config_hash=options.config_hash, clock=clock
        )
        self._saying = threading.Lock()
        self._record: FakeRun | None = None
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = asyncio.Event()
        self._awake = threading.Event()

    # -- what it finds

    def status(
        self, component: str, level: Level = "ok", state: str = "", *, mode: str = "",
        reason: str = "", blocked_by: tuple[str, ...] = (), **outputs: Output,
    ) -> Status:  # fmt: skip
        """Set the status of a component (or one of its modes) from now on; return it."""
        now_ns = self.clock.wall_ns()
        found = Status(
            self.name, component, mode, level, state or ("nominal" if level == "ok" else level),
            outputs, blocked_by, now_ns, now_ns, reason, self._options.config_hash,
        )  # fmt: skip
        self.say(found)
        return found

    def change(
        self, component: str, level: Level, state: str = "", *, reason: str = "",
        blocked_by: tuple[str, ...] = (), hint: str = "",
    ) -> None:  # fmt: skip
        """Let a component go into another condition: the status, and the event of it."""
        old = self.statuses.get((component, ""))
        before = HealthState(old.level, old.state) if old else HealthState("ok", "nominal")
        new = self.status(component, level, state, reason=reason, blocked_by=blocked_by)
        self.say(Transition(
            self.name, component, "", before, HealthState(new.level, new.state), new.measured_ns,
            reason, blocked_by, hint, self._options.config_hash,
        ))  # fmt: skip

    def say(self, *found: Finding) -> None:
        """Write findings; statuses among them are valid from now on."""
        with self._saying:
            for one in found:
                if isinstance(one, Status):
                    self.statuses[one.component, one.mode] = one
            self._journal.write([record_of(one) for one in found])

    def tell(self, kind: str, text: str, source: str = "watch", **details: Any) -> None:
        """Write an event down."""
        self._journal.write([event(kind, text, source, **details)])

    def write(self, channel: str, values: Mapping[str, Any]) -> None:
        """Write a record of another channel down, such as a mission."""
        self._journal.write([(channel, values)])

    def repeat(self) -> None:
        """Repeat all statuses, measured now."""
        with self._saying:
            now_ns = self.clock.wall_ns()
            rows = [encoded(replace(s, measured_ns=now_ns)) for s in self.statuses.values()]
            self._journal.append([EncodedRecord(channel, data) for channel, data in rows])

    def measure(self, item: FakeItem, **values: Any) -> None:
        """Record a message now; it also updates the live values of its variables."""
        self._record = self._record or FakeRun(self._store.path, boot=self.clock.boot)
        now_ns = self.clock.wall_ns()
        self._record.write([(now_ns, item, msgspec.json.encode(values))])
        self._record.journal.publish_head(now_ns)

    # -- whether it is there

    def come(self) -> None:
        """Connect, and again whenever the connection breaks, until it leaves."""
        assert self._thread is None, "it is here already"
        started = threading.Event()
        self._awake.set()
        self._thread = threading.Thread(target=self._run, args=(started,), daemon=True)
        self._thread.start()
        assert started.wait(_END_S)

    def silence(self) -> None:
        """Freeze, as a computer does that hangs: the connection stays, nothing is sent."""
        assert self._loop is not None
        self._awake.clear()
        self._loop.call_soon_threadsafe(self._awake.wait)

    def wake(self) -> None:
        """Go on after a silence."""
        self._awake.set()

    def leave(self) -> None:
        """Disconnect cleanly; findings of the meantime are sent after ``come``."""
        if self._thread is None or self._loop is None:
            return
        self._awake.set()
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(_END_S)
        assert not self._thread.is_alive()
        self._thread = self._loop = None

    def close(self) -> None:
        """Disconnect permanently."""
        self.leave()
        self._journal.close()
        self._lock.release()
        if self._record is not None:
            self._record.close()

    def _run(self, started: threading.Event) -> None:
        asyncio.run(self._live(started))

    async def _live(self, started: threading.Event) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        started.set()
        client = LinkClient(
            self._store, self._options, clock=self.clock, network=lambda: Network("eth0"),
            monitoring=read_heartbeat, backoff=Backoff(least_s=0.05, most_s=0.3),
        )  # fmt: skip
        repeating = asyncio.create_task(self._repeat())
        await client.run(self._stop)
        repeating.cancel()

    async def _repeat(self) -> None:
        while True:
            began_s = time.monotonic()
            if self.repeats and self.statuses:
                await asyncio.to_thread(self.repeat)
            await asyncio.sleep(max(0.1, began_s + _REPEAT_S - time.monotonic()))


_UP_NS = 6 * 3600 * NS
"""How long the robot had been on when the tests began."""


@dataclass
class RobotClock:
    """Runs at real speed; ``ago_ns`` is how far in the past it is."""

    boot: str
    ago_ns: int = 0

    def wall_ns(self) -> int:
        return time.time_ns() - self.ago_ns

    def boot_ns(self) -> int:
        return time.monotonic_ns() + _UP_NS - self.ago_ns

    def boot_id(self) -> str:
        return self.boot

    def synchronised(self) -> bool | None:
        return True
