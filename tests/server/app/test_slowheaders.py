"""Clients that do not get to the end of their headers are not waited for."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from amberbox.server import process
from amberbox.server.process import PatientProtocol
from amberbox.testing.clock import PATIENCE_S

REQUEST = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"


async def hello(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer with nothing."""
    await send({"type": "http.response.start", "status": 204, "headers": []})
    await send({"type": "http.response.body", "body": b""})


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(process, "HEADERS_S", 0.3)
    config = uvicorn.Config(hello, port=0, http=PatientProtocol, log_config=None, lifespan="off",
                            timeout_keep_alive=5)  # fmt: skip
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()[1]
    server.should_exit = True
    thread.join(PATIENCE_S)


def wait_until_closed(connection: socket.socket) -> None:
    """Wait until the server closes the connection."""
    while connection.recv(1000):
        pass


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost:", b"G"])
def test_headers_that_do_not_come_end_the_connection(port: int, sent: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as connection:
        connection.sendall(sent)
        wait_until_closed(connection)


def test_a_request_in_pieces_is_answered_and_the_next_one_waited_for(port: int) -> None:
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as connection:
        connection.sendall(REQUEST[:10])
        connection.sendall(REQUEST[10:])
        assert connection.recv(1000).startswith(b"HTTP/1.1 204")
        time.sleep(0.5)  # longer than headers may take: nothing has begun
        connection.sendall(REQUEST)
        assert connection.recv(1000).startswith(b"HTTP/1.1 204")
        connection.sendall(REQUEST[:-2])
        wait_until_closed(connection)
