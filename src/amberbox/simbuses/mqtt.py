"""MQTT: the topics ``connection`` and ``state`` of a carrier after VDA 5050, version 2."""

from __future__ import annotations

import datetime
import json
import math
import socket
from collections.abc import Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.sim.buses import BusSetup
from amberbox.sim.robot import TICKS_PER_S, Robot

VERSION, MANUFACTURER = "2.0.0", "amberbox"
_PORT = 1883
_KEEPALIVE_S = 15
_CONNECT_S = 10.0
_ERROR = 40  # level of log lines that are reported as errors
_ERRORS_S = 30.0  # how long
_MOST_ERRORS = 10
_LOW_PERCENT = 20.0


def open_bus(address: str, setup: BusSetup) -> MqttBus:
    """Connect to a broker; raises AmberboxError if it does not answer."""
    return MqttBus(address, setup)


class MqttBus:
    """A carrier on the broker. It is connected by WiFi: without that, its connection is broken."""

    def __init__(self, address: str, setup: BusSetup) -> None:
        try:
            import paho.mqtt.client as paho
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError as error:
            what = "paho-mqtt is not installed"
            raise AmberboxError(what, "pip install 'amberbox[mqtt]'") from error
        host, port = _address(address)
        self._robot_id = setup.robot_id
        self._prefix = f"uagv/v2/{MANUFACTURER}/{setup.robot_id}"
        self._counts = {"connection": 0, "state": 0}
        self._latest: dict[str, Mapping[str, Any]] = {}
        self._errors: list[tuple[float, Mapping[str, Any]]] = []
        self._seconds, self._ticks = 0.0, 0
        self._now_ns = 0
        self._last_node = ""
        self._client: Any = paho.Client(CallbackAPIVersion.VERSION2)
        self._client.connect_timeout = _CONNECT_S
        broken = json.dumps({**self._header("connection"), "connectionState": "CONNECTIONBROKEN"})
        self._client.will_set(f"{self._prefix}/connection", broken, qos=1, retain=True)
        try:
            self._client.connect(host, port, _KEEPALIVE_S)
        except OSError as error:
            raise AmberboxError(
                f"no broker answers at {host}:{port}: {error.strerror or error}",
                "start one: mosquitto -p 1883",
            ) from error
        self._client.loop_start()
        self._is_online = True
        self._publish("connection", {"connectionState": "ONLINE"}, retain=True)

    def send(self, topic: str, message: Mapping[str, Any]) -> None:
        """Keep the latest message of each topic, and the errors of the log."""
        if topic == "state" and "state" in self._latest:
            before = self._latest["state"]["goal"]
            self._last_node = before if message["goal"] != before else self._last_node
        self._latest[topic] = message
        if topic == "log" and message["level"] >= _ERROR:
            self._errors = [*self._errors, (self._seconds, message)][-_MOST_ERRORS:]

    def tick(self, robot: Robot, due_ns: int) -> None:
        """Publish the state once a second, if the task executor works and there is WiFi."""
        self._ticks += 1
        self._seconds = robot.now_s
        self._now_ns = robot.now_ns + round(robot.host.clock_shift_s * NS)
        wifi = self._latest.get("wifi")
        if wifi is not None and wifi["connected"] != self._is_online:
            self._go(is_online=wifi["connected"])
        is_due = self._ticks % TICKS_PER_S == 0 and self._is_online
        needed = {"state", "localisation", "odom", "battery", "safety"}
        if is_due and robot.host.is_working("task_executor") and needed <= self._latest.keys():
            self._publish("state", self._state())

    def close(self) -> None:
        """Say that the carrier goes offline, and disconnect."""
        if self._is_online:
            self._publish("connection", {"connectionState": "OFFLINE"}, retain=True)
            self._client.disconnect()
        self._client.loop_stop()

    def _go(self, *, is_online: bool) -> None:
        """Break the connection without a word, or connect again."""
        self._is_online = is_online
        if is_online:
            with suppress(OSError):  # the broker is away: paho tries again
                self._client.reconnect()
            self._client.loop_start()
            self._publish("connection", {"connectionState": "ONLINE"}, retain=True)
            return
        self._client.loop_stop()
        with suppress(OSError, AttributeError):  # it may be closed already
            self._client.socket().shutdown(socket.SHUT_RDWR)

    def _publish(self, topic: str, body: Mapping[str, Any], *, retain: bool = False) -> None:
        data = json.dumps({**self._header(topic), **body})
        self._client.publish(f"{self._prefix}/{topic}", data, qos=int(retain), retain=retain)

    def _header(self, topic: str) -> dict[str, Any]:
        self._counts[topic] += 1
        seconds = datetime.datetime.fromtimestamp(self._now_ns / NS, datetime.UTC)
        return {
            "headerId": self._counts[topic],
            "timestamp": seconds.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "version": VERSION, "manufacturer": MANUFACTURER, "serialNumber": self._robot_id,
        }  # fmt: skip

    def _state(self) -> dict[str, Any]:
        latest = self._latest
        state, pose, odom = latest["state"], latest["localisation"], latest["odom"]
        battery, safety, twist = latest["battery"], latest["safety"], odom["twist"]
        turn = pose["pose"]["orientation"]
        speed = math.hypot(twist["linear"]["x"], twist["linear"]["y"])
        return {
            "orderId": state["task_id"], "orderUpdateId": 0, "lastNodeId": self._last_node,
            "lastNodeSequenceId": 0, "driving": speed > 0.01, "paused": False,
            "operatingMode": "AUTOMATIC", "nodeStates": _nodes(state), "edgeStates": [],
            "actionStates": _actions(state),
            "agvPosition": {
                "x": pose["pose"]["position"]["x"], "y": pose["pose"]["position"]["y"],
                "theta": 2 * math.atan2(turn["z"], turn["w"]), "mapId": f"floor_{state['floor']}",
                "positionInitialized": True, "localizationScore": pose["match_score"],
            },
            "velocity": {
                "vx": twist["linear"]["x"], "vy": twist["linear"]["y"],
                "omega": twist["angular"]["z"],
            },
            "loads": [{"loadId": "cart", "loadType": "cart"}] if state["cart_attached"] else [],
            "batteryState": {
                "batteryCharge": battery["percentage"], "batteryVoltage": battery["voltage"],
                "charging": battery["charging"],
            },
            "safetyState": {
                "eStop": "MANUAL" if safety["e_stop_pressed"] else "NONE",
                "fieldViolation": safety["bumper_front"] or safety["bumper_rear"],
            },
            "errors": self._reported(battery), "information": [],
        }  # fmt: skip

    def _reported(self, battery: Mapping[str, Any]) -> list[dict[str, Any]]:
        since_s = self._seconds - _ERRORS_S
        self._errors = [entry for entry in self._errors if entry[0] >= since_s]
        found = [
            {"errorType": line["name"], "errorDescription": line["msg"], "errorLevel": "WARNING"}
            for _, line in self._errors
        ]
        if battery["percentage"] < _LOW_PERCENT and not battery["charging"]:
            text = f"battery at {battery['percentage']:.0f} %"
            low = {"errorType": "batteryLow", "errorDescription": text, "errorLevel": "WARNING"}
            found.append(low)
        return found


def _nodes(state: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the nodes that are still ahead."""
    goal = state["goal"]
    return [{"nodeId": goal, "sequenceId": 2, "released": True}] if goal else []


def _actions(state: Mapping[str, Any]) -> list[dict[str, str]]:
    if not state["stage"]:
        return []
    return [{
        "actionId": f"{state['task_id']}-{state['stage']}", "actionType": state["stage"],
        "actionStatus": "RUNNING",
    }]  # fmt: skip


def _address(text: str) -> tuple[str, int]:
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port or _PORT
    except ValueError:
        host, port = None, 0
    if not host:
        raise UsageError(f"--mqtt {text} is no address", "--mqtt 127.0.0.1:1883")
    return host, port
