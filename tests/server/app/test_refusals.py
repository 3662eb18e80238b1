"""Sockets that are refused are no errors of the server."""

from __future__ import annotations

import asyncio
import logging
import socket

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from amberbox.server.middleware import refuse
from amberbox.server.process import RefusingProtocol


async def closed(scope: Scope, receive: Receive, send: Send) -> None:
    """Refuse everybody."""
    await refuse(scope, send, 503, "not set up yet")


async def _refused(port: socket.socket) -> tuple[int, bytes]:
    config = uvicorn.Config(closed, ws=RefusingProtocol, lifespan="off", log_config=None)
    server = uvicorn.Server(config)
    answering = asyncio.create_task(server.serve(sockets=[port]))
    try:
        with pytest.raises(InvalidStatus) as found:
            async with connect(f"ws://127.0.0.1:{port.getsockname()[1]}/"):
                pass
        return found.value.response.status_code, bytes(found.value.response.body)
    finally:
        server.should_exit = True
        await answering


def test_a_refusal_arrives_and_is_no_error(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as port, caplog.at_level(logging.WARNING):
        status, body = asyncio.run(_refused(port))
    assert status == 503 and b"not set up yet" in body
    assert not caplog.records
