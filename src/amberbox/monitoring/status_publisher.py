"""Publish statuses in the configured formats: by ZeroMQ, a ROS 1 node, a bridge, an MQTT broker.

Nothing opens without configuration.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec

from amberbox.blackbox.robot_folder.robot_yaml import Format, PublishOptions
from amberbox.core.contracts import Publisher
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.background_sender import BackgroundSender, SenderEvent
from amberbox.monitoring.bridge_publisher import BridgePublisher
from amberbox.monitoring.mqtt_publisher import MqttPublisher
from amberbox.monitoring.plan import MonitoringPlan, Naming
from amberbox.monitoring.publishers import diagnostics, health_status, mqtt, paper
from amberbox.monitoring.ros_publisher import RosPublisher

_PUBLISHERS: Mapping[Format, Publisher] = {
    "paper": paper,
    "health_status": health_status,
    "diagnostics": diagnostics,
    "mqtt": mqtt,
}
FORMATS = {name: publisher.messages for name, publisher in _PUBLISHERS.items()}


_ROUNDS = 4
_LEAST_ROOM = 1000  # queue of a subscriber: some rounds, then it loses messages
_LEAST_PAUSE_S = 0.1  # between two changes that are published at once


@dataclass(slots=True)
class _Outlet:
    """One entry of ``publish:`` and the time of its next message (s of the clock).

    It has a ZeroMQ socket, or a sender in a thread of its own.
    """

    options: PublishOptions
    socket: Any = None
    sender: BackgroundSender | None = None
    due_s: float = 0.0
    sent_s: float = float("-inf")


class StatusPublisher:
    """Publishes statuses at the configured addresses, each in its format and at its interval.

    ``open`` opens the addresses; ``publish`` may be called whenever there are new statuses, and
    sends the messages that are due. It never waits for a peer. One thread.
    """

    def __init__(
        self,
        options: Sequence[PublishOptions],
        plan: MonitoringPlan,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._options = options
        self._robot = plan.robot
        self._naming = Naming.of(plan)
        self._room = max(_LEAST_ROOM, _ROUNDS * len(plan.modes()))
        self._clock_s = clock_s
        self._context: Any = None
        self._outlets: list[_Outlet] = []

    def open(self) -> None:
        """Bind the addresses of ZeroMQ, and begin to connect to the other peers.

        Raises AmberboxError if an address cannot be bound; then none is open.
        """
        sockets: dict[str, Any] = {}
        for entry in self._options:
            if entry.is_ros or entry.is_bridge or entry.is_mqtt:
                self._outlets.append(_Outlet(entry, sender=self._sender(entry)))
                continue
            if entry.url not in sockets:
                sockets[entry.url] = self._bound(entry.url)
            self._outlets.append(_Outlet(entry, sockets[entry.url]))
        for outlet in self._outlets:
            if outlet.sender is not None:
                outlet.sender.start()

    def _sender(self, entry: PublishOptions) -> BackgroundSender:
        if entry.is_mqtt:
            return BackgroundSender(entry.url, partial(MqttPublisher, entry, self._robot))
        url, topic = entry.url, entry.ros_topic
        if entry.is_ros:
            return BackgroundSender(
                f"{url} {topic}", partial(RosPublisher, url, topic, self._robot)
            )
        return BackgroundSender(f"{url} {topic}", partial(BridgePublisher, url, topic))

    def _bound(self, url: str) -> Any:
        import zmq

        if self._context is None:
            self._context = zmq.Context()
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

    def changed(self) -> None:
        """Make messages to ROS, bridges and brokers due at once: something has changed."""
        for outlet in self._outlets:
            if outlet.sender is not None:
                outlet.due_s = min(outlet.due_s, outlet.sent_s + _LEAST_PAUSE_S)

    def publish(self, statuses: Sequence[Status], diagnosis: Diagnosis | None = None) -> None:
        """Send the newest statuses of all modes and components where a message is due."""
        now_s = self._clock_s()
        for outlet in self._outlets:
            if now_s >= outlet.due_s:
                interval_s = outlet.options.interval_s
                following_s = outlet.due_s + interval_s
                outlet.due_s = following_s if following_s > now_s else now_s + interval_s
                outlet.sent_s = now_s
                self._send(outlet, statuses, diagnosis)

    def _send(
        self, outlet: _Outlet, statuses: Sequence[Status], diagnosis: Diagnosis | None
    ) -> None:
        topic = [outlet.options.topic.encode()] if outlet.options.topic else []
        for message in FORMATS[outlet.options.format](statuses, self._naming, diagnosis):
            if outlet.sender is not None:
                outlet.sender.put(message)
                continue
            import zmq

            data = msgspec.json.encode(message, enc_hook=_plain)
            outlet.socket.send_multipart([*topic, data], zmq.NOBLOCK)  # a PUB socket never waits

    def events(self) -> list[SenderEvent]:
        """Return what happened to the connections since the last call."""
        senders = [outlet.sender for outlet in self._outlets if outlet.sender is not None]
        return [event for sender in senders for event in sender.events()]

    def close(self) -> None:
        """Close the addresses; messages that subscribers have not received yet are dropped."""
        for outlet in self._outlets:
            if outlet.sender is not None:
                outlet.sender.close()
        if self._context is not None:
            self._context.destroy(linger=0)
        self._context, self._outlets = None, []


def _plain(value: Any) -> Any:
    """Return a number of numpy's as one of Python's."""
    return value.item()
