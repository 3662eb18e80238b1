"""A robot's page in a browser while all robots change: how late it is, and what it costs there.

10 robots of 40 components say new values five times a second; a level changes every 10 s. The time
is taken from when a frame of a robot is durable on the server to when the page's DOM has the value.
"""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import Row, free_port, percentile
from benchmarks.feedload.browser import WATCH, opened
from benchmarks.feedload.fleet import COMPONENTS, LOAD, SENT, fill, speak
from benchmarks.feedload.serving import assembled, served

RUN_S, WARM_S = 10.0, 2.0
_MOST_MS, _MOST_CORE = 100.0, 10.0
_PARTS = {"ScriptDuration": "scripts", "LayoutDuration": "layout", "RecalcStyleDuration": "styles"}


def measure() -> list[Row]:
    """Measure one page."""
    with tempfile.TemporaryDirectory() as folder:
        late, core, shifted = asyncio.run(_run(Path(folder)))
    what = f"{LOAD}, one robot's page with all of its branches open"
    parts = ", ".join(f"{word} {core[name] * 100:.1f} %" for name, word in _PARTS.items())
    return [
        Row("receipt to changed DOM, p95", percentile(late, 95), "ms",
            note=f"{what}; at most {_MOST_MS:g} ms"),
        Row("receipt to changed DOM, longest", max(late), "ms"),
        Row("changes written", len(late) / RUN_S, "per s"),
        Row("the browser's main thread", core["TaskDuration"] * 100, "% of a core",
            note=f"its processor time: {parts}, the rest painting; at most {_MOST_CORE:g} %"),
        Row("layout shift", shifted, "", note="0: nothing moves"),
    ]  # fmt: skip


async def _run(folder: Path) -> tuple[list[float], dict[str, float], float]:
    """Return latencies in ms, shares of a core that the page takes, and how much it moved."""
    port = free_port()
    branches = [f"c{number}" for number in range(COMPONENTS)]
    with assembled(folder, port) as services:
        session = fill(services)[0]
        url = f"http://localhost:{port}"
        async with served(services, port), opened(url, "r0", session, branches) as page:
            speaking = asyncio.create_task(speak(services))
            await asyncio.sleep(WARM_S)
            cells = await page.evaluate(WATCH, SENT)
            assert cells == COMPONENTS, "the page does not show what changes"
            # processor time, not how long tasks took while others had the processor
            cdp = await page.context.new_cdp_session(page)
            await cdp.send("Performance.enable", {"timeDomain": "threadTicks"})
            before = await _used_s(cdp)
            await asyncio.sleep(RUN_S)
            after = await _used_s(cdp)
            late, shifted = await page.evaluate("() => [window.late, window.shifted]")
            speaking.cancel()
    return late, {name: (after[name] - before[name]) / RUN_S for name in after}, shifted


async def _used_s(cdp: Any) -> dict[str, float]:
    """Return how long the page's main thread has worked, in all and at what."""
    found = await cdp.send("Performance.getMetrics")
    return {
        one["name"]: float(one["value"])
        for one in found["metrics"]
        if one["name"] in ("TaskDuration", *_PARTS)
    }
