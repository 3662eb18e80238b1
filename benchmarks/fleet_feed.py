"""The feed: 20 listeners at 10 robots of 40 components whose outputs change five times a second.

The listeners are a process of their own. What they cost the server is its processor time with
them less its time without; the latency is from the bus to the listener's socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import uvicorn
from websockets.asyncio.client import connect

from amberbox.blackbox.journal import reserved
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.passwords import Cost, Passwords
from amberbox.fleet.accounts.robotkeys import add_robot
from amberbox.fleet.accounts.tokens import add_token
from amberbox.fleet.accounts.users import add_user
from amberbox.fleet.bus import Change
from amberbox.fleet.services import Services
from amberbox.fleet.serving import assembly
from amberbox.fleet.serving.app import make_app
from amberbox.fleet.serving.settings import Settings
from amberbox.link.frames import Row as LinkRow
from benchmarks.common import Row, percentile

LISTENERS, ROBOTS, COMPONENTS, RATE_HZ = 20, 10, 40, 5
RUN_S = 15.0
_PEOPLE = 4
_MOST_MS = 100.0
_MOST_CORE = 5.0


def measure() -> list[Row]:
    """Measure the server without listeners, then with them."""
    with tempfile.TemporaryDirectory() as folder:
        alone, _ = asyncio.run(_run(Path(folder), 0))
    with tempfile.TemporaryDirectory() as folder:
        heard, latencies = asyncio.run(_run(Path(folder), LISTENERS))
    what = f"{LISTENERS} listeners, {ROBOTS} x {COMPONENTS} components at {RATE_HZ} Hz"
    more = (heard - alone) * 100
    late = percentile(latencies, 95)
    return [
        Row("what listeners cost", more, "% of a core", note=f"{what}; at most {_MOST_CORE:g} %"),
        Row("the feed without listeners", alone * 100, "% of a core", note=what),
        Row("bus to socket, p95", late, "ms", note=f"at most {_MOST_MS:g} ms"),
        Row("bus to socket, longest", max(latencies), "ms"),
        Row("changes heard", len(latencies) / RUN_S / LISTENERS, "per s and listener"),
    ]


async def _run(folder: Path, listeners: int) -> tuple[float, list[float]]:
    """Return the share of a core that the server took, and latencies in ms."""
    services = assembly.assemble(folder, Settings("http://127.0.0.1"), None,
                                 Passwords(Cost(1, 8, 1)))  # fmt: skip
    tokens = _people(services)
    try:
        async with _served(services) as port:
            process = await _listen(port, tokens, listeners) if listeners else None
            began_s, used_s = time.perf_counter(), time.process_time()
            await _speak(services)
            share = (time.process_time() - used_s) / (time.perf_counter() - began_s)
            if process is None:
                return share, [0.0]
            out, _ = await process.communicate()
            return share, json.loads(out)
    finally:
        assembly.close(services)


def _people(services: Services) -> list[str]:
    with services.database.begin() as connection:
        now_ns = services.clock.wall_ns()
        for robot in range(ROBOTS):
            add_robot(connection, now_ns, f"r{robot}", ())
        hashed = services.passwords.hash("a long enough passphrase")
        people = [
            add_user(connection, now_ns, f"p{number}", Role.TECHNICIAN, hashed)
            for number in range(_PEOPLE)
        ]
        return [
            add_token(connection, now_ns, person, "bench", ["read:status"]).text
            for person in people
        ]


@contextlib.asynccontextmanager
async def _served(services: Services) -> AsyncIterator[int]:
    config = uvicorn.Config(make_app(services), port=0, lifespan="off", log_level="critical",
                            ws="websockets-sansio", ws_per_message_deflate=False)  # fmt: skip
    server = uvicorn.Server(config)
    services.bus.attach(asyncio.get_running_loop())
    tasks = [asyncio.create_task(services.feed.run()), asyncio.create_task(server.serve())]
    while not server.started:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.5)
    yield server.servers[0].sockets[0].getsockname()[1]
    tasks[0].cancel()
    server.should_exit = True
    await asyncio.gather(*tasks, return_exceptions=True)


async def _speak(services: Services) -> None:
    """Let robots say all their statuses, each in a frame of its own, evenly over the time."""
    began_s = time.perf_counter()
    for step in range(round(RUN_S * RATE_HZ * ROBOTS)):
        wait_s = began_s + step / (RATE_HZ * ROBOTS) - time.perf_counter()
        await asyncio.sleep(max(wait_s, 0.0))
        robot, number = f"r{step % ROBOTS}", step // ROBOTS
        rows = [_row(component, number) for component in range(COMPONENTS)]
        told = {"store_id": "s", "rows": rows}
        services.bus.publish(Change("rows", robot, told))


def _row(component: int, number: int) -> LinkRow:
    outputs = [{"name": "volts", "type": "float", "value": number / 8, "text": None},
               {"name": "sent", "type": "int", "value": time.monotonic_ns(), "text": None},
               {"name": "working", "type": "bool", "value": 1, "text": None}]  # fmt: skip
    status = {"robot": "r", "component": f"c{component}", "mode": "", "level": "ok",
              "state": "nominal", "outputs": outputs, "blocked_by": [], "measured_ns": 10**18,
              "since_ns": 10**18, "reason": "", "config_hash": "", "live_only": False}  # fmt: skip
    seq = number * COMPONENTS + component
    return LinkRow("watch", 1, seq, reserved.STATUS, 10**18, msgspec.json.encode(status))


async def _listen(port: int, tokens: list[str], count: int) -> asyncio.subprocess.Process:
    """Start the listeners; they are ready when each has its snapshot."""
    command = [sys.executable, "-m", "benchmarks.fleet_feed", str(port), str(count), *tokens]
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE,
                                                   stderr=asyncio.subprocess.PIPE)  # fmt: skip
    assert process.stderr is not None
    await process.stderr.readline()
    return process


async def _hear(port: int, token: str, ready: asyncio.Barrier, late: list[float]) -> None:
    headers = {"Authorization": f"Bearer {token}"}
    address = f"ws://127.0.0.1:{port}/api/v1/feed"
    async with connect(address, additional_headers=headers, max_size=None, compression=None) as it:
        await it.send("{}")
        await it.recv()
        await ready.wait()
        with contextlib.suppress(TimeoutError):
            while True:
                text = await asyncio.wait_for(it.recv(), 2.0)
                now_ns = time.monotonic_ns()
                for message in json.loads(text):
                    if message["kind"] == "status":
                        sent_ns = message["data"][-1]["outputs"]["sent"]
                        late.append((now_ns - sent_ns) / 1e6)


async def _all_hear(port: int, count: int, tokens: list[str]) -> None:
    late: list[float] = []
    ready = asyncio.Barrier(count + 1)
    tasks = [
        asyncio.create_task(_hear(port, tokens[n % len(tokens)], ready, late)) for n in range(count)
    ]
    await ready.wait()
    print("ready", file=sys.stderr, flush=True)
    await asyncio.gather(*tasks)
    print(json.dumps(late))


if __name__ == "__main__":
    asyncio.run(_all_hear(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]))
