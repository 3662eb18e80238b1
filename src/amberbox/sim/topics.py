"""The topics that the simulated robot publishes: rate, frame, shape and who publishes them."""

from __future__ import annotations

import json
from dataclasses import dataclass

from amberbox.core.types import Schema, Topic
from amberbox.sim import shapes
from amberbox.sim.codes import LOG_LEVELS, STATUS
from amberbox.sim.shapes import Shape, code, flag, integer, number, numbers, record, text, xyz

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
    """One topic: what it says, how often (0: when something happens), and its fields."""

    name: str
    rate_hz: float
    frame_id: str
    node: str
    description: str
    body: Shape

    def shape(self) -> Shape:
        """Return the JSON Schema of the whole message, header included."""
        whole = record(header=shapes.header(), **self.body["properties"])
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
        record(child_frame_id=text(), pose=shapes.pose(), twist=_TWIST),
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
            pose=shapes.pose(),
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
