"""Statuses at an MQTT broker, and what Home Assistant is told of them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import Client

from amberbox.blackbox.robot_folder.robot_yaml import PublishOptions
from amberbox.core.types import Diagnosis, Hypothesis, Status
from amberbox.monitoring.plan import Naming
from amberbox.monitoring.publishers import mqtt
from amberbox.monitoring.status_publisher import StatusPublisher
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.monitoring.publishers.laser import BOTH, COMPONENT, PLAN, STATUSES
from tests.support.mqtt_broker import Mosquitto, mosquitto, publisher

BASE = "amberbox/ropod_001"
LASER = f"{BASE}/components/laser"
CONFIG = "homeassistant/binary_sensor/amberbox_ropod_001/laser/config"


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    with mosquitto(tmp_path) as made:
        yield made


class Held:
    """What a broker holds; None was removed meanwhile."""

    def __init__(self, client: Client) -> None:
        self.topics: dict[str, Any] = {}
        self.history: list[tuple[str, bytes]] = []
        client.on_message = self._note
        client.subscribe("#", 1)

    def _note(self, _client: Any, _data: Any, message: Any) -> None:
        payload = bytes(message.payload)
        self.history.append((message.topic, payload))
        text = payload.decode()
        self.topics[message.topic] = json.loads(text) if text.startswith("{") else text or None

    def has(self, topic: str, value: Any) -> None:
        wait_until(lambda: self.topics.get(topic, "nothing") == value, f"{topic} is {value}")


@contextmanager
def held(broker: Mosquitto) -> Iterator[Held]:
    with publisher(broker) as client:
        yield Held(client)


@contextmanager
def publishing(broker: Mosquitto, **options: Any) -> Iterator[StatusPublisher]:
    entry = PublishOptions(f"mqtt://127.0.0.1:{broker.port}", "mqtt", every=0.01, **options)
    assert not list(entry.check())
    made = StatusPublisher([entry], PLAN)
    made.open()
    try:
        yield made
    finally:
        made.close()


def test_a_component_is_held_and_announced(broker: Mosquitto) -> None:
    with held(broker) as found:
        with publishing(broker, discovery="homeassistant") as statuses:
            statuses.publish(STATUSES)
            wait_until(lambda: {LASER, CONFIG} <= found.topics.keys(), "both topics")
            found.has(f"{BASE}/availability", "online")
        found.has(f"{BASE}/availability", "offline")
    with held(broker) as later:
        wait_until(lambda: len(later.topics) == 3, "all is retained")
    laser = later.topics[LASER]
    assert (laser["name"], laser["problem"], laser["level"]) == ("Laser scanners", "OFF", "ok")
    assert laser["modes"]["laser_device_monitor"]["outputs"] == BOTH
    config = later.topics[CONFIG]
    assert config["state_topic"] == config["json_attributes_topic"] == LASER
    assert config["availability_topic"] == f"{BASE}/availability"
    assert (config["device_class"], config["unique_id"]) == ("problem", "amberbox_ropod_001_laser")
    assert config["device"]["identifiers"] == ["amberbox_ropod_001"]


def test_without_discovery_nothing_is_announced(broker: Mosquitto) -> None:
    with held(broker) as found, publishing(broker, topic="fleet/7") as statuses:
        statuses.publish(STATUSES)
        wait_until(lambda: "fleet/7/components/laser" in found.topics, "the component")
        found.has("fleet/7/availability", "online")
        assert len(found.topics) == 2


def test_a_component_that_is_gone_is_removed_also_after_a_restart(broker: Mosquitto) -> None:
    docker = replace(COMPONENT, component="docker")
    with held(broker) as found:
        with publishing(broker, discovery="homeassistant") as statuses:
            statuses.publish([*STATUSES, docker])
            wait_until(lambda: len(found.topics) == 5, "both components")
        with publishing(broker, discovery="homeassistant") as statuses:

            def is_removed() -> bool:
                statuses.publish(STATUSES)
                return found.topics[f"{BASE}/components/docker"] is None

            wait_until(is_removed, "the component of the run before is removed")
            found.has(CONFIG.replace("laser", "docker"), None)
            for gone, there in ((LASER, docker), (LASER.replace("laser", "docker"), COMPONENT)):

                def is_exchanged(gone: str = gone, there: Status = there) -> bool:
                    statuses.publish([there])
                    return found.topics[gone] is None

                wait_until(is_exchanged, f"{gone} is removed")
            found.has(CONFIG.replace("laser", "docker"), None)
            wait_until(lambda: found.topics[CONFIG] is not None, "the other is there again")


def test_a_fault_is_sent_at_once_and_numbers_alone_are_not(broker: Mosquitto) -> None:
    with held(broker) as found, publishing(broker) as statuses:
        statuses.publish(STATUSES)
        wait_until(lambda: LASER in found.topics, "the component")
        for number in range(50):
            numbered = [replace(status, reason=f"{number} Hz") for status in STATUSES]
            statuses.changed()
            statuses.publish(numbered)
        broken = replace(COMPONENT, level="error", state="silent", reason="no scans")
        for level, problem in mqtt.PROBLEMS.items():
            status = replace(broken, level=level)

            def is_told(status: Any = status, problem: Any = problem) -> bool:
                statuses.publish([status, *STATUSES[1:]])
                laser = found.topics[LASER]
                return bool(laser["problem"] == problem and laser["level"] == status.level)

            wait_until(is_told, level)
    assert sum(topic == LASER for topic, _ in found.history) <= 7


def test_a_broker_that_is_started_again_gets_everything(broker: Mosquitto) -> None:
    with publishing(broker) as statuses:
        with held(broker) as found:
            statuses.publish(STATUSES)
            wait_until(lambda: LASER in found.topics, "the component")
        broker.kill()
        events: list[str] = []

        def is_noticed() -> bool:
            events.extend(event.kind for event in statuses.events())
            return "publish_failed" in events

        wait_until(is_noticed, "the loss")
        broker.start()
        with held(broker) as found:

            def is_back() -> bool:
                statuses.publish(STATUSES)
                return LASER in found.topics

            wait_until(is_back, "the component")
            found.has(f"{BASE}/availability", "online")


def test_the_last_will_says_offline(broker: Mosquitto) -> None:
    code = (
        "from tests.monitoring.publishers.test_mqtt_publisher import *\n"
        "import time\n"
        f"entry = PublishOptions('mqtt://127.0.0.1:{broker.port}', 'mqtt')\n"
        "made = StatusPublisher([entry], PLAN)\n"
        "made.open()\n"
        "made.publish(STATUSES)\n"
        f"time.sleep({PATIENCE_S})\n"
    )
    with held(broker) as found:
        with subprocess.Popen([sys.executable, "-c", code], env=dict(os.environ)) as process:
            found.has(f"{BASE}/availability", "online")
            process.send_signal(signal.SIGKILL)
        found.has(f"{BASE}/availability", "offline")


def test_a_refusal_is_an_event_with_a_hint(tmp_path: Path) -> None:
    with mosquitto(tmp_path, "allow_anonymous false") as broker:
        found: list[str] = []
        with publishing(broker, username="u", password="swordfish") as statuses:

            def is_told() -> bool:
                found.extend(event.text for event in statuses.events())
                return bool(found)

            wait_until(is_told, "the refusal")
    assert "refuses the connection: Not authorized" in found[0] and "swordfish" not in found[0]


def test_the_open_diagnosis_is_in_the_attributes() -> None:
    hypothesis = Hypothesis("h", frozenset({"laser#died"}), 0.9, explains=("laser/a/b",))
    diagnosis = Diagnosis("d1", 1, "ropod_001", 0, "abc", (hypothesis,), 1.0)
    (message,) = mqtt.messages(STATUSES, Naming.of(PLAN), diagnosis)
    assert message["components"]["laser"]["failure_modes"] == "laser#died (90%)"
    assert mqtt.messages([], Naming.of(PLAN)) == []


@pytest.mark.parametrize(
    ("options", "keys"),
    [
        ({"url": "mqtt://x", "format": "paper"}, ["format"]),
        ({"url": "tcp://127.0.0.1:1", "format": "mqtt"}, ["format"]),
        ({"url": "mqtt://", "format": "mqtt"}, ["url"]),
        ({"url": "mqtt://u:p@x", "format": "mqtt"}, ["url"]),
        ({"url": "mqtt://x", "format": "mqtt", "topic": "a/#"}, ["topic"]),
        ({"url": "mqtt://x", "format": "mqtt", "discovery": "+"}, ["discovery"]),
        ({"url": "mqtt://x", "format": "mqtt", "ca_file": "ca.pem"}, ["ca_file"]),
        ({"url": "tcp://127.0.0.1:1", "password": "x"}, ["password"]),
    ],
)
def test_wrong_options(options: dict[str, Any], keys: list[str]) -> None:
    assert [key for key, _ in PublishOptions(**options).check()] == keys
