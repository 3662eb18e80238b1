"""The page of a robot in a real browser, and when values come there."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from amberbox.server.http.auth import COOKIE

if TYPE_CHECKING:
    from playwright.async_api import Page

WATCH = """(sent) => {
    window.late = []; window.shifted = 0
    const cells = document.querySelectorAll(`#tree [data-k$="/${sent}"] .val`)
    const note = (changes) => {
        const now = performance.timeOrigin + performance.now()
        for (const { target } of changes) window.late.push(now - Number(target.textContent) / 1000)
    }
    const what = { childList: true, characterData: true, subtree: true }
    for (const cell of cells) new MutationObserver(note).observe(cell, what)
    new PerformanceObserver((list) => {
        for (const one of list.getEntries()) window.shifted += one.value
    }).observe({ type: "layout-shift" })
    return cells.length
}"""
"""Notes from now on how late each value of an output comes that says when it was sent, in µs."""


@asynccontextmanager
async def opened(
    url: str, robot: str, session: str, branches: Sequence[str]
) -> AsyncIterator[Page]:
    """Open the page of a robot with some of its components open; its feed is live then."""
    from playwright.async_api import async_playwright

    query = urlencode([("open", name) for name in branches])
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        context = await browser.new_context(viewport={"width": 1440, "height": 900})
        await context.add_cookies([{"name": COOKIE, "value": session, "url": url}])
        page = await context.new_page()
        await page.goto(f"{url}/robots/{robot}?{query}")
        await page.locator("html[data-feed=live]").wait_for(state="attached")
        yield page
        await browser.close()
