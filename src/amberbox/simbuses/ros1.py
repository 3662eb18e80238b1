"""ROS 1: a node that publishes what has a standard type, with its real names and rates."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import NodeSettings, RosError, chosen_master
from amberbox.blackbox.sources.ros1.message_type import MessageType, message_type
from amberbox.blackbox.sources.ros1.node import RosNode
from amberbox.blackbox.sources.ros1.topic_server import OfferedTopic, Patience
from amberbox.sim.buses import BusSetup
from amberbox.sim.robot import Robot
from amberbox.sim.topics import WHEELS

Fields: TypeAlias = dict[str, Any]
_CALL_S = 5.0
_QUEUE = 1000  # messages that wait for a slow subscriber
_LEVELS = {10: 1, 20: 2, 30: 4, 40: 8, 50: 16}
_CHARGING, _DISCHARGING = 1, 2
_HEALTH_GOOD, _LI_ION = 1, 2


def open_bus(address: str, setup: BusSetup) -> RosBus:
    """Register as the publisher of all topics; raises AmberboxError if no master answers."""
    return RosBus(address, setup)


@dataclass(frozen=True, slots=True)
class _Output:
    """A topic of ROS: its name, its type, and how its messages are made."""

    name: str
    type: str
    make: Callable[[Mapping[str, Any]], Fields]


class RosBus:
    """A node that publishes to whoever has subscribed; slow subscribers lose the oldest."""

    def __init__(self, master_uri: str, setup: BusSetup) -> None:
        name = f"/{setup.robot_id.replace('.', '_').replace('-', '_')}"
        uri = chosen_master(master_uri, os.environ)
        settings = NodeSettings(uri, name, timeout_s=_CALL_S)
        self._stopped = threading.Event()
        self._node = RosNode(settings, self._within())
        self._kinds: dict[str, MessageType] = {}
        try:
            for topic, output in OUTPUTS.items():
                kind = self._kinds[topic] = message_type(output.type)
                offer = OfferedTopic(output.name, output.type, kind, queue=_QUEUE)
                self._node.advertise(offer, self._within())
        except RosError:
            self._node.close()
            raise

    def send(self, topic: str, message: Mapping[str, Any]) -> None:
        """Publish a message if its topic has a standard type."""
        output = OUTPUTS.get(topic)
        if output is not None:
            self._node.publish(output.name, self._kinds[topic].encode(output.make(message)))

    def tick(self, robot: Robot, due_ns: int) -> None:
        """Do nothing: ROS has the messages only."""

    def close(self) -> None:
        """Wait until subscribers have taken what was sent, and unregister."""
        self._node.finish(Patience(_CALL_S, self._stopped.is_set))
        self._node.close()

    def _within(self) -> Deadline:
        return Deadline.within(_CALL_S)


def _header(message: Mapping[str, Any]) -> Fields:
    header = message["header"]
    stamp = {"secs": header["stamp"]["sec"], "nsecs": header["stamp"]["nanosec"]}
    return {"seq": header["seq"] % 2**32, "stamp": stamp, "frame_id": header["frame_id"]}


def _imu(message: Mapping[str, Any]) -> Fields:
    names = ("orientation", "angular_velocity", "linear_acceleration")
    return {"header": _header(message), **{name: message[name] for name in names}}


def _scan(message: Mapping[str, Any]) -> Fields:
    body = {name: value for name, value in message.items() if name != "header"}
    return {"header": _header(message), **body}


def _odom(message: Mapping[str, Any]) -> Fields:
    return {
        "header": _header(message), "child_frame_id": message["child_frame_id"],
        "pose": {"pose": message["pose"]}, "twist": {"twist": message["twist"]},
    }  # fmt: skip


def _cmd_vel(message: Mapping[str, Any]) -> Fields:
    return {"linear": message["linear"], "angular": message["angular"]}


def _amcl_pose(message: Mapping[str, Any]) -> Fields:
    pose = {"pose": message["pose"], "covariance": message["covariance"]}
    return {"header": _header(message), "pose": pose}


def _battery(message: Mapping[str, Any]) -> Fields:
    return {
        "header": _header(message), "voltage": message["voltage"], "current": message["current"],
        "percentage": message["percentage"] / 100, "present": True,
        "power_supply_status": _CHARGING if message["charging"] else _DISCHARGING,
        "power_supply_health": _HEALTH_GOOD, "power_supply_technology": _LI_ION,
        "cell_voltage": message["cell_voltage"],
    }  # fmt: skip


def _joints(message: Mapping[str, Any]) -> Fields:
    """Return the eight drives and four pivots: angles, rates, and currents as effort."""
    names, position, velocity, effort = [], [], [], []
    for wheel in WHEELS:
        sensors = message["sensors"][wheel]
        for drive in (1, 2):
            names.append(f"{wheel}_drive_{drive}")
            position.append(sensors[f"encoder_{drive}"])
            velocity.append(sensors[f"velocity_{drive}"])
            effort.append(sensors[f"current_{drive}_q"])
        names.append(f"{wheel}_pivot")
        position.append(sensors["encoder_pivot"])
        velocity.append(sensors["velocity_pivot"])
        effort.append(0.0)
    return {
        "header": _header(message), "name": names, "position": position, "velocity": velocity,
        "effort": effort,
    }  # fmt: skip


def _log(message: Mapping[str, Any]) -> Fields:
    return {
        "header": _header(message), "level": _LEVELS[message["level"]],
        "name": f"/{message['name']}", "msg": message["msg"],
    }  # fmt: skip


OUTPUTS: Mapping[str, _Output] = {
    "imu": _Output("/imu/data", "sensor_msgs/Imu", _imu),
    "scan_front": _Output("/scan_front", "sensor_msgs/LaserScan", _scan),
    "scan_rear": _Output("/scan_rear", "sensor_msgs/LaserScan", _scan),
    "odom": _Output("/odom", "nav_msgs/Odometry", _odom),
    "cmd_vel": _Output("/cmd_vel", "geometry_msgs/Twist", _cmd_vel),
    "localisation": _Output("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", _amcl_pose),
    "battery": _Output("/battery", "sensor_msgs/BatteryState", _battery),
    "wheels": _Output("/joint_states", "sensor_msgs/JointState", _joints),
    "log": _Output("/rosout", "rosgraph_msgs/Log", _log),
}
"""The topics of the robot that ROS has a type for."""
