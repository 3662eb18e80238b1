"""The server under load: 100 robots with 20 statuses a second and 1 MB a minute of journals each.

``python -m benchmarks.fleet_load --robots 100 --minutes 10`` is the long form. The server is a real
``amberbox serve`` with its workers; robots and a listener of the feed are one process beside it.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from amberbox.core.clock import NS
from amberbox.link.client import LinkClient
from amberbox.server.process import raise_file_limit
from benchmarks.common import Row, percentile
from benchmarks.fleetload import making, robots
from benchmarks.fleetload.servers import Server
from benchmarks.run import table

ROBOTS, SECONDS, IDLE = 100, 16.0, 1000
_THREADS = 4
SETTLE_S = 120.0
"""How long what is left may take at the end before it counts as not keeping up."""


def measure() -> list[Row]:
    """Measure the short form."""
    raise_file_limit()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        place = Path(folder)
        rows = list(loaded(place / "load", ROBOTS, SECONDS, settle_s=0.0))
        rows += idle(place / "idle", IDLE, 8.0)
        rows += uploads(place / "uploads", files=2, megabytes=128)
        rows += caught_up(place / "away", hours=0.5)
    return rows


def loaded(
    folder: Path, count: int, seconds: float, *, tls: bool = False, settle_s: float = SETTLE_S
) -> Iterator[Row]:
    """Let robots do what they do all day."""
    file_s = min(60.0, seconds // 2)
    start_ns = time.time_ns() // NS * NS
    recording = making.make_recording(folder / "store", seconds, file_s, start_ns)
    names = [f"r{number}" for number in range(count)]
    with Server(folder / "server", names, tls) as server:
        heard, run = robots.Heard(), _Run(server, settle_s)
        fleet = [
            robots.Robot(name, server, recording, heard, server.context, number * file_s / count)
            for number, name in enumerate(names)
        ]
        left = asyncio.run(_live(fleet, seconds, run))
        how = f"{count} robots, {seconds:g} s{', TLS' if tls else ''}"
        yield from _report(server, heard, run, how, left)


class _Run:
    """What the server used from the moment that all robots were connected."""

    def __init__(self, server: Server, settle_s: float = 0.0) -> None:
        self._server = server
        self._settle_s = settle_s
        self.roles = ("server", "worker")

    def begin(self) -> None:
        """All are connected."""
        self._server.measure_now()
        self.began_s = time.monotonic()
        self.used = {role: self._server.cpu_s(role) for role in self.roles}

    def end(self) -> None:
        """The time is over; what is left is done now."""
        self._server.measure_now()
        self.lasted_s = time.monotonic() - self.began_s
        self.share = {
            role: (self._server.cpu_s(role) - self.used[role]) / self.lasted_s
            for role in self.roles
        }
        self.came, self.waiting = self._server.waiting()

    def settle(self) -> None:
        """Wait until every journal is in columns, for a while."""
        began_s = time.monotonic()
        while self._server.waiting()[1] and time.monotonic() - began_s < self._settle_s:
            time.sleep(0.5)
        self.left, self.settled_s = self._server.waiting()[1], time.monotonic() - began_s


async def _live(fleet: Sequence[robots.Robot], seconds: float, run: _Run) -> int:
    """Connect all, live; return how many frames of rows are not acknowledged at the end."""
    first = fleet[0]
    listening = asyncio.create_task(robots.listen(first.server, first.context, first.heard))
    await asyncio.gather(*(robot.greet() for robot in fleet))
    run.begin()
    with ThreadPoolExecutor(_THREADS) as threads:
        await asyncio.gather(*(robot.live(seconds, threads) for robot in fleet))
    run.end()
    left = sum(robot.waiting for robot in fleet)
    await asyncio.gather(*(robot.leave() for robot in fleet))
    listening.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await listening
    await asyncio.to_thread(run.settle)
    return left


def _report(server: Server, heard: robots.Heard, run: _Run, how: str, left: int) -> Iterator[Row]:
    assert not heard.refused, heard.refused[:3]
    yield Row("start of amberbox serve", server.start_s, "s", note="to be < 2")
    yield Row("status age, sent to the feed, p50", percentile(heard.ages_s, 50), "s", note=how)
    yield Row("status age, sent to the feed, p95", percentile(heard.ages_s, 95), "s",
              note="to be < 1")  # fmt: skip
    yield Row("rows acknowledged, p95", percentile(heard.acks_s, 95), "s")
    yield Row("frames not acknowledged at the end", left, "frames")
    yield Row("statuses not on the feed at the end", len(heard.sent_s), "rows")
    yield Row("journals verified", heard.copied, "journals", note=f"of {run.came} in the archive")
    yield Row("journals not in columns at the end", run.waiting, "journals",
              note=f"{run.left} after {run.settled_s:.0f} s more; a commit a minute")  # fmt: skip
    yield Row("server", 100 * run.share["server"], "% of a core", note=how)
    yield Row("workers", 100 * run.share["worker"], "% of a core", note="verify, commit")
    yield Row("memory of the server", server.memory_mb("server"), "MB")
    yield Row("memory of its workers", server.memory_mb("worker"), "MB")
    most, held = max(server.rows, default=0), server.rows[:: max(len(server.rows) // 8, 1)]
    note = f"{', '.join(f'{count}' for count in held)} as time went"
    yield Row("early rows in the database, most", most, "rows", note=note)
    grows = f"grows by {server.growth_mb_h():.0f} MB/h in the second half"
    yield Row("database", server.database_mb(), "MB", note=grows)
    yield Row("tables of the archive", server.archive_mb(), "MB")


def idle(folder: Path, count: int, seconds: float) -> Iterator[Row]:
    """Let many robots be connected that have nothing to say."""
    recording = making.make_recording(folder / "store", 1.0, 1.0, time.time_ns(), hz=0)
    names = [f"r{number}" for number in range(count)]
    with Server(folder / "server", names) as server:
        heard = robots.Heard()
        fleet = [robots.Robot(name, server, recording, heard, None) for name in names]
        took_s, share = asyncio.run(_be_there(fleet, seconds, _Run(server)))
        what = f"{count} robots connected"
        yield Row(f"{what}, how long that took", took_s, "s", note="all at once")
        yield Row(f"{what} and idle: server", 100 * share, "% of a core")
        yield Row(f"{what} and idle: memory", server.memory_mb("server"), "MB")


async def _be_there(
    fleet: Sequence[robots.Robot], seconds: float, run: _Run
) -> tuple[float, float]:
    began_s, enough = time.monotonic(), asyncio.Event()
    greeted = asyncio.Barrier(len(fleet) + 1)
    staying = [asyncio.create_task(robot.idle(greeted, enough)) for robot in fleet]
    await greeted.wait()
    took_s = time.monotonic() - began_s
    run.begin()
    await asyncio.sleep(seconds)
    enough.set()
    await asyncio.gather(*staying)
    run.end()
    await asyncio.gather(*(robot.leave() for robot in fleet))
    return took_s, run.share["server"]


def uploads(folder: Path, files: int, megabytes: int) -> Iterator[Row]:
    """Copy large journals over loopback, verification included."""
    recording = making.make_large(folder / "store", files, megabytes, time.time_ns() // NS * NS)
    with Server(folder / "server", ["r0", "r1"]) as server:
        fleet = [robots.Robot(n, server, recording, robots.Heard(), None) for n in server.names]
        asyncio.run(_known(fleet))
        fleet[1].copy(recording.sealed[0])  # the worker that verifies has started
        began_s = time.monotonic()
        for one in recording.sealed:
            assert fleet[0].copy(one).state == "verified"
        took_s = time.monotonic() - began_s
    size = recording.bytes / 1e6
    yield Row("journals of one robot copied and verified, loopback", size / took_s, "MB/s",
              note=f"{files} of {megabytes} MiB, one after the other; to be >= 100")  # fmt: skip


async def _known(fleet: Sequence[robots.Robot]) -> None:
    """Let the server hear with which key the robots sign."""
    for robot in fleet:
        await robot.greet()
        await robot.leave()


def caught_up(folder: Path, hours: float) -> Iterator[Row]:
    """Let a robot come back that was offline, with the robot's own agent for the link."""
    start_ns = time.time_ns() // NS * NS - round(hours * 3600) * NS
    recording = making.make_recording(folder / "store", hours * 3600, 600.0, start_ns)
    with Server(folder / "server", ["r0"]) as server:
        robot = robots.Robot("r0", server, recording, robots.Heard(), None)
        began_s = time.monotonic()
        asyncio.run(_told(LinkClient(recording.store, robot.options), recording.end_seq))
        rows_s = time.monotonic() - began_s
        for one in recording.sealed:
            assert robot.copy(one).state == "verified"
        all_s = time.monotonic() - began_s
    what = f"{hours:g} h offline of one robot"
    size = recording.bytes / 1e6
    yield Row(f"{what}: statuses on the server", rows_s, "s", note=f"{len(recording.rows)} rows")
    yield Row(f"{what}: journals, too", all_s, "s", note=f"{size:.0f} MB, one after the other")
    yield Row("rows of a backlog", len(recording.rows) / rows_s, "rows/s")


async def _told(client: LinkClient, end_seq: int) -> None:
    """Run the link until the server has acknowledged everything."""
    stop = asyncio.Event()
    task = asyncio.create_task(client.run(stop))
    await asyncio.sleep(0.5)
    while not client.progress.rows_sent or client.progress.backlog:
        assert not task.done(), client.progress.trouble
        await asyncio.sleep(0.1)
    stop.set()
    await task


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the long form."""
    parser = argparse.ArgumentParser(description="Measure the server under load.")
    parser.add_argument("--robots", type=int, default=ROBOTS)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--idle", type=int, default=IDLE, help="robots with nothing to say")
    parser.add_argument("--hours", type=float, default=8.0, help="offline")
    parser.add_argument("--tls", action="store_true", help="the load over TLS")
    parser.add_argument("--only", choices=("load", "idle", "uploads", "away"))
    asked = parser.parse_args(arguments)
    raise_file_limit()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        place = Path(folder)
        parts: dict[str, Callable[[], Iterator[Row]]] = {
            "load": lambda: loaded(place / "load", asked.robots, asked.minutes * 60, tls=asked.tls),
            "idle": lambda: idle(place / "idle", asked.idle, 60.0),
            "uploads": lambda: uploads(place / "uploads", files=8, megabytes=128),
            "away": lambda: caught_up(place / "away", asked.hours),
        }
        for name, part in parts.items():
            if asked.only in (None, name):
                print(table(list(part())), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
