"""The socket on which the simulated robot takes requests: ZeroMQ, JSON, one answer for each.

A ROUTER, so that a stop is answered while another request waits for the end of its motion; a client
uses a plain REQ socket. It is served between two ticks of the robot, in the robot's own thread.
"""

from __future__ import annotations

from typing import Any

import msgspec

from amberbox.core.errors import AmberboxError
from amberbox.sim.requests import MAX_REQUEST_BYTES, RobotRequest, decode_request
from amberbox.sim.robot import Robot

_MAX_FRAME_BYTES = 16 * MAX_REQUEST_BYTES  # a longer one costs the sender its connection
_MOST_AT_ONCE = 100  # so that a flood of requests does not stop the robot's time


class CommandSocket:
    """Answers requests to one robot; call ``serve`` between its ticks."""

    def __init__(self, endpoint: str) -> None:
        """Bind the address; raises AmberboxError if pyzmq is missing or it cannot be bound."""
        try:
            import zmq
        except ImportError as error:
            raise AmberboxError("pyzmq is not installed", "pip install 'amberbox[zmq]'") from error
        self._zmq: Any = zmq
        self._waiting: dict[str, list[bytes]] = {}
        self._socket: Any = zmq.Context.instance().socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.MAXMSGSIZE, _MAX_FRAME_BYTES)
        self._socket.setsockopt(zmq.LINGER, 1000)
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self._socket.close(0)
            what = f"cannot bind {endpoint} for commands: {error}"
            raise AmberboxError(what, "tcp://127.0.0.1:5557") from error
        self.endpoint: str = self._socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0").decode()

    def serve(self, robot: Robot) -> None:
        """Answer the motions that have ended, and what has come in."""
        self._answer_ended(robot)
        for _ in range(_MOST_AT_ONCE):
            try:
                frames = self._socket.recv_multipart(self._zmq.DONTWAIT)
            except self._zmq.Again:
                break
            self._receive(robot, frames)
        self._answer_ended(robot)

    def close(self, reason: str) -> None:
        """Tell all who wait that the robot's time is over, and close."""
        for command_id, sender in self._waiting.items():
            self._send(sender, _refusal(reason) | {"id": command_id, "state": "failed"})
        self._waiting.clear()
        self._socket.close()

    def _receive(self, robot: Robot, frames: list[bytes]) -> None:
        # a REQ socket puts an empty frame before its data, a DEALER may not
        sender = frames[:2] if frames[1:2] == [b""] else frames[:1]
        if len(frames) != len(sender) + 1:
            self._send(sender, _refusal(f"a request is one frame, not {len(frames) - 1}"))
            return
        try:
            request = decode_request(frames[-1])
        except AmberboxError as error:
            self._send(sender, _refusal(error.what) | {"hint": error.hint})
            return
        self._take(robot, request, sender)

    def _take(self, robot: Robot, request: RobotRequest, sender: list[bytes]) -> None:
        answer = robot.commands.request(robot.now_s, request)
        if request.do != "status" and answer["state"] == "running" and request.wait:
            self._waiting[answer["id"]] = sender
        else:
            self._send(sender, answer)

    def _answer_ended(self, robot: Robot) -> None:
        for command_id in list(self._waiting):
            command = robot.commands.find(command_id)
            if command is not None and command.state != "running":
                self._send(self._waiting.pop(command_id), command.fields())

    def _send(self, sender: list[bytes], answer: dict[str, Any]) -> None:
        """Send an answer; one that finds no room or nobody there is dropped, as ZeroMQ does."""
        try:
            self._socket.send_multipart([*sender, msgspec.json.encode(answer)], self._zmq.DONTWAIT)
        except self._zmq.ZMQError:
            return


def _refusal(reason: str) -> dict[str, Any]:
    return {"ok": False, "do": "", "state": "refused", "reason": reason}
