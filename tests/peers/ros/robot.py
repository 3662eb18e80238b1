#!/usr/bin/python3
"""A test robot on rospy that keeps a truth file of everything it publishes.

Run it with Debian's own Python and a clean environment:

    env -i PATH=/usr/bin:/bin ROS_MASTER_URI=http://127.0.0.1:PORT ROS_IP=127.0.0.1 \\
        /usr/bin/python3 tests/peers/ros/robot.py --truth FILE [options]

    --name /robot            node name
    --topics odom,scan,...   which of odom scan imu battery state map clock; all but clock
    --rate odom=200          other rates, Hz; odom 50, scan 10, imu 100, battery 1, state 5,
                             clock 100
    --map-after 0.5          when the latched map is published, seconds after the start
    --map-seed 1             content of the map
    --duration 10            end by itself; else at SIGTERM or SIGINT
    --wait-for 1             begin to publish when every topic has so many subscribers
    --linger 0.3             stay alive after the last message so that queues empty
    --queue-size 100         or ``none``: publish() then waits for every subscriber
    --scan-beams 720         size of a laser scan
    --state-type a           ``b``: /robot/state with another definition (same type name)
    --sim-time               stamps count from 0 with /clock instead of the wall clock

Topics: /robot/odom (nav_msgs/Odometry), /robot/scan (sensor_msgs/LaserScan with inf and nan),
/robot/imu (sensor_msgs/Imu), /robot/battery (sensor_msgs/BatteryState), /robot/state (the custom
type test_robot/WheelState), /robot/map (nav_msgs/OccupancyGrid, latched), /clock.

The truth file holds one JSON object per line, each written with one ``write`` *before* the act:

    {"k": "start", "t": WALL_NS, "name": "/robot", "types": {topic: [type, md5sum]}}
    {"k": "pub", "topic": T, "n": 7, "t": WALL_NS, "stamp": NS, "body": HEX, "size": 704, "subs": 1}
    {"k": "slow", "topic": T, "n": 7, "s": 0.12}       after a publish() that took over 20 ms
    {"k": "sub" | "unsub", "topic": T, "t": WALL_NS}    as rospy tells it
    {"k": "end", "t": WALL_NS, "slowest_s": 0.003}

``body`` is the first 32 digits of the SHA-256 of the serialised message, without its first four
bytes when the type begins with a header: rospy writes ``header.seq`` there for each delivery.
``subs`` counts the connections just before the message is handed to rospy.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import os
import signal
import struct
import sys
import threading
import time
from typing import Any, ClassVar

import genpy
import rospy
from nav_msgs.msg import OccupancyGrid, Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, LaserScan
from std_msgs.msg import Header

RATES = {"odom": 50.0, "scan": 10.0, "imu": 100.0, "battery": 1.0, "state": 5.0, "clock": 100.0}
HEADER_TEXT = """
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""


class WheelState(genpy.Message):  # type: ignore[misc]  # genpy comes without types
    """A custom type as genpy would generate it: four wheels, a status word, text."""

    _type = "test_robot/WheelState"
    _has_header = True
    _full_text = (
        "# State of the four wheels.\n"
        "uint8 OK=0\nuint8 STALLED=2\n"
        "Header header\n"
        "float64[4] velocity  # [rad/s]\n"
        "uint16[] status\n"
        "string mode\n" + HEADER_TEXT
    )
    _md5_text = (
        "uint8 OK=0\nuint8 STALLED=2\n"
        "2176decaecbce78abc3b96ef049fabed header\n"
        "float64[4] velocity\nuint16[] status\nstring mode"
    )
    _md5sum = hashlib.md5(_md5_text.encode()).hexdigest()
    __slots__: ClassVar[list[str]] = ["header", "mode", "status", "velocity"]
    _slot_types: ClassVar[list[str]] = ["std_msgs/Header", "string", "uint16[]", "float64[4]"]

    def __init__(self) -> None:
        self.header = Header()
        self.velocity = [0.0] * 4
        self.status: list[int] = []
        self.mode = ""

    def _get_types(self) -> list[str]:
        return self._slot_types

    def serialize(self, buff: io.BytesIO) -> None:
        self.header.serialize(buff)
        buff.write(struct.pack("<4d", *self.velocity))
        buff.write(struct.pack(f"<I{len(self.status)}H", len(self.status), *self.status))
        mode = self.mode.encode()
        buff.write(struct.pack("<I", len(mode)) + mode)


class OtherWheelState(WheelState):
    """The same type name after a change of its definition: one number more."""

    _full_text = WheelState._full_text.replace("string mode\n", "string mode\nfloat32 current\n", 1)
    _md5_text = WheelState._md5_text + "\nfloat32 current"
    _md5sum = hashlib.md5(_md5_text.encode()).hexdigest()
    __slots__: ClassVar[list[str]] = ["current"]

    def __init__(self) -> None:
        super().__init__()
        self.current = 1.5

    def serialize(self, buff: io.BytesIO) -> None:
        super().serialize(buff)
        buff.write(struct.pack("<f", self.current))


class Truth:
    """Appends lines that survive kill -9: one write each, no buffer."""

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)

    def write(self, **fields: Any) -> None:
        os.write(self._fd, (json.dumps(fields) + "\n").encode())


class Listener(rospy.SubscribeListener):  # type: ignore[misc]  # nor does rospy
    """Records when rospy connects and disconnects a subscriber."""

    def __init__(self, truth: Truth) -> None:
        super().__init__()
        self._truth = truth

    def peer_subscribe(self, topic_name: str, topic_publish: Any, peer_publish: Any) -> None:
        self._truth.write(k="sub", topic=topic_name, t=time.time_ns())

    def peer_unsubscribe(self, topic_name: str, num_peers: int) -> None:
        self._truth.write(k="unsub", topic=topic_name, t=time.time_ns())


def body_of(message: Any) -> tuple[str, int]:
    """Digest and size of a serialised message, ``header.seq`` left out."""
    buffer = io.BytesIO()
    message.serialize(buffer)
    data = buffer.getvalue()
    body = data[4:] if getattr(type(message), "_has_header", False) else data
    return hashlib.sha256(body).hexdigest()[:32], len(data)


class Robot:
    """The publishers, and what each message holds."""

    def __init__(self, options: argparse.Namespace, truth: Truth) -> None:
        self.options = options
        self.truth = truth
        self.started = time.monotonic()
        self.counts: dict[str, int] = {}
        self.slowest_s = 0.0
        self.listener = Listener(truth)
        self.publishers = {name: self.advertise(name) for name in options.topics}

    def advertise(self, name: str) -> Any:
        kinds = {
            "odom": Odometry,
            "scan": LaserScan,
            "imu": Imu,
            "battery": BatteryState,
            "state": WheelState if self.options.state_type == "a" else OtherWheelState,
            "map": OccupancyGrid,
            "clock": Clock,
        }
        return rospy.Publisher(
            topic_of(name),
            kinds[name],
            subscriber_listener=self.listener,
            latch=name == "map",
            queue_size=self.options.queue_size,
        )

    def note_start(self) -> None:
        types = {p.resolved_name: [p.data_class._type, p.md5sum] for p in self.publishers.values()}
        self.truth.write(k="start", t=time.time_ns(), name=rospy.get_name(), types=types)

    def now(self) -> Any:
        """The robot's own time: wall clock, or seconds since the start with --sim-time."""
        if self.options.sim_time:
            return genpy.Time.from_sec(time.monotonic() - self.started)
        now_ns = time.time_ns()
        return genpy.Time(now_ns // 10**9, now_ns % 10**9)

    def publish(self, name: str) -> None:
        n = self.counts[name] = self.counts.get(name, 0) + 1
        stamp = self.now()
        message = getattr(self, "make_" + name)(n, stamp)
        publisher = self.publishers[name]
        body, size = body_of(message)
        topic = publisher.resolved_name
        subs = publisher.get_num_connections()
        fields = {"stamp": stamp.to_nsec(), "body": body, "size": size, "subs": subs}
        self.truth.write(k="pub", topic=topic, n=n, t=time.time_ns(), **fields)
        began = time.monotonic()
        publisher.publish(message)
        took_s = time.monotonic() - began
        self.slowest_s = max(self.slowest_s, took_s)
        if took_s > 0.02:
            self.truth.write(k="slow", topic=topic, n=n, s=round(took_s, 4))

    def make_odom(self, n: int, stamp: Any) -> Any:
        message = Odometry()
        message.header.stamp = stamp
        message.header.frame_id = "odom"
        message.child_frame_id = "base_link"
        message.pose.pose.position.x = n * 0.01
        message.pose.pose.position.y = math.sin(n * 0.05)
        message.pose.pose.orientation.w = 1.0
        message.pose.covariance = [i * 0.001 for i in range(36)]
        message.twist.twist.linear.x = float(n)
        return message

    def make_scan(self, n: int, stamp: Any) -> Any:
        beams = self.options.scan_beams
        message = LaserScan()
        message.header.stamp = stamp
        message.header.frame_id = "laser"
        message.angle_increment = 2 * math.pi / beams
        ranges = [1.0 + (i + n) % 100 * 0.01 for i in range(beams)]
        ranges[n % beams] = math.inf
        ranges[(n + 7) % beams] = math.nan
        message.ranges = ranges
        message.intensities = [float(n)] * (beams // 2)
        return message

    def make_imu(self, n: int, stamp: Any) -> Any:
        message = Imu()
        message.header.stamp = stamp
        message.header.frame_id = "imu"
        message.angular_velocity.z = math.cos(n * 0.02)
        message.linear_acceleration.x = float(n)
        message.orientation_covariance[0] = -1.0
        return message

    def make_battery(self, n: int, stamp: Any) -> Any:
        message = BatteryState()
        message.header.stamp = stamp
        message.voltage = 48.0 - n * 0.001
        message.percentage = math.nan
        message.cell_voltage = [4.0, 4.1, math.inf]
        message.serial_number = f"B-{n}"
        return message

    def make_state(self, n: int, stamp: Any) -> Any:
        message = self.publishers["state"].data_class()
        message.header.stamp = stamp
        message.velocity = [n + wheel / 10.0 for wheel in range(4)]
        message.status = [0, 2, n % 65536]
        message.mode = f"driving ü {n}"
        return message

    def make_map(self, n: int, stamp: Any) -> Any:
        message = OccupancyGrid()
        message.header.frame_id = "map"
        message.header.stamp = stamp
        message.info.resolution = 0.05
        message.info.width = message.info.height = 100
        message.data = [(i * self.options.map_seed) % 101 for i in range(100 * 100)]
        return message

    def make_clock(self, n: int, stamp: Any) -> Any:
        return Clock(clock=stamp)


def topic_of(name: str) -> str:
    return "/clock" if name == "clock" else "/robot/" + name


def next_due(due: dict[str, float], now: float) -> tuple[str, float]:
    name = min(due, key=lambda name: due[name])
    return name, max(0.0, due[name] - now)


def wait_for_subscribers(robot: Robot, stop: threading.Event) -> None:
    while robot.options.wait_for and not stop.is_set():
        counts = [publisher.get_num_connections() for publisher in robot.publishers.values()]
        if min(counts) >= robot.options.wait_for:
            return
        stop.wait(0.01)


def run(robot: Robot, stop: threading.Event) -> None:
    """Publish by schedule until it is stopped or the time is over."""
    options = robot.options
    began = time.monotonic()
    due = {name: began for name in options.topics if name != "map"}
    if "map" in options.topics:
        due["map"] = began + options.map_after
    while due and not stop.is_set():
        now = time.monotonic()
        if options.duration and now - began >= options.duration:
            return
        name, wait_s = next_due(due, now)
        if wait_s and stop.wait(min(wait_s, 0.2)):
            return
        if time.monotonic() >= due[name]:
            robot.publish(name)
            due[name] += 1.0 / options.rates[name] if name != "map" else math.inf


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="A test robot on rospy.")
    parser.add_argument("--truth", required=True)
    parser.add_argument("--name", default="/robot")
    parser.add_argument("--topics", default="odom,scan,imu,battery,state,map")
    parser.add_argument("--rate", action="append", default=[])
    parser.add_argument("--map-after", type=float, default=0.5)
    parser.add_argument("--map-seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=0.0)
    parser.add_argument("--wait-for", type=int, default=0)
    parser.add_argument("--linger", type=float, default=0.3)
    parser.add_argument("--queue-size", default="100")
    parser.add_argument("--scan-beams", type=int, default=720)
    parser.add_argument("--state-type", choices=["a", "b"], default="a")
    parser.add_argument("--sim-time", action="store_true")
    options = parser.parse_args(arguments)
    options.topics = [name for name in options.topics.split(",") if name]
    options.rates = dict(RATES, **{k: float(v) for k, v in (r.split("=") for r in options.rate)})
    options.queue_size = None if options.queue_size == "none" else int(options.queue_size)
    return options


def main() -> None:
    options = parse(sys.argv[1:])
    truth = Truth(options.truth)
    stop = threading.Event()
    rospy.init_node(options.name.strip("/"), disable_signals=True, anonymous=False)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    robot = Robot(options, truth)
    robot.note_start()
    wait_for_subscribers(robot, stop)
    run(robot, stop)
    time.sleep(options.linger)
    truth.write(k="end", t=time.time_ns(), slowest_s=round(robot.slowest_s, 4))
    rospy.signal_shutdown("done")


if __name__ == "__main__":
    main()
