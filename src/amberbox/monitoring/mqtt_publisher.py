"""Publishes statuses at an MQTT broker, and announces them to Home Assistant if wanted.

Below ``amberbox/ROBOT`` each component has a retained topic, and ``availability`` says ``online``,
or ``offline`` as the last will. Topics of components that are there no more are removed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

import msgspec

from amberbox.blackbox.robot_folder.robot_yaml import PublishOptions
from amberbox.core.errors import AmberboxError
from amberbox.core.mqtt import BrokerLogin, broker_address, new_client
from amberbox.core.safe_text import one_line
from amberbox.core.version import __version__
from amberbox.monitoring.background_sender import Message
from amberbox.monitoring.publishers.mqtt import meaning

_WAIT_S = 5.0
_KEEPALIVE_S = 10
_QUIET_S = 10.0  # between messages of a component in which only numbers have changed
_MOST_QUEUED = 10_000
_MOST_FOUND = 10_000
AVAILABILITY = "availability"
COMPONENTS = "components"


class MqttPublisher:
    """One connection to a broker."""

    def __init__(self, options: PublishOptions, robot: str, stopped: Callable[[], bool]) -> None:
        self._robot = robot
        self._base = options.topic or f"amberbox/{robot}"
        self._discovery = options.discovery
        self._sent: dict[str, tuple[tuple[object, ...], Mapping[str, Any], float]] = {}
        self._found: set[str] = set()  # topics of ours that the broker holds
        self._lock = threading.Lock()
        self._answer = ""
        self._answered = threading.Event()
        address = broker_address(options.url)
        login = BrokerLogin(
            f"amberbox_{robot}_status", options.username, options.password, options.ca_file
        )
        self._client = new_client(address, login, is_v5=False)
        self._client.max_queued_messages_set(_MOST_QUEUED)
        self._client.on_connect, self._client.on_message = self._connected, self._noticed
        self._client.will_set(self._availability, "offline", qos=1, retain=True)
        try:
            self._client.connect(address.host, address.port, _KEEPALIVE_S)
        except (OSError, ValueError) as error:
            raise AmberboxError(f"no broker answers: {one_line(str(error))}") from error
        self._client.loop_start()
        try:
            self._wait(stopped)
        except BaseException:
            self._client.disconnect()
            self._client.loop_stop()
            raise

    @property
    def _availability(self) -> str:
        return f"{self._base}/{AVAILABILITY}"

    def _wait(self, stopped: Callable[[], bool]) -> None:
        """Wait until the broker has answered; raises AmberboxError."""
        end_s = time.monotonic() + _WAIT_S
        while not self._answered.wait(0.05):
            if stopped() or time.monotonic() > end_s:
                raise AmberboxError(f"the broker does not answer within {_WAIT_S:g} s")
        if self._answer:
            hint = "robot.yaml monitoring.publish: username, password"
            raise AmberboxError(f"the broker refuses the connection: {self._answer}", hint)

    def _connected(
        self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any
    ) -> None:
        if reason.is_failure:
            self._answer = one_line(str(reason))
        else:
            client.publish(self._availability, "online", qos=1, retain=True)
            client.subscribe([(name, 1) for name in self._own_topics("+")])
        self._answered.set()

    def _own_topics(self, component: str) -> list[str]:
        """Return the topics of a component: its status, and how Home Assistant finds it."""
        own = [f"{self._base}/{COMPONENTS}/{component}"]
        if self._discovery:
            thing = component if component == "+" else _object_id(component)
            own.append(f"{self._discovery}/binary_sensor/{self._device}/{thing}/config")
        return own

    def _topics_of(self, components: Iterable[str]) -> set[str]:
        return {topic for component in components for topic in self._own_topics(component)}

    @property
    def _device(self) -> str:
        return f"amberbox_{_object_id(self._robot)}"

    def _noticed(self, _client: Any, _data: Any, message: Any) -> None:
        """Note what the broker holds, also of runs before."""
        with self._lock:
            if not message.payload:
                self._found.discard(message.topic)
            elif len(self._found) < _MOST_FOUND:
                self._found.add(message.topic)

    def send(self, message: Message) -> None:
        """Publish what has changed, and remove what is gone; raises AmberboxError."""
        components: Mapping[str, Mapping[str, Any]] = message["components"]
        for component, facts in components.items():
            self._send(component, facts)
        wanted = self._topics_of(components)
        with self._lock:
            gone = (self._found | self._topics_of(self._sent)) - wanted
            self._found &= wanted
        self._sent = {key: sent for key, sent in self._sent.items() if key in components}
        for topic in gone:
            self._publish(topic, b"")
        self.check()

    def _send(self, component: str, facts: Mapping[str, Any]) -> None:
        news, now_s = meaning(facts), time.monotonic()
        before = self._sent.get(component)
        if before is not None:
            is_news = news != before[0]
            if not is_news and (facts == before[1] or now_s - before[2] < _QUIET_S):
                return
        topic, *discovery = self._own_topics(component)
        if before is None or before[1]["name"] != facts["name"]:
            for config in discovery:
                self._publish(config, msgspec.json.encode(self._announcement(component, facts)))
        self._publish(topic, msgspec.json.encode(facts, enc_hook=_plain))
        self._sent[component] = news, facts, now_s

    def _announcement(self, component: str, facts: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what Home Assistant is told of a component: a sensor of class ``problem``."""
        topic = self._own_topics(component)[0]
        return {
            "name": facts["name"],
            "unique_id": f"{self._device}_{_object_id(component)}",
            "device_class": "problem",
            "state_topic": topic,
            "value_template": "{{ value_json.problem }}",
            "json_attributes_topic": topic,
            "availability_topic": self._availability,
            "device": {"identifiers": [self._device], "name": self._robot},
            "origin": {"name": "Amberbox", "sw_version": __version__},
        }

    def _publish(self, topic: str, data: bytes) -> None:
        try:
            self._client.publish(topic, data, qos=1, retain=True)
        except ValueError as error:  # the queue is full
            raise AmberboxError(f"the broker takes no messages: {error}") from error

    def check(self) -> None:
        """Raise AmberboxError when the connection is lost."""
        if not self._client.is_connected():
            raise AmberboxError("the broker has closed the connection")

    def dropped(self) -> int:
        """Return 0: what waits is sent, or the connection ends."""
        return 0

    def close(self) -> None:
        """Say that the statuses are no longer kept up to date, and leave."""
        if self._client.is_connected():
            farewell = self._client.publish(self._availability, "offline", qos=1, retain=True)
            with suppress(RuntimeError, ValueError):  # lost meanwhile: the last will says the same
                farewell.wait_for_publish(0.5)
        self._client.disconnect()
        self._client.loop_stop()


def _object_id(name: str) -> str:
    """Return an id as Home Assistant allows it: without dots."""
    return name.replace(".", "__")


def _plain(value: Any) -> Any:
    """Return a number of numpy's as one of Python's."""
    return value.item()
