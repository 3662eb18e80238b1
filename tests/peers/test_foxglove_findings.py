"""What a watcher finds, for a real WebSocket client: arrays of diagnostics, and log entries."""

from __future__ import annotations

import base64
import json
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.query.foxglove_layout import DIAGNOSTICS, LOG
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Status
from amberbox.monitoring.findings import HealthState, Transition
from amberbox.monitoring.viewer_findings import ARRAY
from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.records import T0_NS, FakeRun, fill_store
from tests.monitoring.publishers.laser import COMPONENT, OF_DEVICE
from tests.monitoring.publishers.test_current_state import ALARM, say
from tests.peers.test_foxglove import ENDED, Viewer, program, viewer

FAILED = replace(COMPONENT, level="error", state="front", reason="front is false")
CHANGE = Transition(
    "ropod_001", "laser", "", HealthState("ok", "nominal"), HealthState("error", "front"),
    T0_NS + 2 * NS, "front is false", (), "", "abc",
)  # fmt: skip
CAUSE = Hypothesis("h", frozenset({"laser#dead"}), 0.9, explains=("laser/laser_device/front",))
DIAGNOSIS = Diagnosis(
    "ropod_001-1", 1, "ropod_001", T0_NS + 2 * NS, "abc", (CAUSE,), 0.9,
    groups=(AmbiguityGroup(("h",), 0.9),),
)  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Three seconds of poses; the laser fails after two."""
    fill_store(tmp_path / "store")
    run = FakeRun(tmp_path / "store", "watch")
    for second in range(3):
        at_ns = T0_NS + second * NS
        if second == 2:
            say(run, at_ns, CHANGE, replace(ALARM, opened_ns=at_ns, changed_ns=at_ns), DIAGNOSIS)
        say(run, at_ns, FAILED if second == 2 else COMPONENT, OF_DEVICE)
    run.close()
    return tmp_path / "store"


def arrays(client: Viewer) -> Iterator[tuple[int, list[tuple[str, int, str, dict[str, str]]]]]:
    """Yield the seconds of each array, and its entries, as the channel's schema defines them."""
    channel = client.channels[DIAGNOSTICS]
    assert (channel["encoding"], channel["schemaName"]) == ("ros1", ARRAY)
    types = get_typestore(Stores.ROS1_NOETIC)
    name = ARRAY.replace("/", "/msg/")
    assert channel["schema"].split() == types.generate_msgdef(name)[0].split()
    for data in client.messages(DIAGNOSTICS):
        array: Any = types.deserialize_ros1(data, name)
        yield (
            array.header.stamp.sec,
            [
                (s.name, s.level, s.message, {v.key: v.value for v in s.values})
                for s in array.status
            ],
        )


def entries(client: Viewer) -> Sequence[tuple[str, str, str]]:
    """Return level, name and message of log entries, by the descriptors in the schema."""
    channel = client.channels[LOG]
    assert (channel["encoding"], channel["schemaName"]) == ("protobuf", "foxglove.Log")
    pool = descriptor_pool.DescriptorPool()
    descriptors = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    for file in descriptors.file:
        pool.Add(file)
    log = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.Log"))
    found: list[Any] = [log.FromString(data) for data in client.messages(LOG)]
    names = log.DESCRIPTOR.fields_by_name["level"].enum_type.values_by_number
    return [(names[one.level].name, one.name, one.message) for one in found]


def test_a_range_has_diagnostics_and_a_log(store: Path) -> None:
    with program(str(store), "--speed", "100") as (_, port), viewer(port) as client:
        client.subscribe("/odom", DIAGNOSTICS, LOG)
        client.wait(lambda: client.states and client.states[-1].status == ENDED)
        client.wait(lambda: len(client.messages(DIAGNOSTICS)) == 3)
        client.wait(lambda: len(client.messages(LOG)) == 3)
        found = list(arrays(client))
        assert [at_s for at_s, _ in found] == [T0_NS // NS + second for second in range(3)]
        assert [[entry[:3] for entry in array] for _, array in found] == [
            *[[("laser", 0, "nominal"), ("laser: laser_device", 0, "nominal")]] * 2,
            [("laser", 2, "front is false"), ("laser: laser_device", 0, "nominal")],
        ]
        values = found[2][1][0][3]
        assert (values["failure_modes"], values["evidence"]) == (
            "laser#dead (90%)", "laser/laser_device/front",
        )  # fmt: skip
        assert "failure_modes" not in found[1][1][0][3]
        assert sorted(entries(client)) == [
            ("ERROR", "laser", "laser: alarm laser-1 open (urgent): gone"),
            ("ERROR", "laser", "laser: nominal -> front: front is false"),
            ("WARNING", "watch", "diagnosis ropod_001-1: laser#dead (90 %)"),
        ]
        client.received.clear()
        client.control(play=False, seek_ns=T0_NS + 2 * NS + NS // 2)
        client.wait(lambda: client.messages(DIAGNOSTICS))  # as of that moment
        ((_, array),) = arrays(client)
        assert array[0][:3] == ("laser", 2, "front is false") and "diagnosis" in array[0][3]


def test_chosen_items_come_without_findings(store: Path) -> None:
    with program(str(store), "--item", "odom") as (_, port), viewer(port) as client:
        client.wait(lambda: client.channels)
        assert list(client.channels) == ["/odom"]


def test_live_findings_and_the_silence_of_the_watcher(tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    run = FakeRun(tmp_path / "store", "watch")
    say(run, time.time_ns(), CHANGE)  # was found before
    with program(str(tmp_path / "store"), "--live") as (process, port), viewer(port) as client:
        client.subscribe(DIAGNOSTICS, LOG)

        def heard(status: Status, level: int) -> bool:
            say(run, time.time_ns(), status)
            client.wait(lambda: client.messages(DIAGNOSTICS))
            found = list(arrays(client))[-1][1]
            client.received.pop(DIAGNOSTICS)
            return [(entry[0], entry[1]) for entry in found] == [("laser", level)]

        while not heard(COMPONENT, 0):
            pass
        say(run, time.time_ns(), replace(ALARM, changed_ns=time.time_ns()))
        client.wait(lambda: client.messages(LOG))
        assert entries(client) == [("ERROR", "laser", "laser: alarm laser-1 open (urgent): gone")]
        while not heard(FAILED, 2):
            pass
        client.received.clear()
        client.wait(lambda: client.messages(DIAGNOSTICS) and list(arrays(client))[-1][1][0][1] == 3)
        assert "the watcher has said nothing for" in list(arrays(client))[-1][1][0][2]
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


def test_a_layout_has_the_topics_that_are_served(store: Path, tmp_path: Path) -> None:
    file = tmp_path / "layout.json"
    assert main(["foxglove", str(store), "--layout", str(file)]) == 0
    layout = json.loads(file.read_text())
    panels = layout["configById"]

    def placed(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else placed(node["first"]) | placed(node["second"])

    assert placed(layout["layout"]) == set(panels)
    plots = {panel["title"]: panel["paths"] for panel in panels.values() if "paths" in panel}
    assert plots["/odom"][0]["value"] == "/odom.pose.x"
    wanted = {panel["topicToRender"] for panel in panels.values() if "topicToRender" in panel}
    with program(str(store)) as (_, port), viewer(port) as client:
        client.wait(lambda: client.channels.keys() >= wanted | {"/odom"})
    words = ["--layout", str(file), "--columns", "--item", "odom"]
    assert main(["foxglove", str(store), *words]) == 0
    plotted = json.loads(file.read_text())["configById"]["Plot!plot0"]["paths"]
    assert plotted[0]["value"] == "odom.pose_x"
