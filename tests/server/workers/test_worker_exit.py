"""Work ends when the client has gone."""

from __future__ import annotations

import asyncio
from collections.abc import MutableMapping
from typing import Any

import pytest
from starlette.requests import Request

from amberbox.core.errors import UsageError
from amberbox.server.api.data import cancel_on_disconnect
from amberbox.server.workers.protocol import CancelledError


def _request(*, gone: bool) -> Request:
    async def receive() -> MutableMapping[str, Any]:
        if not gone:
            await asyncio.Event().wait()
        return {"type": "http.disconnect"}

    return Request({"type": "http", "method": "GET", "headers": []}, receive)


async def _work(seconds: float, ended: list[str]) -> str:
    try:
        await asyncio.sleep(seconds)
    except asyncio.CancelledError:
        ended.append("cancelled")
        raise
    return "done"


def test_work_is_done_for_who_waits() -> None:
    assert asyncio.run(cancel_on_disconnect(_request(gone=False), _work(0.3, []))) == "done"


def test_work_ends_when_nobody_waits() -> None:
    ended: list[str] = []
    with pytest.raises(CancelledError):
        asyncio.run(cancel_on_disconnect(_request(gone=True), _work(20, ended)))
    assert ended == ["cancelled"]


def test_what_work_raises_is_raised() -> None:
    async def fail() -> None:
        raise UsageError("no")

    with pytest.raises(UsageError):
        asyncio.run(cancel_on_disconnect(_request(gone=False), fail()))
