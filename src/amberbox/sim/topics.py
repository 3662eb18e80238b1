"""Topics that the simulated robot publishes: rate, frame, shape, publisher, and the codes in them.

The shape of a message is JSON Schema with units, built from short functions.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from amberbox.core.types import Schema, Topic

# of a wheel unit
STATUS_BITS: Mapping[int, str] = {
    0: "operational",
    1: "power stage on",
    2: "emergency stop pressed",
    3: "supply voltage low",
    4: "winding warm",
    5: "drive 1 at its current limit",
    6: "drive 2 at its current limit",
    7: "no setpoint",
}

# names of usual values of these bits, short enough for an axis of a plot
STATUS: Mapping[int, str] = {
    0: "off",
    1: "stage off",
    3: "on",
    5: "stopped",
    8: "brown-out",
    19: "warm",
    35: "limit 1",
    67: "limit 2",
    99: "limit 1+2",
    129: "no orders",
}

LOG_LEVELS: Mapping[int, str] = {
    10: "debug",
    20: "info",
    30: "warning",
    40: "error",
    50: "fatal",
}


Shape = dict[str, Any]


def _unit(shape: Shape, unit: str) -> Shape:
    return {**shape, "unit": unit} if unit else shape


def number(unit: str = "") -> Shape:
    """Return the shape of a floating-point number, also where its value happens to be whole."""
    return _unit({"type": "number"}, unit)


def integer(unit: str = "") -> Shape:
    """Return the shape of a whole number."""
    return _unit({"type": "integer"}, unit)


def code(names: Mapping[int, str]) -> Shape:
    """Return the shape of a whole number whose values have names."""
    return {"type": "integer", "labels": {str(value): name for value, name in names.items()}}


def text() -> Shape:
    """Return the shape of a string."""
    return {"type": "string"}


def flag() -> Shape:
    """Return the shape of a bool."""
    return {"type": "boolean"}


def numbers(unit: str = "", count: int | None = None) -> Shape:
    """Return the shape of a list of numbers, of fixed length when ``count`` is given."""
    shape: Shape = {"type": "array", "items": number(unit)}
    return shape if count is None else {**shape, "minItems": count, "maxItems": count}


def record(**fields: Shape) -> Shape:
    """Return the shape of a structure whose fields are all required."""
    return {
        "type": "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }


def xyz(unit: str) -> Shape:
    """Return the shape of a vector."""
    return record(x=number(unit), y=number(unit), z=number(unit))


def pose() -> Shape:
    """Return the shape of a position and an orientation (quaternion)."""
    turn = record(x=number(), y=number(), z=number(), w=number())
    return record(position=xyz("m"), orientation=turn)


def header() -> Shape:
    """Return the shape of a message header: own stamp, frame and a count without holes."""
    stamp = record(sec=integer("s"), nanosec=integer("ns"))
    return record(seq=integer(), stamp=stamp, frame_id=text())


def leaves(shape: Mapping[str, Any], path: str = "") -> list[tuple[str, str, str]]:
    """Return the leaves of a shape as (path, type, unit)."""
    if shape["type"] == "object":
        below = shape["properties"].items()
        return [leaf for key, value in below for leaf in leaves(value, f"{path}.{key}".lstrip("."))]
    if shape["type"] == "array":
        size = shape.get("maxItems", "")
        kind = f"{shape['items']['type']}[{size}]"
        return [(path, kind, shape["items"].get("unit", ""))]
    named = ", ".join(f"{value} {name}" for value, name in shape.get("labels", {}).items())
    return [(path, f"{shape['type']} ({named})" if named else shape["type"], shape.get("unit", ""))]


WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
NODES = (
    "base_controller",
    "bus_master",
    "laser_front",
    "laser_rear",
    "imu_driver",
    "localisation",
    "navigation",
    "task_executor",
    "power_monitor",
    "supervisor",
)
CELLS = 7


@dataclass(frozen=True)
class TopicSpec:
    """One topic: its description, its rate in Hz (0: on events), and its fields."""

    name: str
    rate_hz: float
    frame_id: str
    node: str
    description: str
    body: Shape

    def shape(self) -> Shape:
        """Return the JSON Schema of the whole message, header included."""
        whole = record(header=header(), **self.body["properties"])
        return {**whole, "title": self.name, "description": self.description}

    def topic(self) -> Topic:
        """Return the topic as a source announces it."""
        data = json.dumps(self.shape(), separators=(",", ":")).encode()
        return Topic(self.name, "json", Schema(f"amberbox_sim/{self.name}", "jsonschema", data))


def _drive(index: int) -> dict[str, Shape]:
    currents = {f"current_{index}_{axis}": number("A") for axis in "dquvw"}
    voltages = {f"voltage_{index}{axis}": number("V") for axis in ("", "_u", "_v", "_w")}
    return {
        f"encoder_{index}": number("rad"),
        f"velocity_{index}": number("rad/s"),
        **currents,
        **voltages,
        f"temperature_{index}": number("°C"),
    }


def _wheel_sensors() -> Shape:
    return record(
        status1=code(STATUS),
        status2=integer(),
        sensor_ts=integer("us"),
        setpoint_ts=integer("us"),
        **_drive(1),
        **_drive(2),
        encoder_pivot=number("rad"),
        velocity_pivot=number("rad/s"),
        voltage_bus=number("V"),
        imu_ts=integer("us"),
        **{f"accel_{axis}": number("m/s^2") for axis in "xyz"},
        **{f"gyro_{axis}": number("rad/s") for axis in "xyz"},
        temperature_imu=number("°C"),
        pressure=number("hPa"),
    )


def _wheel_commands() -> Shape:
    limits = {f"limit{i}_{sign}": number("A") for i in (1, 2) for sign in "pn"}
    setpoints = {f"setpoint{i}": number("rad/s") for i in (1, 2)}
    return record(command1=integer(), command2=integer(), **setpoints, **limits)


def _scan() -> Shape:
    angles = {f"angle_{part}": number("rad") for part in ("min", "max", "increment")}
    return record(
        **angles,
        time_increment=number("s"),
        scan_time=number("s"),
        range_min=number("m"),
        range_max=number("m"),
        ranges=numbers("m"),
    )


def _node() -> Shape:
    return record(
        pid=integer(),
        beats=integer(),
        restarts=integer(),
        cpu_percent=number("%"),
        rss_mb=number("MB"),
    )


def _wheels(part: Shape) -> Shape:
    return record(**dict.fromkeys(WHEELS, part))


_TWIST = record(linear=xyz("m/s"), angular=xyz("rad/s"))
_TURN = record(x=number(), y=number(), z=number(), w=number())

TOPICS: tuple[TopicSpec, ...] = (
    TopicSpec(
        "imu",
        100,
        "imu",
        "imu_driver",
        "Body acceleration and turn rates.",
        record(
            orientation=_TURN,
            angular_velocity=xyz("rad/s"),
            linear_acceleration=xyz("m/s^2"),
            temperature=number("°C"),
        ),
    ),
    TopicSpec("scan_front", 10, "laser_front", "laser_front", "Front laser.", _scan()),
    TopicSpec("scan_rear", 10, "laser_rear", "laser_rear", "Rear laser.", _scan()),
    TopicSpec(
        "odom",
        50,
        "odom",
        "base_controller",
        "Pose and twist as computed from the four wheel units.",
        record(child_frame_id=text(), pose=pose(), twist=_TWIST),
    ),
    TopicSpec(
        "cmd_vel", 10, "base_link", "navigation", "What navigation wants the base to do.", _TWIST
    ),
    TopicSpec(
        "wheels",
        20,
        "base_link",
        "bus_master",
        "Commands to and sensors of the four wheel units, as on the fieldbus.",
        record(commands=_wheels(_wheel_commands()), sensors=_wheels(_wheel_sensors())),
    ),
    TopicSpec(
        "bus",
        20,
        "",
        "bus_master",
        "Cycle counters of the fieldbus.",
        record(
            cycle=integer(),
            working_counter=integer(),
            expected_working_counter=integer(),
            low_counter_cycles=integer(),
            lost_frames=integer(),
            devices_operational=integer(),
            cycle_time_mean_us=number("us"),
            cycle_time_max_us=number("us"),
        ),
    ),
    TopicSpec(
        "localisation",
        10,
        "map",
        "localisation",
        "Pose on the map with its covariance (x, y, z, roll, pitch, yaw).",
        record(
            pose=pose(),
            covariance=numbers("", 36),
            match_score=number(),
            beams_used=integer(),
        ),
    ),
    TopicSpec(
        "battery",
        2,
        "battery",
        "power_monitor",
        "Battery; the current is negative while it discharges.",
        record(
            voltage=number("V"),
            current=number("A"),
            percentage=number("%"),
            temperature=number("°C"),
            charging=flag(),
            charger_voltage=number("V"),
            cell_voltage=numbers("V", CELLS),
        ),
    ),
    TopicSpec(
        "safety",
        5,
        "base_link",
        "base_controller",
        "Emergency stop and bumpers.",
        record(
            e_stop_pressed=flag(),
            bumper_front=flag(),
            bumper_rear=flag(),
            drives_enabled=flag(),
        ),
    ),
    TopicSpec(
        "state",
        2,
        "",
        "task_executor",
        "What the robot is doing.",
        record(
            mode=text(),
            task_id=text(),
            stage=text(),
            floor=integer(),
            cart_attached=flag(),
            goal=text(),
            distance_to_goal=number("m"),
        ),
    ),
    TopicSpec(
        "tasks",
        0,
        "",
        "task_executor",
        "Events of tasks: started, stage, finished, aborted.",
        record(
            task_id=text(),
            kind=text(),
            event=text(),
            stage=text(),
            location=text(),
            cart=text(),
            elapsed_s=number("s"),
        ),
    ),
    TopicSpec(
        "wifi",
        1,
        "",
        "supervisor",
        "Wireless link.",
        record(
            connected=flag(),
            access_point=text(),
            signal_dbm=number("dBm"),
            quality=number("%"),
            bit_rate=number("Mbit/s"),
            latency=number("ms"),
            retries=integer(),
        ),
    ),
    TopicSpec(
        "host",
        1,
        "",
        "supervisor",
        "The robot's computer.",
        record(
            cpu_percent=number("%"),
            cpu_temperature=number("°C"),
            memory_used_mb=number("MB"),
            memory_total_mb=number("MB"),
            disk_used_mb=number("MB"),
            disk_total_mb=number("MB"),
            load_1min=number(),
            uptime=number("s"),
        ),
    ),
    TopicSpec(
        "nodes",
        1,
        "",
        "supervisor",
        "The software processes: identifier, life signs, restarts and what they use.",
        record(**dict.fromkeys(NODES, _node())),
    ),
    TopicSpec(
        "log",
        0,
        "",
        "supervisor",
        "Log messages.",
        record(level=code(LOG_LEVELS), name=text(), msg=text()),
    ),
)
TOPIC_BY_NAME = {spec.name: spec for spec in TOPICS}
