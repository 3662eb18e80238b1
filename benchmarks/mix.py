"""The messages that benchmarks write: one second of a robot's buses, over and over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from amberbox.core.types import Schema, Topic

START_NS = 1_700_000_000_000_000_000
RATES_HZ = {
    "nav_msgs/msg/Odometry": 100,
    "sensor_msgs/msg/Imu": 100,
    "sensor_msgs/msg/JointState": 100,
    "geometry_msgs/msg/Pose": 100,
    "sensor_msgs/msg/LaserScan": 20,
    "diagnostic_msgs/msg/DiagnosticArray": 1,
}


@dataclass(frozen=True)
class Mix:
    """Messages in the order of time: which topic, when, what."""

    topics: list[Topic]
    numbers: list[int]
    times_ns: list[int]
    messages: list[bytes]

    @property
    def bytes(self) -> int:
        return sum(map(len, self.messages))


def store() -> Any:
    """Return the type store the messages are made with."""
    return get_typestore(Stores.ROS1_NOETIC)


def make(seconds: int, seed: int = 1) -> Mix:
    """Make so many seconds of the mix, as ROS 1 messages of plausible content."""
    types, rng = store(), np.random.default_rng(seed)
    rows: list[tuple[int, int, bytes]] = []
    topics = []
    for number, (name, rate_hz) in enumerate(RATES_HZ.items()):
        ros1_name = name.replace("/msg/", "/")
        definition, _ = types.generate_msgdef(name, ros_version=1)
        topics.append(Topic(f"/{ros1_name.split('/')[1].lower()}", "ros1",
                            Schema(ros1_name, "ros1msg", definition.encode())))  # fmt: skip
        for k in range(seconds * rate_hz):
            at_ns = START_NS + k * 10**9 // rate_hz + number * 1000
            message = make_message(types, name, k, at_ns, rng)
            rows.append((at_ns, number, bytes(types.serialize_ros1(message, name))))
    rows.sort(key=lambda row: row[0])
    times, numbers, messages = zip(*rows, strict=True)
    return Mix(topics, list(numbers), list(times), list(messages))


def make_message(types: Any, name: str, k: int, at_ns: int, rng: np.random.Generator) -> Any:
    """Make one message of a robot that drives a curve."""
    t = types.types
    stamp = t["builtin_interfaces/msg/Time"](at_ns // 10**9, at_ns % 10**9)
    header = t["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="base_link")
    vector, quaternion = t["geometry_msgs/msg/Vector3"], t["geometry_msgs/msg/Quaternion"]
    noise = rng.normal(0, 0.01, 12)
    pose = t["geometry_msgs/msg/Pose"](
        t["geometry_msgs/msg/Point"](k * 0.01 + noise[0], np.sin(k * 0.01) + noise[1], 0.0),
        quaternion(0.0, 0.0, np.sin(k * 0.005), np.cos(k * 0.005)),
    )
    kind = name.rpartition("/")[2]
    if kind == "Pose":
        return pose
    if kind == "Odometry":
        covariance = np.zeros(36)
        covariance[::7] = 0.01
        twist = t["geometry_msgs/msg/Twist"](
            vector(0.5 + noise[2], 0.0, 0.0), vector(0.0, 0.0, noise[3])
        )
        return t[name](
            header, "odom",
            t["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
            t["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
        )  # fmt: skip
    if kind == "Imu":
        nine = np.eye(3).ravel() * 0.01
        return t[name](
            header, pose.orientation, nine, vector(*noise[4:7]), nine,
            vector(noise[7], noise[8], 9.81 + noise[9]), nine,
        )  # fmt: skip
    if kind == "JointState":
        names = [f"joint_{i}" for i in range(12)]
        wave = np.sin(k * 0.01 + np.arange(12))
        return t[name](header, names, wave, wave * 0.1 + noise, noise)
    if kind == "LaserScan":
        ranges = (2 + np.sin(np.arange(720) * 0.01) + rng.normal(0, 0.005, 720)).astype(np.float32)
        return t[name](header, -1.5, 1.5, 0.004, 0.0, 0.05, 0.1, 30.0, ranges,
                       np.zeros(0, np.float32))  # fmt: skip
    value = t["diagnostic_msgs/msg/KeyValue"]
    status = [
        t["diagnostic_msgs/msg/DiagnosticStatus"](
            0, f"unit {i}", "ok", "", [value(f"key {j}", str(k * j)) for j in range(5)]
        )
        for i in range(10)
    ]
    return t[name](header, status)
