"""Publish statuses over ZeroMQ in the configured format; nothing opens without configuration."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from amberbox.blackbox.robot_folder.robot_yaml import Format, PublishOptions
from amberbox.core.contracts import Publisher
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Status
from amberbox.monitoring.plan import MonitoringPlan, Naming
from amberbox.monitoring.publishers import diagnostics, health_status, paper

_PUBLISHERS: Mapping[Format, Publisher] = {
    "paper": paper,
    "health_status": health_status,
    "diagnostics": diagnostics,
}
FORMATS = {name: publisher.messages for name, publisher in _PUBLISHERS.items()}


_ROUNDS = 4
_LEAST_ROOM = 1000  # queue of a subscriber: some rounds, then it loses messages


@dataclass(slots=True)
class _Outlet:
    """One entry of ``publish:`` and the time of its next message (s of the clock)."""

    options: PublishOptions
    socket: Any
    due_s: float = 0.0


class StatusPublisher:
    """Publishes statuses at the configured addresses, each in its format and at its interval.

    ``open`` binds the addresses; ``publish`` may be called whenever there are new statuses, and
    sends the messages that are due. It never waits for a subscriber. One thread.
    """

    def __init__(
        self,
        options: Sequence[PublishOptions],
        plan: MonitoringPlan,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._options = options
        self._naming = Naming.of(plan)
        self._room = max(_LEAST_ROOM, _ROUNDS * len(plan.modes()))
        self._clock_s = clock_s
        self._context: Any = None
        self._outlets: list[_Outlet] = []

    def open(self) -> None:
        """Bind the addresses; nothing happens without any.

        Raises AmberboxError if an address cannot be bound; then none is open.
        """
        if not self._options:
            return
        import zmq

        self._context = zmq.Context()
        sockets: dict[str, Any] = {}
        for entry in self._options:
            if entry.url not in sockets:
                sockets[entry.url] = self._bound(entry.url)
            self._outlets.append(_Outlet(entry, sockets[entry.url]))

    def _bound(self, url: str) -> Any:
        import zmq

        socket = self._context.socket(zmq.PUB)
        socket.sndhwm = self._room
        socket.linger = 0
        try:
            socket.bind(url)
        except zmq.ZMQError as error:
            self.close()
            what = f"statuses cannot be published at {url}: {error.strerror}"
            raise AmberboxError(what, "choose another url in robot.yaml monitoring.publish") from (
                error
            )
        return socket

    def is_due(self) -> bool:
        """Return whether a message is due at some address."""
        now_s = self._clock_s()
        return any(now_s >= outlet.due_s for outlet in self._outlets)

    def publish(self, statuses: Sequence[Status]) -> None:
        """Send the newest statuses of all modes and components where a message is due."""
        now_s = self._clock_s()
        for outlet in self._outlets:
            if now_s >= outlet.due_s:
                following_s = outlet.due_s + outlet.options.every
                outlet.due_s = following_s if following_s > now_s else now_s + outlet.options.every
                self._send(outlet, statuses)

    def _send(self, outlet: _Outlet, statuses: Sequence[Status]) -> None:
        import zmq

        topic = [outlet.options.topic.encode()] if outlet.options.topic else []
        for message in FORMATS[outlet.options.format](statuses, self._naming):
            data = msgspec.json.encode(message, enc_hook=_plain)
            outlet.socket.send_multipart([*topic, data], zmq.NOBLOCK)  # a PUB socket never waits

    def close(self) -> None:
        """Close the addresses; messages that subscribers have not received yet are dropped."""
        if self._context is not None:
            self._context.destroy(linger=0)
        self._context, self._outlets = None, []


def _plain(value: Any) -> Any:
    """Return a number of numpy's as one of Python's."""
    return value.item()
