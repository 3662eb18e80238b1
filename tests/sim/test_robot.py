"""The simulated robot: deterministic, plausible, typed, and without any text that names a fault."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.sim.faults import DOMAINS, catalogue, parse_faults
from amberbox.sim.missions import SCENARIOS
from amberbox.sim.robot import Message, Robot
from amberbox.sim.topics import TOPIC_BY_NAME, TOPICS

Stream = list[tuple[str, int, bytes]]
_MISSION_S = 110.0


def _stream(robot: Robot, until_s: float) -> Stream:
    encode = msgspec.json.encode
    return [
        (topic, sent_ns, encode(message)) for topic, sent_ns, message in robot.step_until(until_s)
    ]


@cache
def _mission() -> tuple[list[Message], list[dict[str, Any]]]:
    """Return a nominal mission and the truth beside it, once a second."""
    robot = Robot(seed=3)
    messages: list[Message] = []
    truths = []
    for second in range(int(_MISSION_S)):
        messages += robot.step_until(float(second + 1))
        truths.append(robot.truth())
    return messages, truths


def _values(topic: str, *path: str) -> list[Any]:
    found = []
    for name, _, message in _mission()[0]:
        if name == topic:
            value: Any = message
            for key in path:
                value = value[key]
            found.append(value)
    return found


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not() -> None:
    first, second, other = (_stream(Robot(seed), 4.0) for seed in (5, 5, 6))
    assert first == second
    assert first != other
    assert [topic for topic, _, _ in first[:50]]


def test_the_stream_does_not_depend_on_how_it_is_asked_for() -> None:
    robot = Robot(5)
    in_pieces = [piece for end_s in (0.013, 0.5, 1.777, 4.0) for piece in _stream(robot, end_s)]
    assert in_pieces == _stream(Robot(5), 4.0)


@pytest.mark.parametrize(
    "fault_id", ["wheel_front_left_encoder_stuck", "laser_front_silent", "wifi_drops"]
)
def test_before_a_fault_nothing_differs(fault_id: str) -> None:
    begin_s = 3.0
    robot = Robot(5)
    robot.inject(fault_id, at_s=begin_s)
    begin_ns = robot.start_ns + round(begin_s * 1e9)
    nominal, faulty = _stream(Robot(5), 6.0), _stream(robot, 6.0)
    assert [m for m in nominal if m[1] < begin_ns] == [m for m in faulty if m[1] < begin_ns]
    assert nominal != faulty


def test_a_healed_fault_leaves_every_part_as_it_was() -> None:
    robot = Robot(5)
    for fault_id, fault in catalogue().items():
        robot.inject(fault_id, at_s=1.0, until_s=2.0 if fault.domain != "bus" else None)
    before = _knobs(robot)
    list(robot.step_until(1.5))
    assert _knobs(robot) != before
    for fault_id, fault in catalogue().items():
        if fault.domain == "bus":
            robot.heal(fault_id)
    list(robot.step_until(2.1))
    assert _knobs(robot) == pytest.approx(before)
    assert robot.active_faults() == []


def _knobs(robot: Robot) -> list[float]:
    effects = [effect for fault in catalogue().values() for effect in fault.effects]
    return [getattr(robot.parts[effect.part], effect.knob) for effect in effects]


def test_messages_come_in_order_of_time_with_seq_without_holes() -> None:
    messages, _ = _mission()
    times = [sent_ns for _, sent_ns, _ in messages]
    assert times == sorted(times)
    for spec in TOPICS:
        seqs = _values(spec.name, "header", "seq")
        assert seqs == list(range(1, len(seqs) + 1))


def test_topics_keep_their_rates() -> None:
    counts = Counter(topic for topic, _, _ in _mission()[0])
    for spec in TOPICS:
        if spec.rate_hz:
            assert counts[spec.name] == pytest.approx(spec.rate_hz * _MISSION_S, abs=2), spec.name
        else:
            assert counts[spec.name] > 3


def test_every_message_fits_its_declared_shape() -> None:
    for topic, _, message in _mission()[0]:
        mismatch = _mismatch(message, TOPIC_BY_NAME[topic].shape(), topic)
        assert mismatch is None, mismatch


def test_shapes_hold_while_a_bus_device_is_lost() -> None:
    robot = Robot(5)
    robot.inject("wheel_rear_left_bus_disconnected", at_s=1.0)
    for topic, _, message in robot.step_until(4.0):
        assert (
            _mismatch(json.loads(msgspec.json.encode(message)), TOPIC_BY_NAME[topic].shape())
            is None
        )


def _mismatch(value: Any, shape: dict[str, Any], path: str = "") -> str | None:
    """Check a value by the few words of JSON Schema in use; a whole number is no float."""
    kinds: dict[str, type] = {"number": float, "integer": int, "string": str, "boolean": bool}
    kind = shape["type"]
    if kind == "object":
        if not isinstance(value, dict) or list(value) != shape["required"]:
            return f"{path}: {value}"
        below = (_mismatch(v, shape["properties"][k], f"{path}.{k}") for k, v in value.items())
        return next((found for found in below if found), None)
    if kind == "array":
        low, high = shape.get("minItems", 0), shape.get("maxItems", 10**6)
        if not isinstance(value, list) or not low <= len(value) <= high:
            return f"{path}: {value}"
        return next((m for v in value if (m := _mismatch(v, shape["items"], path))), None)
    return None if type(value) is kinds[kind] else f"{path}: {value!r} is no {kind}"


def test_odometry_and_localisation_follow_the_truth() -> None:
    _, truths = _mission()
    travelled = sum(
        np.hypot(a["pose"][0] - b["pose"][0], a["pose"][1] - b["pose"][1])
        for a, b in zip(truths[1:], truths, strict=False)
    )
    assert travelled > 30.0
    per_second = round(len(_values("localisation", "header")) / _MISSION_S)
    places = _values("localisation", "pose", "position")[per_second - 1 :: per_second]
    errors = [
        np.hypot(place["x"] - truth["pose"][0], place["y"] - truth["pose"][1])
        for place, truth in zip(places, truths, strict=False)
    ]
    assert np.median(errors) < 0.15
    assert max(_values("odom", "twist", "linear", "x")) == pytest.approx(0.8, abs=0.1)


def test_nominal_signals_are_plausible() -> None:
    covariance = np.array(_values("localisation", "covariance"))
    assert covariance[:, [0, 7]].mean() < 0.01
    low = [c for c in _values("bus", "working_counter") if c != 12]
    assert len(low) < 0.01 * len(_values("bus", "working_counter"))
    assert set(_values("bus", "expected_working_counter")) == {12}
    status = Counter(_values("wheels", "sensors", "rear_right", "status1"))
    assert status.most_common(1)[0][0] == 3
    ranges = np.array(_values("scan_front", "ranges"))
    assert ranges.shape[1] == 181
    assert ranges.min() >= 0.0 and ranges.max() <= 25.2
    assert np.mean(ranges == 0.0) < 0.02
    assert not any(_values("safety", "bumper_front"))
    assert all(_values("wifi", "connected"))
    assert 20.0 < np.mean(_values("battery", "voltage")) < 30.0
    assert np.mean(_values("imu", "linear_acceleration", "z")) == pytest.approx(9.81, abs=0.05)


def test_wheel_units_roll_and_turn_consistently() -> None:
    """Both wheels of a unit give its turn rate, which is the pivot's plus the body's."""
    wheels = _values("wheels", "sensors", "front_left")
    turn = np.array([-0.052 * (w["velocity_1"] + w["velocity_2"]) / 0.085 for w in wheels])
    pivot = np.array([w["velocity_pivot"] + w["gyro_z"] for w in wheels])
    assert np.median(np.abs(turn - pivot)) < 0.05
    assert np.percentile(np.abs(turn - pivot), 99) < 1.0


def test_tasks_are_reported_from_start_to_end() -> None:
    events = _values("tasks")
    kinds = [event["event"] for event in events]
    assert kinds[0] == "started"
    assert "finished" in kinds and "aborted" not in kinds
    assert {"drive_to_pick_up", "dock_cart", "drive_to_delivery", "undock_cart"} <= {
        event["stage"] for event in events
    }
    assert any(_values("state", "cart_attached"))


def test_the_charging_scenario_charges() -> None:
    robot = Robot(2, scenario="charging")
    battery = [m for topic, _, m in robot.step_until(20.0) if topic == "battery"]
    assert battery[-1]["charging"] and battery[-1]["current"] > 5.0
    assert battery[-1]["percentage"] > battery[4]["percentage"]


def test_a_frozen_bus_device_is_interrupted_by_odd_frames() -> None:
    robot = Robot(5)
    robot.inject("wheel_front_left_bus_disconnected", at_s=2.0)
    messages = [m for topic, _, m in robot.step_until(12.0) if topic == "wheels"][45:]
    frames = [m["sensors"]["front_left"] for m in messages]
    stamps = Counter(frame["sensor_ts"] for frame in frames)
    frozen, count = stamps.most_common(1)[0]
    assert 0.7 < count / len(frames) < 0.98
    odd = [frame for frame in frames if frame["sensor_ts"] != frozen]
    assert all(max(abs(frame["velocity_1"]), abs(frame["current_1_q"])) < 1.1e38 for frame in odd)
    assert any(abs(frame["voltage_bus"]) > 1e3 or frame["voltage_bus"] < 1.0 for frame in odd)


def test_a_collision_course_ends_in_a_stop_not_in_the_wall() -> None:
    robot = Robot(3)
    robot.inject("localisation_shift", at_s=8.0, magnitude=1.0)
    list(robot.step_until(40.0))
    x, y, _ = robot.truth()["pose"]
    assert 0.2 < y < 9.0 and 0.0 < x < 48.0


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, below in value.items():
            yield key
            yield from _strings(below)
    elif isinstance(value, list):
        for below in value:
            yield from _strings(below)
    elif isinstance(value, str):
        yield value


def test_nothing_published_names_a_fault() -> None:
    """Scan topics, variables and texts, also of a robot that has everything at once."""
    robot = Robot(3)
    for fault_id in catalogue():
        robot.inject(fault_id, at_s=3.0)
    said = {spec.name for spec in TOPICS} | {
        text for spec in TOPICS for text in _strings(spec.shape())
    }
    messages = [*_mission()[0], *robot.step_until(25.0)]
    said |= {text for topic, _, message in messages for text in [topic, *_strings(message)]}
    words = {_telling(fault.id, fault.component) for fault in catalogue().values()}
    assert {"motor_weak", "encoder_stuck", "frozen", "hang", "crash"} <= words
    pattern = re.compile("|".join(rf"\b{re.escape(word)}\b" for word in words))
    plain = {text.lower().replace(" ", "_") for text in said} | {text.lower() for text in said}
    assert not [text for text in plain if pattern.search(text)]
    assert not [text for text in said if text in catalogue()]


def _telling(fault_id: str, component: str) -> str:
    """Return the words of a fault's id without those of its component."""
    return fault_id.removeprefix(f"{component}_")


def test_the_catalogue_is_rich_and_right() -> None:
    faults = catalogue()
    kinds = {re.sub(r"(front|rear)_(left|right)|front|rear", "*", name) for name in faults}
    assert len(kinds) >= 24
    assert {fault.domain for fault in faults.values()} == set(DOMAINS)
    assert {fault.onset.kind for fault in faults.values()} == {"step", "ramp", "intermittent"}
    parts = Robot().parts
    for fault in faults.values():
        assert fault.magnitude.low <= fault.magnitude.default <= fault.magnitude.high
        assert fault.scenario in SCENARIOS
        assert all(variable.split(".")[0] in TOPIC_BY_NAME for variable in fault.shows_in)
        for effect in fault.effects:
            assert isinstance(getattr(parts[effect.part], effect.knob), float), effect


def test_ramps_grow_and_intermittent_faults_come_and_go() -> None:
    robot = Robot(5)
    robot.inject("wheel_front_left_bearing_drag", at_s=1.0, magnitude=0.6)
    robot.inject("wifi_drops", at_s=1.0)
    drive, drag, down = robot.base.units["front_left"].drive_1, [], []
    for end_s in np.arange(1.0, 12.0, 0.25):
        list(robot.step_until(float(end_s)))
        drag.append(drive.drag_nm)
        down.append(robot.wifi.down)
    assert drag == sorted(drag) and drag[0] == 0.0 and drag[-1] == pytest.approx(0.6)
    assert 0.0 < drag[5] < 0.6
    switches = np.count_nonzero(np.diff(down))
    assert switches >= 3


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("wheel_front_left_motor_week",), "did you mean wheel_front_left_motor_weak"),
        (("wifi_weak", None, 500.0), "5 to 50 dB"),
        (("wifi_weak", -1.0), "is over"),
        (("wifi_weak", 5.0, None, 4.0), "before it begins"),
    ],
)
def test_wrong_injections_are_refused_with_a_hint(arguments: tuple[Any, ...], part: str) -> None:
    with pytest.raises(UsageError, match=part) as caught:
        Robot().inject(*arguments)
    assert caught.value.hint


def test_healing_and_scenarios_are_checked() -> None:
    with pytest.raises(UsageError, match="was not injected"):
        Robot().heal("wifi_weak")
    with pytest.raises(UsageError, match="unknown scenario"):
        Robot(scenario="dancing")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("- {id: x}", "entry 1 .x.: 'magnitude'"),
        ("- {id: x, magnitude: {range: [0, 1], default: 1, unit: a}, domain: magic}", "component"),
    ],
)
def test_a_broken_catalogue_names_the_entry(text: str, part: str) -> None:
    with pytest.raises(AmberboxError, match=part):
        parse_faults(text, "mine.yaml")


def test_memory_that_runs_out_ends_the_process_and_it_comes_back() -> None:
    robot = Robot(5, scenario="standing")
    robot.inject("navigation_memory_leak", at_s=1.0, magnitude=400.0, until_s=30.0)
    log = [m for topic, _, m in robot.step_until(40.0) if topic == "log"]
    told = [line["msg"] for line in log if line["level"] >= 30]
    assert any(line.startswith("out of memory") for line in told)
    assert robot.host.nodes["navigation"].restarts >= 1
    assert robot.host.is_working("navigation")
