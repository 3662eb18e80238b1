"""The feed: 20 people with open pages, 10 robots of 40 components that change at 5 Hz.

Half of them look at the fleet, the others at robots; a level changes every 10 s, which lets pages
fetch pieces. They are a process of their own. What they cost the server is its processor time with
them less its time without, before and after. The latency is from a robot's frame to the socket.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
import time
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec

from benchmarks.common import Row, free_port, percentile
from benchmarks.feedload import viewers
from benchmarks.feedload.fleet import CHANGE_S, LOAD, fill, speak
from benchmarks.feedload.serving import assembled, served

VIEWERS = 20
WITH_S, WITHOUT_S = 2 * CHANGE_S, CHANGE_S
_WARM_S = 2.0
_END_S = 10.0
_MOST_MS = 100.0
_MOST_CORE = 5.0


def measure() -> list[Row]:
    """Measure one server without listeners, with them, and without them again."""
    with tempfile.TemporaryDirectory() as folder:
        without, heard_share, heard = asyncio.run(_run(Path(folder)))
    alone = sum(without) / len(without)
    what = f"{VIEWERS // 2} pages of the fleet, {VIEWERS // 2} of robots; {LOAD}"
    return [
        Row(f"what {VIEWERS} viewers cost", (heard_share - alone) * 100, "% of a core",
            note=f"{what}, a level changes every {CHANGE_S:g} s; at most {_MOST_CORE:g} %"),
        Row("the feed without viewers", alone * 100, "% of a core",
            note=f"{LOAD}; {' and '.join(f'{share * 100:.1f}' for share in without)} %"),
        Row("receipt to socket, p95", percentile(heard.late_ms, 95), "ms",
            note=f"at most {_MOST_MS:g} ms"),
        Row("receipt to socket, longest", max(heard.late_ms), "ms"),
        Row("changes heard", len(heard.late_ms) / heard.seconds, "per s", note="by all together"),
        Row("sent to viewers", heard.bytes / heard.seconds / 1e3, "kB/s", note="by the feed"),
        Row("pieces fetched", heard.pieces / heard.seconds, "per s", note="by all together"),
    ]  # fmt: skip


async def _run(folder: Path) -> tuple[list[float], float, viewers.Heard]:
    """Return shares of a core without viewers and with them, and what those heard."""
    port = free_port()
    with assembled(folder, port) as services:
        sessions = fill(services)
        async with served(services, port):
            speaking = asyncio.create_task(speak(services))
            await asyncio.sleep(_WARM_S)
            before = await _share(WITHOUT_S)
            async with _viewers(port, sessions) as process:
                share = await _share(WITH_S)
                heard = await _heard(process)
            await asyncio.sleep(_WARM_S)
            after = await _share(WITHOUT_S)
            speaking.cancel()
    return [before, after], share, heard


async def _share(seconds: float) -> float:
    """Return the share of a core that this process takes from now on."""
    began_s, used_s = time.perf_counter(), time.process_time()
    await asyncio.sleep(seconds)
    return (time.process_time() - used_s) / (time.perf_counter() - began_s)


@asynccontextmanager
async def _viewers(port: int, sessions: Sequence[str]) -> AsyncIterator[Process]:
    """Let people look: from when each has its snapshot."""
    words = ("-m", viewers.__name__, f"http://localhost:{port}", str(VIEWERS), *sessions)
    process = await asyncio.create_subprocess_exec(sys.executable, *words, stdin=PIPE, stdout=PIPE)
    assert process.stdout is not None
    try:
        async with asyncio.timeout(viewers.START_S):
            said = await process.stdout.readline()
        if not said:
            raise RuntimeError("the viewers ended before they were ready: see above")
        await asyncio.sleep(_WARM_S)
        yield process
    except TimeoutError as error:
        raise RuntimeError("the viewers took too long to begin or to end") from error
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def _heard(process: Process) -> viewers.Heard:
    """End the viewers; return what they heard."""
    async with asyncio.timeout(_END_S):
        out, _ = await process.communicate(b"")
    if process.returncode:
        raise RuntimeError(f"the viewers ended with status {process.returncode}: see above")
    return msgspec.json.decode(out, type=viewers.Heard)
