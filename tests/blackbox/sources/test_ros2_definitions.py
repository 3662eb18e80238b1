"""Definitions that robots do not send: from folders and distributions, by their hash."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.columns.ros2_types import DISTRIBUTIONS, definition_of, type_hash
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.sources.ros2_transports import names
from amberbox.blackbox.sources.ros2_transports.definitions import Definitions
from amberbox.core.types import Schema, Topic

LOG = "rcl_interfaces/msg/Log"
# as the tools of ROS 2 Jazzy write them (rosidl, type_description)
KNOWN = {
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}


def columns(schema: Schema) -> list[str]:
    return [column.path for column in unroller(Topic("/t", "cdr", schema)).schema.columns]


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    """A source tree, and a package as it is installed, in a folder of another name."""
    files = {
        "src/own/msg/Wheel.msg": "std_msgs/Header header\nfloat64 speed\nPart[] parts\n",
        "src/own/msg/Part.msg": "# a part\nstring name\n",
        "src/own/action/Fly.action": "float64 height\n---\nbool ok\n---\nPart part\nfloat64 now\n",
        "src/own/srv/Do.srv": "Part part\n---\nbool ok\n",
        "share/x-1/package.xml": "<package><name>installed</name></package>",
        "share/x-1/msg/Far.msg": "own/Wheel wheel\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.mark.parametrize("name", KNOWN)
def test_hashes_are_those_of_ros(name: str) -> None:
    schema = Schema(name, "ros2msg", definition_of("jazzy", name))
    assert type_hash(schema) == f"RIHS01_{KNOWN[name]}"


def test_hashes_of_all_types_agree_with_rosbags() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in store.fielddefs:
        schema = Schema(name, "ros2msg", definition_of("jazzy", name))
        assert type_hash(schema) == store.hash_rihs01(name), name


def test_own_messages_services_and_actions(packages: Path) -> None:
    known = Definitions([packages])
    expected = {
        "own/msg/Wheel": ["header/stamp", "header/frame_id", "speed"],
        "installed/msg/Far": ["wheel/header/stamp", "wheel/header/frame_id", "wheel/speed"],
        "own/action/Fly_FeedbackMessage": ["feedback/part/name", "feedback/now"],
        "own/srv/Do_Request": ["part/name"],
        "own/srv/Do_Response": ["ok"],
    }
    for name, paths in expected.items():
        found = known.find(name)
        assert not found.problem, name
        assert columns(found.schema)[-len(paths) :] == paths
    event = unroller(Topic("/t", "cdr", known.find("own/srv/Do_Event").schema)).schema
    assert set(event.children) == {"request", "response"}
    assert known.find("own/action/Fly_GetResult_Event").schema.data
    for name in ("own/msg/None", "own/srv/Do_Goal", "other/msg/Wheel"):
        assert known.find(name).problem and not known.find(name).schema.data


def test_the_hash_decides_between_versions(packages: Path) -> None:
    """rcl_interfaces/Log has another hash before and after ROS 2 Iron; so has an own message."""
    hashes = {d: type_hash(Schema(LOG, "ros2msg", definition_of(d, LOG))) for d in DISTRIBUTIONS}
    for distribution, wanted in hashes.items():
        found = Definitions([packages]).find(LOG, wanted)
        assert found.schema.data and type_hash(found.schema) == wanted, distribution
    own = Definitions([packages])
    right = type_hash(own.find("own/msg/Part").schema)
    assert own.find("own/msg/Part", right).schema.data
    other = own.find("own/msg/Part", "RIHS01_" + "0" * 64)
    assert not other.schema.data and "uses another definition" in other.problem


def test_without_a_hash_a_message_decides() -> None:
    """Range has a variance since Jazzy; robots without hashes are older, but it may be false."""
    kind = "sensor_msgs/msg/Range"
    samples = {d: bytes(range_message(d)) for d in ("humble", "jazzy")}
    for distribution, sample in samples.items():
        for stated in ("", "foxy", "lyrical"):
            found = Definitions(distribution=stated).find(kind, sample=sample)
            assert not found.problem
            assert columns(found.schema) == columns(
                Schema(kind, "ros2msg", definition_of(distribution, kind))
            )
    assert Definitions().find(kind).origin == "ROS 2 Humble"
    assert "does not fit" in Definitions().find(kind, sample=b"\0\1\0\0").problem


def range_message(distribution: str) -> memoryview:
    store: Any = get_typestore(Stores(f"ros2_{distribution}"))
    kind = {name.rpartition("/")[2]: made for name, made in store.types.items()}
    header = kind["Header"](kind["Time"](1, 2), "a")
    numbers = [1, *[0.5] * (4 if distribution == "humble" else 5)]
    message = kind["Range"](header, *numbers)
    found: memoryview = store.serialize_cdr(message, "sensor_msgs/msg/Range")
    return found


def test_names_on_the_wire() -> None:
    assert names.dds_type("nav_msgs/msg/Odometry") == "nav_msgs::msg::dds_::Odometry_"
    assert names.type_of_dds("nav_msgs::msg::dds_::Odometry_") == "nav_msgs/msg/Odometry"
    for other in ("Odometry", "a::b::dds_::C_", "a::msg::dds_::C", "a::msg::dds_::C_\n"):
        assert names.type_of_dds(other) == ""
    topic = names.endpoint_of_dds("rt/robot/odom")
    assert topic == names.DdsEndpoint("topic", "/robot/odom")
    assert names.endpoint_of_dds("rq/do/itRequest") == names.DdsEndpoint("request", "/do/it")
    assert names.endpoint_of_dds("rr/do/itReply") == names.DdsEndpoint("reply", "/do/it")
    assert not any(map(names.endpoint_of_dds, ("odom", "rt", "rt/", "rt//a", "rq/do", "xx/odom")))
    assert names.endpoint_of_dds(names.dds_topic("/odom")) == names.DdsEndpoint("topic", "/odom")
