"""WebSockets that are refused with an HTTP answer: nothing went wrong there."""

from __future__ import annotations

from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol


class RefusingProtocol(WebSocketsSansIOProtocol):
    """uvicorn's WebSockets, which take every refusal for a handshake that was left undone.

    Robots that may not connect yet try again and again: each try would be an error in the log.
    """

    async def send(self, message: Any) -> None:
        """Send on; a refusal that is whole ends the handshake."""
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body"):
            self.handshake_complete = True
