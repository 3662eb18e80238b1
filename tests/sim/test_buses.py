"""The real buses of the simulated robot: each with a peer of its own, all from one world."""

from __future__ import annotations

import json
import os
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import paho.mqtt.client as paho
import pytest
import yaml
from paho.mqtt.enums import CallbackAPIVersion

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.robot_folder.folder import load_folder, planned_items
from amberbox.blackbox.sources import ethercat
from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import NodeSettings
from amberbox.blackbox.sources.ros1.node import RosNode, TopicWish
from amberbox.core.config import build
from amberbox.core.errors import AmberboxError
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.sim.__main__ import main
from amberbox.sim.buses import BusSetup, RobotBus, open_bus
from amberbox.sim.live import LiveRun, publish
from amberbox.sim.robot import Robot
from amberbox.simbuses.can import FRAMES, dbc
from amberbox.simbuses.ethercat import (
    COMMANDS,
    INPUT_ELEMENTS,
    LOGICAL_ADDRESS,
    OUTPUT_ELEMENTS,
    SENSORS,
)
from amberbox.simbuses.ros1 import OUTPUTS
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import observe
from tests.sim.commanded import digest
from tests.support.can_bus import MulticastBus, columns_of
from tests.support.ethercat_segment import (
    datagrams,
    give_room,
    listening,
    received,
    veth_pair,
    write_pcap,
)
from tests.support.manual_recorder import recording
from tests.support.processes import free_port
from tests.support.ros_network import RosMaster

EXAMPLE = Path(__file__).parents[2] / "examples" / "sim_buses"
SETUP = BusSetup("rob", 7)
AT_ONCE = BusSetup("rob", 7, None)
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root makes interfaces")


def run(robot: Robot, seconds: float, *buses: RobotBus, speed: Any = "max") -> None:
    """Let a robot live for some seconds, and leave its buses."""
    plan = LiveRun(speed, robot.now_s + seconds)
    publish(robot, None, plan, queue.SimpleQueue(), threading.Event(), None, buses)


def messages_of(robot: Robot, seconds: float, *topics: str) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {topic: [] for topic in topics}
    for topic, _, message in robot.step_until(seconds):
        if topic in found:
            found[topic].append(message)
    return found


class _Nothing:
    """A bus without a peer."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def send(self, topic: str, message: Any) -> None:
        self.sent.append((topic, 0, message))

    def tick(self, robot: Robot, due_ns: int) -> None:
        pass

    def close(self) -> None:
        pass


# -- ROS 1


def test_ros_gets_standard_types_with_the_values_of_the_world(tmp_path: Path) -> None:
    """A folder listens with the real source; what it records is what the robot published."""
    master = RosMaster()
    topics = "".join(f"      - topic: {{name: {output.name}}}\n" for output in OUTPUTS.values())
    (tmp_path / "black_box.yaml").write_text(
        f"- ros:\n    ros_master_uri: {master.uri}\n    topics:\n{topics}"
    )
    bus = open_bus("ros1", master.uri, SETUP)
    node: Any = getattr(bus, "_node")  # noqa: B009  # to see who is connected
    robot = Robot(7, "rob")
    with recording(tmp_path):
        wait_until(lambda: all(node.connected(o.name) for o in OUTPUTS.values()))
        run(robot, 2.0, bus, speed=2.0)
        bus.close()
    master.stop()
    record = amberbox.open(tmp_path / "store")
    types = {i.topic: i.type for i in record.items() if i.name.startswith("ros_")}
    assert types.items() <= {o.name: o.type for o in OUTPUTS.values()}.items()
    assert len(types) >= 8  # nothing may have been logged
    names = ("odom", "scan_front", "cmd_vel", "battery", "localisation", "imu")
    expected = messages_of(Robot(7, "rob"), 2.0, *names)
    odom = record.query("ros_odom", ["pose_pose_position_x", "twist_twist_linear_x", "header_seq"])
    assert odom.values("header_seq") == [m["header"]["seq"] for m in expected["odom"]]
    assert odom.values("pose_pose_position_x") == [
        m["pose"]["position"]["x"] for m in expected["odom"]
    ]
    scans: list[Any] = record.query("ros_scan_front", ["ranges"]).values("ranges")
    sent: list[Any] = [np.float32(m["ranges"]).tolist() for m in expected["scan_front"]]
    assert sent == [list(scan) for scan in scans]
    percent = record.query("ros_battery", ["percentage"]).values("percentage")
    assert percent == [float(np.float32(m["percentage"] / 100)) for m in expected["battery"]]
    covariance = record.query("ros_amcl_pose", ["pose_covariance_35"])
    assert covariance.values("pose_covariance_35") == [
        m["covariance"][35] for m in expected["localisation"]
    ]
    assert len(record.query("ros_imu_data")) == len(expected["imu"])


def test_without_a_master_there_is_an_error() -> None:
    with pytest.raises(AmberboxError, match=r"127\.0\.0\.1"):
        open_bus("ros1", f"http://127.0.0.1:{free_port()}", SETUP)


# -- EtherCAT


@needs_root
def test_each_cycle_is_a_frame_out_and_a_frame_back(tmp_path: Path) -> None:
    with veth_pair() as (near, far), listening(far) as receiver:
        robot = Robot(7, "rob")
        run(robot, 0.5)
        bus = open_bus("ethercat", near, AT_ONCE)
        run(robot, 0.2, bus)
        bus.close()
        frames = received(receiver)
    assert len(frames) == 400
    out, back = frames[::2], frames[1::2]
    assert {frame[6] for frame in out} == {0x10} and {frame[6] for frame in back} == {0x12}
    for number, (sent, answer) in enumerate(zip(out, back, strict=True)):
        lrw, status = datagrams(sent)
        assert (lrw.command, lrw.index, lrw.address) == (12, number % 256, LOGICAL_ADDRESS)
        assert (lrw.counter, status.counter) == (0, 0)
        returned, state = datagrams(answer)
        assert (returned.counter, state.command, state.counter) == (12, 7, 4)
        assert state.data == b"\x08\0"
        assert returned.data[: 4 * 36] == lrw.data[: 4 * 36]
        units = np.frombuffer(returned.data[4 * 36 :], SENSORS)
        assert units["status2"].tolist() == [number] * 4
    last = np.frombuffer(datagrams(back[-1])[0].data[4 * 36 :], SENSORS)
    for place, unit in enumerate(robot.base.units.values()):
        assert last[place]["status1"] == unit.status()
        assert last[place]["encoder_1"] == pytest.approx(unit.drive_1.measured_angle, abs=1e-6)
        assert last[place]["voltage_bus"] == pytest.approx(unit.voltage_v, abs=0.3)
    path = tmp_path / "run.pcap"
    write_pcap(path, frames)
    shown = subprocess.run(
        ["tshark", "-r", path, "-T", "fields", "-E", "separator=;", "-e", "ecat.cmd",
         "-e", "ecat.lad", "-e", "ecat.cnt"],
        capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    assert shown == ["0x0c,0x07;0x00010000;0,0", "0x0c,0x07;0x00010000;12,4"] * 200


@needs_root
def test_a_unit_whose_plug_is_off_lowers_the_counter_and_keeps_its_last_values() -> None:
    with veth_pair() as (near, far), listening(far) as receiver:
        robot = Robot(7, "rob")
        run(robot, 3.0)
        bus = open_bus("ethercat", near, AT_ONCE)
        run(robot, 0.1, bus)
        robot.inject("wheel_rear_left_bus_disconnected")
        robot.inject("bus_frame_loss", magnitude=0.5)
        run(robot, 1.0, bus)
        bus.close()
        frames = [frame for frame in received(receiver) if frame[6] == 0x12]
    counters = [datagrams(frame)[0].counter for frame in frames]
    assert set(counters[:100]) == {12} and set(counters[100:]) == {9}
    assert 250 < len(frames) - 100 < 750  # half of the cycles did not come back
    images = [np.frombuffer(datagrams(frame)[0].data[4 * 36 :], SENSORS) for frame in frames]
    gone = [image[2].tobytes() for image in images]
    assert len(set(gone[99:])) == 1 and len(set(gone[:100])) == 100
    assert len({image[1].tobytes() for image in images}) == len(images)


@needs_root
def test_cycles_come_at_a_kilohertz() -> None:
    """Nothing is timed: as many cycles as milliseconds of the robot, spread over its time."""
    with veth_pair() as (near, far), listening(far) as receiver:
        bus = open_bus("ethercat", near, SETUP)
        run(Robot(7, "rob"), 1.0, bus, speed=1.0)
        at_the_end = len(received(receiver))
        bus.close()
        rest = len(received(receiver))
    assert at_the_end + rest == 2000
    assert at_the_end > 0


@needs_root
def test_the_source_reads_it_with_the_block_of_the_example() -> None:
    blocks = yaml.safe_load((EXAMPLE / "ethercat.yaml").read_text())
    with veth_pair() as (near, far):
        blocks[0]["ethercat"]["interfaces"][0]["interface_specification"]["interface"] = far
        node = parse_yaml(json.dumps(blocks[0]["ethercat"]), "ethercat.yaml", [])
        config = node and build(ethercat.Config, node, [])
        assert config
        with observe(ethercat.Source(config, "ethercat")) as sink:
            wait_until(lambda: sink.events, "it listens")
            robot = Robot(7, "rob")
            run(robot, 0.5)
            bus = open_bus("ethercat", near, SETUP)
            run(robot, 0.5, bus, speed=1.0)
            bus.close()
            sink.wait_for("bus", 500)
            sink.wait_for("output", 500)
    assert sink.losses == []
    topic = next(topic for topic in sink.topics if topic.name == "output")
    last = [data for stream, data, _ in sink.messages if sink.topics[stream] == topic][-1]
    columns = columns_of(unroller(topic).rows([last]))
    for place, unit in enumerate(robot.base.units.values()):
        angle = unit.drive_1.measured_angle
        assert columns[f"slaves_{place}_encoder_1"] == [pytest.approx(angle, abs=1e-6)]


@pytest.mark.needs_data
def test_the_elements_are_those_of_the_paper(shared_data: Path) -> None:
    path = shared_data / "ropod/black_box_configs/data_sources-2018-09-14-with-ethercat.yaml"
    blocks = yaml.safe_load(path.read_text())
    (block,) = (block["ethercat"] for block in blocks if "ethercat" in block)
    interface = block["interfaces"][0]["interface_specification"]
    for kind, record in (("output", SENSORS), ("input", COMMANDS)):
        elements = [entry["element"] for entry in interface[f"{kind}_message_elements"]]
        assert [element["name"] for element in elements] == list(record.names or ())
        sizes = {"uint16": 2, "uint64": 8, "float": 4}
        assert [sizes[element["type"]] for element in elements] == [
            record[name].itemsize for name in record.names or ()
        ]
        assert interface[f"{kind}_message_size"] == record.itemsize


def test_a_missing_interface_is_an_error() -> None:
    with pytest.raises(AmberboxError, match=r"no_such|CAP_NET_RAW"):
        open_bus("ethercat", "no_such", SETUP)


# -- CAN


def frames_of(peer: Any, count: int) -> list[can.Message]:
    found: list[can.Message] = []
    while len(found) < count:
        message = peer.recv(PATIENCE_S)
        assert message is not None, f"{len(found)} of {count} frames"
        found.append(message)
    return found


def test_can_carries_drives_and_battery_as_its_dbc_file_says() -> None:
    known: Any = cantools.database.load_string(dbc(), "dbc")
    assert {m.frame_id: (m.name, m.length) for m in known.messages} == {
        frame.id: (frame.name, sum(s.bits for s in frame.signals) // 8) for frame in FRAMES
    }
    with MulticastBus(free_port()) as network:
        robot = _later(3.0)
        bus = open_bus("can", f"{_host(network.group)}:{network.port}", SETUP)
        run(robot, 0.5, bus)
        expected = messages_of(_later(3.0), 3.5, "battery")["battery"]
        found = frames_of(network.peer, 4 * 25 + 4 * 5 + 3 * len(expected))
        bus.close()
    decoded = [(known.get_message_by_frame_id(m.arbitration_id).name,
                known.decode_message(m.arbitration_id, m.data, decode_choices=False))
               for m in found]  # fmt: skip
    drives = [values for name, values in decoded if name == "DRIVES_REAR_RIGHT"]
    unit = robot.base.units["rear_right"]
    assert len(drives) == 25
    assert drives[-1]["VELOCITY_1"] == pytest.approx(unit.drive_1.measured_rate, abs=0.02)
    health = [values for name, values in decoded if name == "HEALTH_REAR_RIGHT"]
    assert len(health) == 5 and health[-1]["STATUS"] == unit.status()
    assert health[-1]["VOLTAGE_BUS"] == pytest.approx(unit.voltage_v, abs=0.5)
    battery = [values for name, values in decoded if name == "BATTERY"]
    assert [b["VOLTAGE"] for b in battery] == [
        pytest.approx(m["voltage"], abs=0.006) for m in expected
    ]
    assert [b["CHARGING"] for b in battery] == [int(m["charging"]) for m in expected]
    cells = {**next(v for name, v in decoded if name == "CELLS_1"),
             **next(v for name, v in decoded if name == "CELLS_2")}  # fmt: skip
    assert list(cells.values()) == [
        pytest.approx(v, abs=0.0006) for v in expected[0]["cell_voltage"]
    ]


def _later(seconds: float) -> Robot:
    robot = Robot(7, "rob")
    for _ in robot.step_until(seconds):
        pass
    return robot


def _host(group: str) -> str:
    return f"[{group}]" if ":" in group else group


@pytest.mark.parametrize("channel", ["127.0.0.1", "no_such_can", "239.1.2.3:x"])
def test_wrong_can_channels_are_errors(channel: str) -> None:
    with pytest.raises(AmberboxError):
        open_bus("can", channel, SETUP)


# -- MQTT


@contextmanager
def broker(folder: Path) -> Iterator[int]:
    """Run a real broker."""
    port = free_port()
    process = subprocess.Popen(["mosquitto", "-p", str(port)], stderr=subprocess.DEVNULL)
    try:
        yield port
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


class Listener:
    """A client of a broker that keeps what it hears."""

    def __init__(self, port: int) -> None:
        self.heard: list[tuple[str, dict[str, Any], bool]] = []
        self._client = paho.Client(CallbackAPIVersion.VERSION2)
        self._client.on_message = self._on_message
        self._client.on_connect = lambda client, *_: client.subscribe("uagv/#", 1)
        self.subscribed = threading.Event()
        self._client.on_subscribe = lambda *_: self.subscribed.set()

        def connected() -> bool:
            try:
                self._client.connect("127.0.0.1", port)
            except OSError:
                return False
            return True

        wait_until(connected, "a broker")
        self._client.loop_start()
        assert self.subscribed.wait(PATIENCE_S)

    def _on_message(self, client: Any, data: Any, message: Any) -> None:
        self.heard.append((message.topic, json.loads(message.payload), message.retain))

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [body for topic, body, _ in self.heard if topic.endswith(f"/{kind}")]

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


def test_mqtt_has_the_state_and_the_connection_of_a_carrier(tmp_path: Path) -> None:
    with broker(tmp_path) as port:
        listener = Listener(port)
        bus = open_bus("mqtt", f"127.0.0.1:{port}", AT_ONCE)
        robot = Robot(7, "rob")
        run(robot, 5.0, bus)
        wait_until(lambda: len(listener.of("state")) == 5)
        robot.inject("wifi_drops", until_s=robot.now_s + 2.0)
        run(robot, 3.0, bus)
        wait_until(lambda: len(listener.of("connection")) >= 3, "broken, and online again")
        run(robot, 2.0, bus)
        bus.close()
        wait_until(lambda: listener.of("connection")[-1]["connectionState"] == "OFFLINE")
        listener.close()
    assert {topic.rpartition("/")[0] for topic, *_ in listener.heard} == {"uagv/v2/amberbox/rob"}
    states = [body["connectionState"] for body in listener.of("connection")]
    assert states == ["ONLINE", "CONNECTIONBROKEN", "ONLINE", "OFFLINE"]
    last = listener.of("state")[4]
    expected = messages_of(Robot(7, "rob"), 5.0, "localisation", "battery", "state")
    assert last["batteryState"]["batteryVoltage"] == expected["battery"][-1]["voltage"]
    assert last["agvPosition"]["x"] == expected["localisation"][-1]["pose"]["position"]["x"]
    assert last["orderId"] == expected["state"][-1]["task_id"]
    assert [body["headerId"] for body in listener.of("state")][:5] == [1, 2, 3, 4, 5]
    assert last["timestamp"].startswith("2026-01-05T08:00:0") and last["timestamp"].endswith("Z")


def test_without_a_broker_there_is_an_error() -> None:
    with pytest.raises(AmberboxError, match="no broker answers"):
        open_bus("mqtt", f"127.0.0.1:{free_port()}", SETUP)


# -- all of them


@needs_root
def test_buses_change_nothing_and_a_fault_shows_on_all(tmp_path: Path) -> None:
    """The same seed gives the same messages, whoever listens; all buses show one world."""
    quiet, listener = _Nothing(), _Nothing()
    alone, robot = Robot(7, "rob"), Robot(7, "rob")
    for each in (alone, robot):
        each.inject("bumper_switch_closed", at_s=0.5)
    run(alone, 2.0, quiet)
    master = RosMaster()
    known: Any = cantools.database.load_string(dbc(), "dbc")
    with ExitStack() as stack:
        near, far = stack.enter_context(veth_pair())
        receiver = stack.enter_context(listening(far))
        network = stack.enter_context(MulticastBus(free_port()))
        with socket.socket(fileno=os.dup(network.peer.fileno())) as receiving:
            give_room(receiving)
        port = stack.enter_context(broker(tmp_path))
        carrier = Listener(port)
        stack.callback(carrier.close)
        addresses = {
            "ros1": master.uri, "ethercat": near, "mqtt": f"127.0.0.1:{port}",
            "can": f"{_host(network.group)}:{network.port}",
        }  # fmt: skip
        buses = [open_bus(name, address, AT_ONCE) for name, address in addresses.items()]
        run(robot, 2.0, *buses, listener)
        for bus in buses:
            bus.close()
        wait_until(lambda: len(carrier.of("state")) == 2)
        on_can = [
            known.decode_message(frame.arbitration_id, frame.data, decode_choices=False)
            for frame in frames_of(network.peer, 400)
        ]
        frames = [frame for frame in received(receiver) if frame[6] == 0x12]
    master.stop()
    assert digest(listener.sent) == digest(quiet.sent)
    pressed = [m["bumper_front"] for topic, _, m in quiet.sent if topic == "safety"]
    assert pressed[0] is False and pressed[-1] is True
    stops = [np.frombuffer(datagrams(f)[0].data[144:], SENSORS)["status1"] & 4 for f in frames]
    assert not stops[0].any() and stops[-1].all()
    health = [int(values["STATUS"]) & 4 for values in on_can if "STATUS" in values]
    assert health[0] == 0 and health[-1] == 4
    assert carrier.of("state")[-1]["safetyState"]["fieldViolation"] is True


@needs_root
def test_the_command_line_speaks_all_buses_at_once(tmp_path: Path) -> None:
    master = RosMaster()
    odom: list[bytes] = []
    node = RosNode(NodeSettings(master.uri, "/listener"), Deadline.within(PATIENCE_S))
    wish = TopicWish("/odom", "nav_msgs/Odometry", lambda name, kind, data: odom.append(data))
    node.subscribe(wish, Deadline.within(PATIENCE_S))
    with ExitStack() as stack:
        near, far = stack.enter_context(veth_pair())
        receiver = stack.enter_context(listening(far))
        network = stack.enter_context(MulticastBus(free_port()))
        with socket.socket(fileno=os.dup(network.peer.fileno())) as receiving:
            give_room(receiving)
        port = stack.enter_context(broker(tmp_path))
        listener = Listener(port)
        stack.callback(listener.close)
        process = subprocess.run(
            [sys.executable, "-m", "amberbox.sim", "--zmq", "tcp://127.0.0.1:*", "--ros1",
             master.uri, "--ethercat", near, "--can", f"{_host(network.group)}:{network.port}",
             "--mqtt", f"127.0.0.1:{port}", "--dbc", str(tmp_path / "base.dbc"), "--robot", "rob",
             "--seed", "7", "--for", "2s", "--truth", str(tmp_path / "truth.jsonl")],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        assert process.returncode == 0, process.stderr
        frames = received(receiver)
        wait_until(lambda: len(listener.of("state")) == 2)
        assert len(frames_of(network.peer, 200)) == 200
    node.close()
    master.stop()
    assert len(frames) > 1000 and {frame[6] for frame in frames} == {0x10, 0x12}
    assert len(odom) > 10
    assert (tmp_path / "base.dbc").read_text() == dbc()
    truth = [json.loads(line) for line in (tmp_path / "truth.jsonl").read_text().splitlines()]
    assert sum(line["topic"] == "odom" for line in truth) == 100


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "nowhere to publish"),
        (["--mqtt", "127.0.0.1:1", "--wait"], "--wait waits for a subscriber"),
        (["--mqtt", "127.0.0.1:x"], "is no address"),
        (["--dbc", "/no/such/folder/base.dbc"], "cannot write"),
    ],
)
def test_mistakes_on_the_command_line(
    arguments: Sequence[str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) in (1, 2)
    assert problem in capsys.readouterr().err


def test_the_example_listens_to_what_the_buses_carry(tmp_path: Path) -> None:
    folder = load_folder(EXAMPLE)
    items = {item.topic: item.type for item in planned_items(folder, [])}
    assert {o.name: o.type for o in OUTPUTS.values()}.items() <= items.items()
    assert (EXAMPLE / "base.dbc").read_text() == dbc()
    (block,) = yaml.safe_load((EXAMPLE / "ethercat.yaml").read_text())
    found = block["ethercat"]["interfaces"][0]["interface_specification"]
    for kind, elements in (("output", OUTPUT_ELEMENTS), ("input", INPUT_ELEMENTS)):
        listed = [entry["element"] for entry in found[f"{kind}_message_elements"]]
        assert [(e["name"], e["type"]) for e in listed] == list(elements.items())
    assert found["output_message_size"] == SENSORS.itemsize
    assert found["input_message_size"] == COMMANDS.itemsize
