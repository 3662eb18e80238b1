"""Pages in a browser: first plot and zoom over a million rows, weight and requests of each page."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import httpx

from amberbox.server import process
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.config import ServerSettings
from amberbox.server.http.auth import COOKIE
from benchmarks.archive import RATE_HZ, START_NS, make_month
from benchmarks.common import Row, free_port, percentile

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROWS = 1_000_000
_START_S = START_NS // 10**9
_PLOT = f"/robots/r1/data?v=drive.volts&from={_START_S}&to={_START_S + ROWS // RATE_HZ}"
PAGES = {
    "fleet": "/", "robot": "/robots/r1", "data": _PLOT, "diagnosis": "/robots/r1/diagnosis",
    "alarms": "/alarms", "recordings": "/recordings", "knowledge": "/knowledge",
}  # fmt: skip
"""What is weighed, by the name of the row."""

_REPEATS = 5
_ZOOMS = 12
_NOTED = """
window.drawn = [];
const note = () => drawn.push(performance.now());
document.addEventListener("plotdrawn", () => requestAnimationFrame(note));
document.addEventListener("mouseup", () => { window.let_go = performance.now(); }, true);
"""
_WEIGHED = """() => {
    const all = ["navigation", "resource"].flatMap((type) => performance.getEntriesByType(type));
    return [all.length, all.reduce((sum, one) => sum + one.transferSize, 0)];
}"""


def measure() -> list[Row]:
    """Measure pages with a month of one robot behind them."""
    from playwright.sync_api import sync_playwright

    found = shutil.which("chromium") or shutil.which("chromium-browser")
    with (
        tempfile.TemporaryDirectory() as folder,
        served(Path(folder)) as (url, secret),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        try:
            return [*_plots(browser, url, secret), *_weights(browser, url, secret)]
        finally:
            browser.close()


def _plots(browser: Browser, url: str, secret: str) -> Iterator[Row]:
    """Open the data page, drag over its plot, and go back, several times."""
    first: list[float] = []
    zooms: list[float] = []
    for number in range(_REPEATS + 1):
        page = _open(browser, url, secret, _PLOT)
        page.wait_for_function("() => drawn.length", timeout=60_000)
        if number:  # the first one of a server warms it up
            first.append(page.evaluate("() => drawn[0]"))
        if number == _REPEATS:
            page.wait_for_timeout(1000)
            zooms = [_zoom(page) for _ in range(_ZOOMS)]
        page.context.close()
    about = f"{ROWS:,} rows of one variable"
    yield Row(f"first plot of {about}, from navigation, median", percentile(first, 50), "ms",
              note="nothing cached in the browser; to be < 1000")  # fmt: skip
    yield Row(f"zoom into {about}, from letting go to drawn, median", percentile(zooms, 50), "ms",
              note="a new question for each; to be < 150")  # fmt: skip
    yield Row(f"zoom into {about}, p95", percentile(zooms, 95), "ms")


def _zoom(page: Page) -> float:
    """Drag over a tenth of the plot; milliseconds until the new rows are drawn. Then go back."""
    area = page.locator(".plot-canvas .u-over").first
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    assert box is not None
    page.evaluate("() => { drawn.length = 0; }")
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.4 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], y, steps=3)
    page.mouse.up()
    page.wait_for_function("() => drawn.length", timeout=60_000)
    took_ms: float = page.evaluate("() => drawn[0] - let_go")
    page.keyboard.press("Escape")
    area.dblclick()
    page.wait_for_timeout(700)
    return took_ms


def _weights(browser: Browser, url: str, secret: str) -> Iterator[Row]:
    """Count requests and bytes of each page, as they come to who has never been here."""
    for name, path in PAGES.items():
        page = _open(browser, url, secret, path)
        page.wait_for_load_state("networkidle")
        requests, size = page.evaluate(_WEIGHED)
        page.context.close()
        yield Row(f"page {name}, requests", requests, "", note="to be <= 15")
        yield Row(f"page {name}, weight", size / 1000, "kB", note="packed; to be <= 300")


def _open(browser: Browser, url: str, secret: str, path: str) -> Page:
    context = browser.new_context(base_url=url, viewport={"width": 1440, "height": 900})
    context.add_cookies([{"name": COOKIE, "value": secret, "url": url}])
    context.add_init_script(_NOTED)
    page = context.new_page()
    page.goto(path)
    return page


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, str]]:
    """Serve a month of a robot; yield the address and the session of an admin."""
    port = free_port()
    url = f"http://localhost:{port}"
    secret = _filled(folder, url)
    words = ("--data", str(folder), "--port", str(port), "--quiet")
    command = [sys.executable, "-m", "amberbox", "serve", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        _await(url, process)
        yield url, secret
    finally:
        process.terminate()
        process.wait()


def _filled(folder: Path, url: str) -> str:
    services = process.make_services(
        folder, ServerSettings(url), passwords=Passwords(HashCost(1, 8, 1))
    )
    make_month(services.archive)
    now_ns = time.time_ns()
    with services.database.begin() as connection:
        add_robot(connection, now_ns, "r1", ())
        hashed = services.passwords.hash("a long enough passphrase")
        add_user(connection, now_ns, "admin", Role.ADMIN, hashed)
        owner = find_user(connection, "admin")
        began = begin_session(connection, now_ns, owner.user_id, "127.0.0.1", "benchmark")
    process.close(services)
    return began.secret


def _await(url: str, process: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + 60
    while True:
        assert process.poll() is None, "the server ended"
        try:
            httpx.get(f"{url}/api/v1/health", timeout=5)
            break
        except httpx.TransportError:
            assert time.monotonic() < end_s, "the server does not answer"
            time.sleep(0.1)
    time.sleep(3)  # its workers are warm then
