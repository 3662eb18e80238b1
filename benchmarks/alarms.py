"""Alarms of the server: how many sound robots raise, and how long a storm of them takes.

Simulated robots are watched and diagnosed as on a robot; what their watchers write is what the
server hears. ``BENCH_ALARM_HOURS`` says for how many hours of robots without a fault.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from sqlalchemy import select

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.link.frames import Hello
from amberbox.link.frames import LinkRow as LinkRow
from amberbox.monitoring.findings import AlarmChange, encoded, instant_of
from amberbox.server.accounts.robots import add_robot
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.alarms.manager import Alarms
from amberbox.server.alarms.recipients import NAME, Notifications, Webhook
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.ingest import ledger
from amberbox.server.schema import ALARM, OUTBOX
from amberbox.server.settings import write
from amberbox.sim.robot import START_NS
from amberbox.testing.clock import ManualClock
from benchmarks.common import Row
from benchmarks.diagnosis import FIRST_SEED, findings
from benchmarks.missions import Mission, nominal

HOURS = float(os.environ.get("BENCH_ALARM_HOURS", "0.5"))
CHUNK_H = 0.25
STORM = 200
_STORE = "12345678-1234-1234-1234-123456789012"
_CHANNELS = (channels.ALARM, channels.DIAGNOSIS, channels.EVENT)


@dataclass(frozen=True, slots=True)
class Heard:
    """What a watcher wrote, and when."""

    at_ns: int
    channel: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the server made of it."""

    alarms: list[Alarm]
    messages: int
    seconds: float


def measure() -> list[Row]:
    """Watch robots without a fault, and hear of a storm."""
    chunks = max(1, round(HOURS / CHUNK_H))
    with get_context("spawn").Pool(min(2, os.cpu_count() or 1)) as pool:
        told = pool.map(_nominal, range(chunks), chunksize=1)
    calm = played(told)
    storm = played([_storm(number) for number in range(STORM)])
    over = f"in {chunks * CHUNK_H:g} h"
    return [
        Row("alarms of sound robots", len(calm.alarms), "", note=f"{over}; to be <= 1 in 20 h"),
        Row("messages about sound robots", calm.messages, "", note=over),
        Row(f"{STORM} robots with an alarm each at once", storm.seconds, "s",
            note=f"{len(storm.alarms)} alarms, {storm.messages} messages in the outbox"),
    ]  # fmt: skip


def _nominal(number: int) -> list[Heard]:
    return list(written(nominal(FIRST_SEED + number, CHUNK_H * 3600.0)))


def written(mission: Mission) -> Iterator[Heard]:
    """Yield what the watcher of a robot writes in a mission and alarms are made of."""
    for found in findings(mission):
        channel, data = encoded(found)
        if channel in _CHANNELS:
            yield Heard(instant_of(found), channel, data)


def _storm(number: int) -> list[Heard]:
    at_ns = START_NS + 60 * NS
    told = AlarmChange(
        f"robot_{number}", "laser-1", "laser", "urgent", "open", "error", "it does not work",
        at_ns, at_ns, 1, "", None, "hash",
    )  # fmt: skip
    return [Heard(at_ns, *encoded(told))]


def played(told: Sequence[Sequence[Heard]]) -> Outcome:
    """Let a server hear what the watchers of robots wrote, each at its time, and 10 min more."""
    with tempfile.TemporaryDirectory() as place:
        clock = ManualClock(START_NS)
        database = ServerDatabase(Path(place) / FILE, clock)
        bus = EventBus()
        alarms = Alarms(database, bus, clock)
        try:
            _settle(database, clock, bus, len(told))
            alarms.step()
            seconds = _play(alarms, bus, clock, told)
            with database.reading() as connection:
                found = AlarmRegister(connection).alarms(ALARM.c.merged_into.is_(None))
                messages = len(connection.execute(select(OUTBOX.c.number)).all())
        finally:
            alarms.close()
            database.close()
    return Outcome(found, messages, seconds)


def _settle(database: ServerDatabase, clock: ManualClock, bus: EventBus, robots: int) -> None:
    """Make robots known and let them connect; somebody wants to hear of everything."""
    hook = Webhook("hook", "https://hook.example/", "0123456789abcdef")
    with database.begin() as connection:
        write(connection, clock.wall_ns(), NAME, Notifications(webhooks=(hook,)))
        for number in range(robots):
            add_robot(connection, clock.wall_ns(), f"robot_{number}", [])
    for number in range(robots):
        hello = Hello(f"robot_{number}", _STORE, "b1", {}, "h", clock.wall_ns(), 0, "1")
        with database.begin() as connection:
            admission = ledger.admit(connection, hello, clock.wall_ns())
        bus.publish(
            ServerChange("connected", hello.robot, {"hello": hello, "admission": admission})
        )


def _play(
    alarms: Alarms, bus: EventBus, clock: ManualClock, told: Sequence[Sequence[Heard]]
) -> float:
    """Return for how long the server was at it."""
    entries = sorted(
        ((one.at_ns, robot, seq, one) for robot, some in enumerate(told)
         for seq, one in enumerate(some)), key=lambda entry: entry[:3],
    )  # fmt: skip
    publish = partial(_publish, bus)
    start_s, now_ns = time.perf_counter(), START_NS
    last_ns = entries[-1][0] if entries else START_NS
    while now_ns < last_ns + 600 * NS:
        now_ns = min(entries[0][0], now_ns + 10 * NS) if entries else now_ns + 10 * NS
        clock.advance(max(0, now_ns - clock.wall_ns()) / NS)
        while entries and entries[0][0] <= now_ns:
            _, robot, seq, one = entries.pop(0)
            publish(f"robot_{robot}", LinkRow("watch", 1, seq, one.channel, one.at_ns, one.data))
        alarms.step()
    return time.perf_counter() - start_s


def _publish(bus: EventBus, robot: str, row: LinkRow) -> None:
    bus.publish(ServerChange("rows", robot, {"store_id": _STORE, "rows": [row]}))
