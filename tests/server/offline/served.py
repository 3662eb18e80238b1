"""The upload desk behind real HTTP, as the server's routes do it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import uvicorn

from amberbox.link import uploads
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.uploads import PROOF_BYTES, Proof
from amberbox.server.ingest.uploads import IncomingJournal, UploadAnswer, UploadService, verdict
from amberbox.testing.clock import PATIENCE_S


def application(upload_service: UploadService) -> Any:
    """Make an ASGI application of an upload service; robots use the key ``key-<id>``."""

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        headers = {k.decode().lower(): v.decode() for k, v in scope["headers"]}
        body = await _body(receive, PROOF_BYTES if scope["method"] == "POST" else PIECE_BYTES)
        answer = await asyncio.to_thread(_ask, upload_service, scope, headers, body)
        content = msgspec.json.encode(verdict(answer)) if answer.status != 204 else b""
        if scope["method"] == "HEAD":
            content = b""
        about = [
            (uploads.OFFSET.lower().encode(), str(answer.offset).encode()),
            (uploads.STATE.lower().encode(), answer.state.encode()),
        ]
        if answer.status != 204:
            about.append((b"content-length", str(len(content)).encode()))
        await send({"type": "http.response.start", "status": answer.status, "headers": about})
        await send({"type": "http.response.body", "body": content})

    return app


async def _body(receive: Any, most: int) -> bytes:
    parts, size = [], 0
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return b""
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if not message.get("more_body") or size > most:
            return b"".join(parts)


def _ask(
    upload_service: UploadService, scope: Any, headers: dict[str, str], body: bytes
) -> UploadAnswer:
    robot, _, key = headers.get("authorization", "")[6:].partition(":")
    if key != f"key-{robot}":
        return UploadAnswer(401)
    store_id, _, journal = scope["path"].removeprefix("/link/v1/journals/").partition("/")
    size = int(headers.get(uploads.BYTES.lower(), "0"))
    incoming = IncomingJournal(
        robot, store_id, journal, headers.get(uploads.SHA256.lower(), ""), size
    )
    if scope["method"] == "HEAD":
        return upload_service.head(incoming)
    if scope["method"] == "PATCH":
        offset, crc = (int(headers.get(n.lower(), "-1")) for n in (uploads.OFFSET, uploads.CRC))
        return upload_service.patch(incoming, offset, body, crc)
    return upload_service.post(incoming, msgspec.json.decode(body, type=Proof))


@contextmanager
def served(upload_service: UploadService) -> Iterator[int]:
    """Serve a desk on loopback; give the port."""
    config = uvicorn.Config(
        application(upload_service), port=0, log_level="warning", lifespan="off"
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield server.servers[0].sockets[0].getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(PATIENCE_S)
        upload_service.close()
