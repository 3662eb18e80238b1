"""A robot's page in a browser while all robots change: how late it is, and what it costs there.

10 robots of 40 components say new values five times a second. The time is taken from when a frame
of a robot is durable on the server to when the page's DOM has the value.
"""

from __future__ import annotations

import asyncio
import math
import shutil
import socket
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import uvicorn

from amberbox.blackbox.journal import reserved
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.passwords import Cost, Passwords
from amberbox.fleet.accounts.robotkeys import add_robot
from amberbox.fleet.accounts.sessions import begin_session
from amberbox.fleet.accounts.users import add_user
from amberbox.fleet.api.who import COOKIE
from amberbox.fleet.bus import Change
from amberbox.fleet.linkend.server import Connected
from amberbox.fleet.linkend.tables import ROBOT, STATUS
from amberbox.fleet.services import Services
from amberbox.fleet.serving import assembly
from amberbox.fleet.serving.app import make_app
from amberbox.fleet.serving.settings import Settings
from amberbox.link.frames import Row as LinkRow
from amberbox.link.serverend import ServerEnd
from benchmarks.common import Row, percentile

if TYPE_CHECKING:
    from playwright.async_api import Page

ROBOTS, COMPONENTS, RATE_HZ = 10, 40, 5
RUN_S, WARM_S = 10.0, 2.0
_MOST_MS, _MOST_CORE = 100.0, 10.0
_SENT = "sent_us"
_WATCH = """() => {
    window.late = []; window.shifted = 0
    const cells = document.querySelectorAll('#tree [data-k$="/sent_us"] .val')
    const note = (changes) => {
        const now = performance.timeOrigin + performance.now()
        for (const { target } of changes) window.late.push(now - Number(target.textContent) / 1000)
    }
    for (const cell of cells) new MutationObserver(note).observe(cell, { childList: true })
    new PerformanceObserver((list) => {
        for (const one of list.getEntries()) window.shifted += one.value
    }).observe({ type: "layout-shift" })
    return cells.length
}"""


def measure() -> list[Row]:
    """Measure one page."""
    with tempfile.TemporaryDirectory() as folder:
        late, core, shifted = asyncio.run(_run(Path(folder)))
    what = f"{ROBOTS} x {COMPONENTS} components at {RATE_HZ} Hz, one robot's page open"
    return [
        Row("receipt to changed DOM, p95", percentile(late, 95), "ms",
            note=f"{what}; at most {_MOST_MS:g} ms"),
        Row("receipt to changed DOM, longest", max(late), "ms"),
        Row("changes written", len(late) / RUN_S, "per s"),
        Row("the browser's main thread", core * 100, "% of a core",
            note=f"at most {_MOST_CORE:g} %"),
        Row("layout shift", shifted, "", note="0: nothing moves"),
    ]  # fmt: skip


async def _run(folder: Path) -> tuple[list[float], float, float]:
    """Return latencies in ms, the share of a core that the page takes, and how much it moved."""
    port = _free_port()
    services = assembly.assemble(folder, Settings(f"http://localhost:{port}"), None,
                                 Passwords(Cost(1, 8, 1)))  # fmt: skip
    cookie = _fill(services)
    here = Connected("r0", _Nobody(), ServerEnd("r0"), time.time_ns(), heard_s=math.inf)
    services.links.robots["r0"] = here
    try:
        async with _served(services, port), _page(port, cookie) as page:
            speaking = asyncio.create_task(_speak(services))
            await asyncio.sleep(WARM_S)
            cells = await page.evaluate(_WATCH)
            assert cells == COMPONENTS, "the page does not show what changes"
            session = await page.context.new_cdp_session(page)
            await session.send("Performance.enable")
            began_s = await _busy_s(session)
            await asyncio.sleep(RUN_S)
            core = (await _busy_s(session) - began_s) / RUN_S
            late = await page.evaluate("() => window.late")
            shifted = await page.evaluate("() => window.shifted")
            speaking.cancel()
            return late, core, shifted
    finally:
        assembly.close(services)


class _Nobody:
    """The socket of a robot that is taken to be here."""

    async def receive(self) -> bytes:
        return b""

    async def send(self, data: bytes) -> None:
        return None

    async def close(self) -> None:
        return None


async def _busy_s(session: Any) -> float:
    """Return how long the page's main thread has worked."""
    found = await session.send("Performance.getMetrics")
    return next(float(one["value"]) for one in found["metrics"] if one["name"] == "TaskDuration")


def _fill(services: Services) -> str:
    """Add robots with their statuses, and somebody who looks; return the session's cookie."""
    now_ns = services.clock.wall_ns()
    with services.database.begin() as connection:
        for robot in range(ROBOTS):
            add_robot(connection, now_ns, f"r{robot}", ())
        connection.execute(ROBOT.insert(), [_presence(now_ns)])
        connection.execute(STATUS.insert(), [_shown(n, now_ns) for n in range(COMPONENTS)])
        hashed = services.passwords.hash("a long enough passphrase")
        person = add_user(connection, now_ns, "viewer", Role.VIEWER, hashed)
        return begin_session(connection, now_ns, person.user_id, "127.0.0.1", "bench").secret


def _presence(now_ns: int) -> dict[str, Any]:
    return {"robot": "r0", "epoch": 1, "store_id": "s", "boot_id": "b", "config_hash": "",
            "version": "", "connected": True, "connected_ns": now_ns, "last_seen_ns": now_ns,
            "backlog": 0, "backlog_bytes": 0}  # fmt: skip


def _shown(component: int, now_ns: int) -> dict[str, Any]:
    row = _row(component, 0)
    return {"robot": "r0", "component": f"c{component}", "mode": "checks", "level": "ok",
            "store_id": "s", "run": 1, "seq": 0, "log_ns": now_ns, "received_ns": now_ns,
            "data": row.data}  # fmt: skip


@asynccontextmanager
async def _served(services: Services, port: int) -> AsyncIterator[None]:
    config = uvicorn.Config(make_app(services), port=port, lifespan="off", log_level="critical",
                            ws="websockets-sansio", ws_per_message_deflate=False)  # fmt: skip
    server = uvicorn.Server(config)
    services.bus.attach(asyncio.get_running_loop())
    tasks = [asyncio.create_task(services.feed.run()), asyncio.create_task(server.serve())]
    while not server.started:
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.5)
    yield
    tasks[0].cancel()
    server.should_exit = True
    await asyncio.gather(*tasks, return_exceptions=True)


@asynccontextmanager
async def _page(port: int, cookie: str) -> AsyncIterator[Page]:
    """Open the page of a robot with all of its components open."""
    from playwright.async_api import async_playwright

    url = f"http://localhost:{port}"
    opened = "&".join(f"open=c{number}" for number in range(COMPONENTS))
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        context = await browser.new_context(viewport={"width": 1440, "height": 900})
        await context.add_cookies([{"name": COOKIE, "value": cookie, "url": url}])
        page = await context.new_page()
        await page.goto(f"{url}/robots/r0?{opened}")
        await page.locator("html[data-feed=live]").wait_for(state="attached")
        yield page
        await browser.close()


async def _speak(services: Services) -> None:
    """Let robots say all their statuses, each in a frame of its own, evenly over the time."""
    began_s, step = time.perf_counter(), 0
    while True:
        wait_s = began_s + step / (RATE_HZ * ROBOTS) - time.perf_counter()
        await asyncio.sleep(max(wait_s, 0.0))
        step += 1
        rows = [_row(component, step) for component in range(COMPONENTS)]
        told = {"store_id": "s", "rows": rows}
        services.bus.publish(Change("rows", f"r{step % ROBOTS}", told))


def _row(component: int, number: int) -> LinkRow:
    now_ns = time.time_ns()
    outputs = [{"name": "volts", "type": "float", "value": 20 + number % 80 / 8, "text": None},
               {"name": _SENT, "type": "int", "value": now_ns // 1000, "text": None},
               {"name": "working", "type": "bool", "value": 1, "text": None}]  # fmt: skip
    status = {"robot": "r", "component": f"c{component}", "mode": "checks", "level": "ok",
              "state": "nominal", "outputs": outputs, "blocked_by": [], "measured_ns": now_ns,
              "since_ns": now_ns, "reason": "", "config_hash": "", "live_only": False}  # fmt: skip
    seq = number * COMPONENTS + component
    return LinkRow("watch", 1, seq, reserved.STATUS, now_ns, msgspec.json.encode(status))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
