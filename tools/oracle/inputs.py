"""Files that the oracle gives to both sides: recordings in foreign formats, models, mistakes."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

START_NS = 1_767_600_000_000_000_000
NS = 1_000_000_000

CSV = """\
time,speed,state,note
2026-01-05T08:00:00Z,0.5,1,start
2026-01-05T08:00:01Z,0.75,1,
2026-01-05T08:00:02Z,-0.25,2,"a, b"
2026-01-05T08:00:03.5Z,nan,2,=1+1
"""
CSV_BROKEN = "time;x\n1;2\nfoo;3\n3;4\n3;5\n"
RULES = """\
motor(m1). motor(m2). hot(m1). next(m1, m2).
broken(X) :- motor(X), hot(X).
beside(X, Y) :- next(X, Y).
beside(X, Y) :- next(X, Z), beside(Z, Y).
sound(X) :- motor(X), \\+ broken(X).
sum(N) :- findall(X, motor(X), L), length(L, N).
near(X) :- motor(X), X \\== m1.
half(Y) :- Y is 7 // 2 + 3 * 2 - 1.
"""
TREE = """\
<?xml version="1.0"?>
<opsa-mef>
  <define-fault-tree name="robot">
    <define-gate name="stranded">
      <or><gate name="no_drive"/><basic-event name="power"/></or>
    </define-gate>
    <define-gate name="no_drive">
      <atleast min="2">
        <basic-event name="left"/><basic-event name="right"/><basic-event name="rear"/>
      </atleast>
    </define-gate>
  </define-fault-tree>
  <model-data>
    <define-basic-event name="power"><float value="0.001"/></define-basic-event>
    <define-basic-event name="left"><float value="0.1"/></define-basic-event>
    <define-basic-event name="right"><float value="0.1"/></define-basic-event>
    <define-basic-event name="rear"><float value="0.2"/></define-basic-event>
  </model-data>
</opsa-mef>
"""
BAD_FOLDERS = {
    "unknown_source": {"black_box.yaml": "- simm:\n    seed: 1\n"},
    "unknown_key": {"black_box.yaml": "- sim:\n    sed: 1\n    speeed: max\n    seed: x\n"},
    "bad_values": {
        "black_box.yaml": "- sim:\n    speed: -1\n    scenario: transprot\n    duration_s: 0\n"
        "    faults: [{id: wifi_week}, {id: wifi_weak, at_s: -1, magnitude: 1000}]\n"
        "    topics: [{name: odomm}]\n",
        "robot.yaml": "id: Ro bot\nstore: {quota: 5 parsecs, keep_min: 3 lightyears, ring: 1}\n",
    },
    "no_yaml": {"black_box.yaml": "- sim: [\n"},
    "no_files": {"notes.txt": "nothing\n"},
    "bad_missions": {
        "black_box.yaml": "- sim:\n    speed: max\n",
        "robot.yaml": "id: r\nmissions:\n  - name: m\n    start: sim_state.mode ==\n"
        "    end: sim_stat.mode == 1\ntriggers:\n  - name: t\n  - name: u\n    when: 1 +\n",
    },
    "bad_components": {
        "black_box.yaml": "- sim:\n    speed: max\n",
        "components/imu.yaml": "component_name: imu\nmodes: [imu/a.yaml, imu/b.yaml]\n"
        "dependencies: [nobody]\n",
        "components/imu/a.yaml": "name: a\nmonitor: rang\nmappings: []\n",
        "components/imu/b.yaml": "name: b\nmonitor: range\nmappings:\n  - mapping:\n"
        "      inputs: [sim_imu.temperature]\n      outputs:\n        - output:\n"
        "            name: x\n            type: bool\n            result: nothing\n"
        "arguments: {min: 3, max: 1, foo: 2}\n",
    },
}
"""Robot folders with mistakes: files by name."""


def write_all(folder: Path) -> None:
    """Write every input below a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "drive.csv": CSV, "broken.csv": CSV_BROKEN, "rules.pl": RULES, "tree.xml": TREE,
        "bad.pl": "broken(X :- y.\nok(1).\n", "bad.xml": "<opsa-mef><define-gate/></opsa-mef>",
        "stamps.csv": "t_s,a,b\n0.0,1,x\n0.1,2,y\n0.2,3,z\n",
        "bad.mcap": "no recording at all\n",
    }  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_text(text)
    for name, files in BAD_FOLDERS.items():
        for path, text in files.items():
            target = folder / "folders" / name / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text)
    (folder / "flight.ulg").write_bytes(ulog())
    mongodump(folder / "dump")
    bags(folder)


def ulog() -> bytes:
    """Return a small ULog file: one topic with two instances, a parameter, a text."""

    def message(kind: bytes, data: bytes) -> bytes:
        return struct.pack("<Hc", len(data), kind) + data

    parts = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", 1_000_000)]
    parts.append(message(b"B", bytes(40)))
    parts.append(message(b"F", b"state:uint64_t timestamp;float x;int32_t[2] n;uint8_t mode;"))
    parts.append(message(b"I", bytes([16]) + b"char[6] sys_nameoracle"))
    for number in range(2):
        parts.append(message(b"A", struct.pack("<BH", number, number) + b"state"))
    for step in range(20):
        data = struct.pack("<QfiiB", 1_000_000 + step * 50_000, step / 4, step, -step, step % 3)
        parts.append(message(b"D", struct.pack("<H", step % 2) + data))
    parts.append(message(b"L", b"6" + struct.pack("<Q", 1_500_000) + b"half way"))
    return b"".join(parts)


def mongodump(folder: Path) -> None:
    """Write a dump of two collections as a ROPOD black box leaves them."""
    import bson

    folder.mkdir(parents=True, exist_ok=True)
    identity = {"_id": bson.ObjectId(b"\x69\x5b" + bytes(10))}
    metadata = {
        **identity, "collection_name": "ros_ropod_cmd_vel",
        "ros": {"topic_name": "/ropod/cmd_vel", "msg_type": "geometry_msgs/Twist",
                "direct_msg_mapping": True},
    }  # fmt: skip
    (folder / "black_box_metadata.bson").write_bytes(bson.encode(metadata))
    moves = b"".join(
        bson.encode({
            **identity, "timestamp": 1_767_600_000.0 + step / 8,
            "linear": {"x": step / 4, "y": 0.0, "z": 0.0},
            "angular": {"x": 0.0, "y": 0.0, "z": -step / 8},
        })
        for step in range(16)
    )  # fmt: skip
    (folder / "ros_ropod_cmd_vel.bson").write_bytes(moves)
    loose = b"".join(
        bson.encode({**identity, "timestamp": 1_767_600_000.0 + step, "error": {"code": step}})
        for step in range(4)
    )
    (folder / "zmq_base_error.bson").write_bytes(loose + b"\x10\x00")


def bags(folder: Path) -> None:
    """Write a ROS 1 bag and a ROS 2 bag with a twist and a laser scan."""
    import numpy as np
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    def fill(writer: Any, store: Any, serialise: Any, header: Any) -> None:
        twist, scan = "geometry_msgs/msg/Twist", "sensor_msgs/msg/LaserScan"
        known, time = store.types, store.types["builtin_interfaces/msg/Time"]
        to_twist = writer.add_connection("/cmd_vel", twist, typestore=store)
        to_scan = writer.add_connection("/scan", scan, typestore=store)
        vector = known["geometry_msgs/msg/Vector3"]
        for step in range(20):
            at_ns = START_NS + step * 100_000_000
            message = known[twist](vector(step / 4, 0.0, 0.0), vector(0.0, 0.0, -step / 8))
            writer.write(to_twist, at_ns, serialise(message, twist))
            stamp = header(step, time(*divmod(at_ns - 1000, NS)), "laser")
            rays = np.linspace(0.5, 4.0, 9, dtype=np.float32) + np.float32(step)
            message = known[scan](
                stamp, -1.0, 1.0, 0.25, 0.0, 0.1, 0.0, 25.0, rays, np.zeros(0, np.float32)
            )
            writer.write(to_scan, at_ns + 7, serialise(message, scan))

    one = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(folder / "drive.bag") as writer:
        fill(writer, one, one.serialize_ros1, one.types["std_msgs/msg/Header"])
    two = get_typestore(Stores.ROS2_HUMBLE)
    kind: Any = two.types["std_msgs/msg/Header"]
    with rosbag2.Writer(folder / "drive_ros2", version=8) as writer2:
        fill(writer2, two, two.serialize_cdr, lambda seq, stamp, frame: kind(stamp, frame))
