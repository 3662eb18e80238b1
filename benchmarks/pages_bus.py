"""From a message on a robot's bus to a browser: a real robot, its link, a real server, a page.

A robot of 40 components records a bus on which a number goes up five times a second, watches it,
and is joined to a server; all of them are processes of their own, on one machine. The time is taken
from when a message is put on the bus to when the page's DOM shows its number. Robots say numbers
once a second where nothing else changes, and what else changes at once: so not all are shown.
"""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import httpx
import zmq
import zmq.asyncio

from amberbox.agent.join import with_server, write_key, write_robot_file
from amberbox.demo.fleet import start_tied
from amberbox.link.join_line import join_line
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import add_user
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.http.auth import COOKIE
from amberbox.server.start import make_folder
from benchmarks.common import Row, free_port, percentile
from benchmarks.feedload.browser import opened
from benchmarks.feedload.fleet import COMPONENTS, RATE_HZ

Shown: TypeAlias = tuple[str, int, float]
"""Component, number, and when the page showed it."""

ROBOT = "r0"
RUN_S, WARM_S = 15.0, 2.0
_START_S, _END_S, _LOOK_S = 40.0, 15.0, 0.2
_MOST_MS = 1000.0
_NAMES = [f"c{number}" for number in range(COMPONENTS)]
_ROBOT_YAML = f"id: {ROBOT}\nstore:\n  path: store\n  quota: 1 GB\n"
_BOX = "- zmq:\n    endpoint: {endpoint}\n    topics:\n      - topic: {{name: beat, type: json}}\n"
_COMPONENT = "component_name: {name}\nmodes:\n  - {name}/follows.yaml\n"
_MODE = """\
name: follows
monitor: expression
mappings:
  - mapping:
      inputs: []
      outputs:
        - output: {name: number, result: value, type: float}
arguments:
  number: zmq_beat.n
"""
_WATCH = """() => {
    window.shown = []
    const rows = document.querySelectorAll('#tree [data-k$="/number"]')
    const note = (row) => {
        const now = performance.timeOrigin + performance.now()
        const number = Number(row.querySelector(".val").textContent)
        window.shown.push([row.dataset.k.split("/")[0], number, now])
    }
    const what = { childList: true, characterData: true, subtree: true }
    for (const row of rows) new MutationObserver(() => note(row)).observe(row, what)
    return rows.length
}"""


def measure() -> list[Row]:
    """Measure one page of one robot."""
    with tempfile.TemporaryDirectory() as folder:
        shown, sent_ms = asyncio.run(_run(Path(folder)))
    if not shown:
        raise RuntimeError(f"nothing has changed on the page in {RUN_S:g} s: is the machine busy?")
    late = [at_ms - sent_ms[number] for _, number, at_ms in shown]
    every = [ms for name in _NAMES for ms in _late_ms(shown, name, sent_ms)]
    what = f"{COMPONENTS} components at {RATE_HZ} Hz; recorder, watcher, link, server, browser"
    return [
        Row("bus to changed DOM, median", percentile(late, 50), "ms", note=what),
        Row("bus to changed DOM, p95", percentile(late, 95), "ms",
            note=f"of what robots say: numbers alone once a second; at most {_MOST_MS:g} ms"),
        Row("bus to changed DOM, longest", max(late), "ms"),
        Row("each number on the bus, until it or a newer one is shown, median",
            percentile(every, 50), "ms"),
        Row("each number on the bus, until it or a newer one is shown, p95",
            percentile(every, 95), "ms", note="with the wait of up to 1 s until it is said"),
    ]  # fmt: skip


async def _run(folder: Path) -> tuple[list[Shown], dict[int, float]]:
    """Return what was shown when, and when each number was sent, both in ms since 1970."""
    port, bus = free_port(), free_port()
    url = f"http://localhost:{port}"
    session = _prepare(folder, url, f"tcp://127.0.0.1:{bus}")
    sent_ms: dict[int, float] = {}
    with _running(folder, port):
        talking = asyncio.create_task(_talk(f"tcp://127.0.0.1:{bus}", sent_ms))
        await _until_known(url, session)
        async with opened(url, ROBOT, session, _NAMES) as page:
            await asyncio.sleep(WARM_S)
            cells = await page.evaluate(_WATCH)
            assert cells == len(_NAMES), "the page does not show what changes"
            await asyncio.sleep(RUN_S)
            shown = await page.evaluate("() => window.shown")
        talking.cancel()
    return shown, sent_ms


def _late_ms(shown: Sequence[Shown], name: str, sent_ms: Mapping[int, float]) -> Iterator[float]:
    """Yield for each number how late a component showed it or a newer one, in ms."""
    mine = [(number, at_ms) for of, number, at_ms in shown if of == name]
    for (before, _), (number, at_ms) in pairwise(mine):
        yield from (at_ms - sent_ms[n] for n in range(before + 1, number + 1))


async def _talk(endpoint: str, sent_ms: dict[int, float]) -> None:
    """Let numbers go up on the bus, and note when each was sent (at most 4 digits are shown)."""
    with zmq.asyncio.Context() as context, context.socket(zmq.PUB) as socket:
        socket.linger = 0
        socket.bind(endpoint)
        began_s = time.monotonic()
        for number in range(1, 10_000):
            await asyncio.sleep(max(0.0, began_s + number / RATE_HZ - time.monotonic()))
            sent_ms[number] = time.time_ns() / 1e6
            await socket.send_multipart([b"beat", b'{"n": %d}' % number])


def _prepare(folder: Path, url: str, endpoint: str) -> str:
    """Write the folders of a server and of a robot that has joined it; return a session."""
    data, robot = folder / "server", folder / ROBOT
    make_folder(data)
    database, now_ns = ServerDatabase(data / FILE), time.time_ns()
    with database.begin() as connection:
        key = add_robot(connection, now_ns, ROBOT, ())
        person = add_user(connection, now_ns, "admin", Role.ADMIN, "-")
        session = begin_session(connection, now_ns, person.user_id, "127.0.0.1", "bench")
    database.close()
    line = join_line(url, ROBOT, key.text)
    _write_robot(robot, _BOX.format(endpoint=endpoint))
    write_key(robot, line.key)
    write_robot_file(robot, with_server(_ROBOT_YAML, {"url": line.url}))
    return session.secret


def _write_robot(folder: Path, box: str) -> None:
    texts: Mapping[str, str] = {
        "black_box.yaml": box,
        **{f"components/{name}.yaml": _COMPONENT.format(name=name) for name in _NAMES},
        **{f"components/{name}/follows.yaml": _MODE for name in _NAMES},
    }
    for path, text in texts.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)


@contextmanager
def _running(folder: Path, port: int) -> Iterator[None]:
    """Run server and robot; what they say goes to a file that is shown when they fail."""
    words = ("--data", str(folder / "server"), "--port", str(port), "--quiet")
    with (folder / "log").open("wb") as log:
        both = [start_tied(("amberbox", "serve", *words), output=log),
                start_tied(("amberbox", "run", str(folder / ROBOT)), output=log)]  # fmt: skip
        try:
            yield
        except Exception:
            print((folder / "log").read_text()[-4000:], file=sys.stderr)
            raise
        finally:
            for process in both:
                process.send_signal(signal.SIGTERM)
            for process in both:
                _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


async def _until_known(url: str, session: str) -> None:
    """Wait until the server shows a number of each component of the robot."""
    end_s = time.monotonic() + _START_S
    headers = {"Cookie": f"{COOKIE}={session}"}
    async with httpx.AsyncClient(base_url=url, headers=headers) as client:
        while not await _is_known(client):
            if time.monotonic() > end_s:
                raise RuntimeError(f"the robot was not there after {_START_S:g} s: see above")
            await asyncio.sleep(_LOOK_S)


async def _is_known(client: httpx.AsyncClient) -> bool:
    try:
        answer = await client.get(f"/api/v1/robots/{ROBOT}/status")
    except httpx.HTTPError:
        return False
    if answer.status_code != httpx.codes.OK:
        return False
    outputs = [
        output
        for component in answer.json()["components"]
        for mode in component["modes"]
        for output in mode["outputs"]
    ]
    numbers = [one["value"] for one in outputs if one["name"] == "number"]
    return len(numbers) == len(_NAMES) and None not in numbers
