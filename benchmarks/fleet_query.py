"""The server's API: ten minutes of one variable out of a month, asked over HTTP."""

from __future__ import annotations

import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import uvicorn

from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time
from amberbox.server import process
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import add_robot
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.app import make_app
from amberbox.server.config import ServerSettings
from amberbox.server.services.context import Services
from benchmarks.archive import DAYS, RATE_HZ, START_NS, make_month
from benchmarks.common import Row, percentile

_WINDOW_S = 600
_ASKED = 60
_PATH = "/api/v1/robots/r1"


def measure() -> list[Row]:
    """Measure a month of one robot behind the API."""
    with tempfile.TemporaryDirectory() as folder, _served(Path(folder)) as client:
        return list(_rows(client))


def _rows(client: httpx.Client) -> Iterator[Row]:
    starts = np.random.default_rng(2).integers(0, DAYS * 86_400 - _WINDOW_S, _ASKED).tolist()
    about = f"10 minutes of one variable out of {DAYS} days at {RATE_HZ} Hz, over HTTP"
    first = _ask(client, starts[0], format="plot")
    yield Row(f"{about}, first of a server", first, "ms", note="a worker starts, the catalogue too")
    _ask(client, starts[1], format="plot")  # the second worker
    for form, more in (("plot", {}), ("plot", {"points": "1000"}), ("arrow", {}), ("json", {})):
        taken = [_ask(client, start, format=form, **more) for start in starts]
        thinned = " thinned to 1,000" if more else ""
        note = "to be < 100" if form == "plot" else ""
        yield Row(f"{about}, as {form}{thinned}, p95", percentile(taken, 95), "ms", note=note)
    month = {"to": format_time(START_NS + DAYS * 86_400 * NS), "points": "1000"}
    taken = [_ask(client, 0, format="plot", **month) for _ in range(5)]
    yield Row(f"{DAYS} days of one variable in 1,000 steps, over HTTP", percentile(taken, 50), "ms")
    taken = [_timed(client, f"{_PATH}/statistics", _window(0, **month)) for _ in range(5)]
    yield Row(f"{DAYS} days of one variable summed up, over HTTP", percentile(taken, 50), "ms")


def _window(start_s: int, **more: str) -> dict[str, str]:
    from_ns = START_NS + start_s * NS
    to_ns = from_ns + _WINDOW_S * NS
    span = {"from": format_time(from_ns), "to": format_time(to_ns)}
    return {"item": "drive", "variables": "volts", **span, **more}


def _ask(client: httpx.Client, start_s: int, **more: str) -> float:
    return _timed(client, f"{_PATH}/query", _window(start_s, **more))


def _timed(client: httpx.Client, path: str, parameters: dict[str, str]) -> float:
    began = time.perf_counter()
    answer = client.get(path, params=parameters)
    took_ms = 1e3 * (time.perf_counter() - began)
    assert answer.status_code == 200, answer.text
    return took_ms


@contextmanager
def _served(folder: Path) -> Iterator[httpx.Client]:
    """Serve a month of a robot on loopback; the client is a program with a token."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        services = process.make_services(
            folder, ServerSettings(url), passwords=Passwords(HashCost(1, 8, 1))
        )
        make_month(services.archive)
        config = uvicorn.Config(make_app(services), log_level="warning", lifespan="off")
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        headers = {"Authorization": f"Bearer {_token(services)}"}
        try:
            with httpx.Client(base_url=url, headers=headers, timeout=60) as client:
                yield client
        finally:
            server.should_exit = True
            thread.join()
            process.close(services)


def _token(services: Services) -> str:
    with services.database.begin() as connection:
        now_ns = services.clock.wall_ns()
        add_robot(connection, now_ns, "r1", ())
        hashed = services.passwords.hash("a long enough passphrase")
        add_user(connection, now_ns, "viewer", Role.VIEWER, hashed)
        owner = find_user(connection, "viewer")
        return add_token(connection, now_ns, owner, "benchmark", ["read:data"]).text
