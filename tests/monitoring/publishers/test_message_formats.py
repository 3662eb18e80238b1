"""Statuses as messages: the paper's listing 6, HEALTH-STATUS, DiagnosticArray."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from amberbox.blackbox.robot_folder.robot_yaml import Format
from amberbox.core.clock import NS
from amberbox.core.types import Level, Status
from amberbox.monitoring.plan import Naming
from amberbox.monitoring.publishers import diagnostics, health_status, paper
from amberbox.monitoring.status_publisher import FORMATS
from tests.monitoring.publishers.laser import (
    BOTH,
    COMPONENT,
    OF_DEVICE,
    OF_HEARTBEAT,
    PLAN,
    STATUSES,
    T0_NS,
)

NAMES = Naming.of(PLAN)


def test_every_format_that_can_be_configured_is_there() -> None:
    assert set(FORMATS) == set(get_args(Format))


def test_paper_message_is_the_one_that_the_paper_prints() -> None:
    said = msgspec.json.encode(paper.messages(STATUSES, NAMES)[0])
    assert said == (
        b'{"robotId":"ropod_001","monitorName":"laser_device_monitor",'
        b'"healthStatus":{"front_laser_working":true,"rear_laser_working":true}}'
    )


def test_documented_messages_are_those_that_are_sent() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "robot" / "status.md").read_text("utf-8")
    said, envelope = map(msgspec.json.decode, re.findall(r"```json\n(.*?)```", page, re.DOTALL))
    assert said == paper.message(OF_DEVICE, NAMES)
    (sent,) = health_status.messages([COMPONENT, OF_DEVICE], NAMES)
    sent["header"] |= {"msgId": "4f0c...", "timestamp": T0_NS / NS + 0.5}
    assert sent == envelope


def test_paper_has_one_message_for_each_mode() -> None:
    names = [message["monitorName"] for message in paper.messages(STATUSES, NAMES)]
    assert names == ["laser_device_monitor", "laser_heartbeat_monitor"]


def test_without_a_plan_modes_go_by_their_ids() -> None:
    message = paper.message(OF_DEVICE, Naming.of(None))
    assert message["monitorName"] == "laser_device"


def test_health_status_has_the_predecessors_envelope() -> None:
    (message,) = health_status.messages(STATUSES, NAMES)
    assert message["header"].pop("msgId")
    assert message == {
        "header": {
            "type": "HEALTH-STATUS",
            "metamodel": "ropod-msg-schema.json",
            "timestamp": T0_NS / NS + 0.5,
        },
        "payload": {
            "metamodel": "ropod-component-monitor-schema.json",
            "robotId": "ropod_001",
            "monitors": [
                {
                    "component": "Laser scanners",
                    "component_id": "laser",
                    "component_sm_state": "running",
                    "modes": [
                        {
                            "monitorName": "laser_device_monitor",
                            "monitorDescription": "Devices are there",
                            "healthStatus": {**BOTH, "status": True},
                        },
                        {
                            "monitorName": "laser_heartbeat_monitor",
                            "monitorDescription": "",
                            "healthStatus": {**BOTH, "status": True},
                        },
                    ],
                }
            ],
        },
    }


def test_each_health_status_has_an_id_of_its_own() -> None:
    one, other = (health_status.messages(STATUSES, NAMES)[0] for _ in range(2))
    assert one["header"]["msgId"] != other["header"]["msgId"]


@pytest.mark.parametrize("level", get_args(Level))
def test_only_what_is_known_to_work_has_a_true_status(level: Level) -> None:
    outputs = {"status": True, "front_laser_working": True}
    status = replace(OF_DEVICE, level=level, outputs=outputs)
    (message,) = health_status.messages([COMPONENT, status], NAMES)
    said = _only_mode(message)["healthStatus"]["status"]
    assert said is (level in ("ok", "warn"))


@pytest.mark.parametrize(
    ("level", "state", "word"),
    [
        ("ok", "nominal", "running"),
        ("warn", "battery_low", "running"),
        ("unknown", "not_initialised", "init"),
        ("error", "not_initialised", "init"),
        ("error", "front_laser_working", "unknown"),
        ("stale", "stale", "unknown"),
    ],
)
def test_state_is_said_in_the_predecessors_words(level: Level, state: str, word: str) -> None:
    component = replace(COMPONENT, level=level, state=state)
    (message,) = health_status.messages([component, OF_DEVICE], NAMES)
    assert message["payload"]["monitors"][0]["component_sm_state"] == word


def test_component_without_a_status_of_its_own_is_unknown() -> None:
    (message,) = health_status.messages([OF_DEVICE], NAMES)
    assert message["payload"]["monitors"][0]["component_sm_state"] == "unknown"


def test_robot_without_modes_says_nothing() -> None:
    assert health_status.messages([replace(COMPONENT, component="docker")], NAMES) == []
    assert diagnostics.messages([], NAMES) == []


def test_diagnostics_has_the_fields_of_the_ros_message() -> None:
    bad = replace(
        OF_HEARTBEAT,
        level="error",
        state="front_laser_working",
        outputs={"front_laser_working": False, "rate": 1 / 3, "seen": None},
        blocked_by=("ethercat", "power"),
        reason="front_laser_working is false, expected true",
    )
    (message,) = diagnostics.messages([COMPONENT, bad], NAMES)
    component, mode = message["status"]
    assert message["header"] == {
        "seq": 0,
        "stamp": {"secs": T0_NS // NS, "nsecs": NS // 2},
        "frame_id": "",
    }
    assert component == {
        "level": 0,
        "name": "laser",
        "message": "nominal",
        "hardware_id": "ropod_001",
        "values": [{"key": "state", "value": "nominal"}],
    }
    assert (mode["level"], mode["name"]) == (2, "laser: laser_heartbeat_monitor")
    assert mode["message"] == "front_laser_working is false, expected true"
    assert mode["values"] == [
        {"key": "front_laser_working", "value": "false"},
        {"key": "rate", "value": "0.333333"},
        {"key": "seen", "value": "unknown"},
        {"key": "state", "value": "front_laser_working"},
        {"key": "blocked_by", "value": "ethercat, power"},
    ]


@pytest.mark.parametrize(
    ("level", "number"), [("ok", 0), ("warn", 1), ("error", 2), ("stale", 3), ("unknown", 3)]
)
def test_levels_are_those_of_ros(level: Level, number: int) -> None:
    (message,) = diagnostics.messages([replace(OF_DEVICE, level=level)], NAMES)
    assert message["status"][0]["level"] == number


def _only_mode(message: Any) -> Any:
    (monitor,) = message["payload"]["monitors"]
    (mode,) = monitor["modes"]
    return mode


@pytest.mark.parametrize("name", get_args(Format))
def test_number_that_is_none_stands_as_null(name: Format) -> None:
    status: Status = replace(OF_DEVICE, outputs={"rate": float("nan")})
    said = msgspec.json.encode(FORMATS[name]([COMPONENT, status], NAMES))
    assert b'"rate":null' in said or b'"value":"nan"' in said
