"""The source of EtherCAT, between a SOEM master and simulated slaves on a virtual cable."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.ethercat import bus
from amberbox.blackbox.ethercat.images import ElementOptions, InterfaceOptions
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.sources import ethercat as source
from amberbox.blackbox.sources.ethercat import Config
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe
from tests.support.can_bus import columns_of
from tests.support.ethercat_frames import cycle
from tests.support.network_pair import Helper, NetworkPair, in_namespace
from tests.support.processes import running

SLAVES = 3
OUTPUT = (
    ElementOptions("cycles", "uint32"), ElementOptions("quarter", "float"),
    ElementOptions("echo", "uint32"),
)  # fmt: skip
INPUT = (ElementOptions("command", "uint32"), ElementOptions("setpoint", "int32"))
MS = 1_000_000


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let frames return late: this computer may be busy with other tests."""
    monkeypatch.setattr(bus, "LOST_NS", 10_000 * MS)


@pytest.fixture
def network() -> Iterator[NetworkPair]:
    with NetworkPair() as made:
        yield made


@pytest.fixture
def slaves(network: NetworkPair) -> Iterator[Helper]:
    with Helper(network.far, "tests.support.ethercat_slaves", network.interface, SLAVES) as made:
        yield made


def started_master(network: NetworkPair) -> Helper:
    return Helper(network.near, "tests.support.ethercat_master", network.interface)


def config(network: NetworkPair, **more: Any) -> Config:
    options = InterfaceOptions(
        network.interface, number_of_slaves=SLAVES, output_message_elements=OUTPUT,
        input_message_elements=INPUT, **more,
    )  # fmt: skip
    return Config(interfaces=[options])


@contextmanager
def listening(network: NetworkPair, wanted: Config) -> Iterator[ObservedSink]:
    """Run the source in the near namespace."""
    with ExitStack() as stack:
        with in_namespace(network.near):
            sink = stack.enter_context(observe(source.Source(wanted, "ethercat")))
        wait_until(lambda: "ethercat_open" in kinds(sink), "the interface is open")
        yield sink


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def values(sink: MemorySink, topic: str) -> dict[str, list[Any]]:
    reader = unroller(next(t for t in sink.topics if t.name == topic))
    return columns_of(reader.rows(sink.of(topic)))


def counters(sink: MemorySink) -> list[int]:
    """Return the working counters of the cycles so far."""
    if not sink.of("bus"):
        return []
    return [n for n in values(sink, "bus")["working_counter"] if n is not None]


def run(master: Helper, cycles: int, timeout_s: float = 10) -> list[tuple[int, str, str]]:
    answer = master.ask(f"{cycles} {round(timeout_s * 1e6)}")
    return [tuple(one) for one in json.loads(answer)]


def test_everything_is_what_the_master_saw(network: NetworkPair, slaves: Helper) -> None:
    with listening(network, config(network)) as sink, started_master(network) as master:
        assert master.greeting == "ready 9"
        truth = run(master, 150)
        slaves.ask("lost 1")
        truth += run(master, 50)
        slaves.ask("lost 0")
        truth += run(master, 100)
        wait_until(lambda: len(counters(sink)) >= len(truth) + 2, "all cycles")
        wait_until(lambda: len(sink.of("output")) >= len(truth) + 2, "all images")
    assert {counter for counter, _, _ in truth[:150]} == {9}
    assert {counter for counter, _, _ in truth[150:200]} == {6}
    assert counters(sink)[-len(truth) :] == [counter for counter, _, _ in truth]
    assert [data.hex() for data in sink.of("output")[-len(truth) :]] == [got for *_, got in truth]
    assert [data.hex() for data in sink.of("input")[-len(truth) :]] == [s for _, s, _ in truth]
    rows = values(sink, "bus")
    assert [n for n, bad in enumerate(rows["incomplete"][-len(truth) :]) if bad] == list(
        range(152, 202)
    )
    assert [kind for kind in kinds(sink) if "slaves" in kind] == [
        "ethercat_slaves_missing", "ethercat_slaves_back",
    ]  # fmt: skip
    assert sum(rows["lost"]) == sum(rows["malformed"]) == sum(rows["dropped"]) == 0
    states = values(sink, "al_status")
    assert states["state"][-1] == 8 and {1, 2, 4, 8} <= set(states["state"])
    assert sink.losses == []


def test_master_killed_and_slaves_mute(
    network: NetworkPair, slaves: Helper, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus, "LOST_NS", 2_000 * MS)
    with listening(network, config(network, datagrams="none")) as sink:
        with started_master(network) as master:
            run(master, 30)
            slaves.ask("mute")
            truth = run(master, 3, timeout_s=0.02)
            assert {counter for counter, _, _ in truth} == {-1}  # SOEM: no frame
            wait_until(lambda: counters(sink)[-3:] == [0, 0, 0], "they are lost")
            assert sum(values(sink, "bus")["lost"]) == 3
            slaves.ask("speak")
            run(master, 10)
            master.kill()
        wait_until(lambda: "ethercat_silent" in kinds(sink), "no more frames")
        with started_master(network) as master:
            sent = [got for *_, got in run(master, 20)]
            wait_until(
                lambda: [data.hex() for data in sink.of("output")[-20:]] == sent, "the new master"
            )
    ways = [way for way, topic, *_ in sink.links if topic == "output"]
    assert ways[:3] == ["up", "down", "up"]


def test_an_interface_that_is_missing_down_or_unplugged(
    network: NetworkPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "_WAIT_S", (0.05, 0.1))
    name, frames = network.interface, cycle(bytes(24), bytes(36), 9)
    with listening(network, config(network)) as sink:
        send(network, frames)
        sink.wait_for("output", 1)
        network.switch("down", network.near)
        wait_until(lambda: "ethercat_lost" in kinds(sink), "it is down")
        wait_until(lambda: "ethercat_missing" in kinds(sink), "it is still down")
        assert any("down" in text for kind, text, _ in sink.events if kind == "ethercat_missing")
        network.switch("up", network.near)
        wait_until(lambda: kinds(sink).count("ethercat_open") == 2, "it is up")
        send(network, frames)
        sink.wait_for("output", 2)
        network.unplug()
        wait_until(lambda: kinds(sink).count("ethercat_lost") == 2, "it is unplugged")
        network.plug()
        wait_until(lambda: kinds(sink).count("ethercat_open") == 3, "it is there")
        send(network, frames)
        sink.wait_for("output", 3)
    assert {details["interface"] for *_, details in sink.events} == {name}


@contextmanager
def far_socket(network: NetworkPair) -> Iterator[socket.socket]:
    with in_namespace(network.far):
        line = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        line.bind((network.interface, 0))
    with line:
        yield line


def send(network: NetworkPair, frames: Sequence[bytes]) -> None:
    with far_socket(network) as line:
        for one in frames:
            line.send(one)


def numbered(count: int) -> Iterator[bytes]:
    """Yield the frames of some cycles, which count in what the slaves send."""
    for number in range(count):
        yield from cycle(bytes(24), number.to_bytes(36, "little"), 9, number & 255)


def held_up(sink: MemorySink) -> threading.Event:
    """Let messages wait, as in a process that is stopped, until the event is set."""
    go_on, pass_on = threading.Event(), sink.message

    def slow(stream: int, data: bytes, received_ns: int) -> None:
        go_on.wait()
        pass_on(stream, data, received_ns)

    vars(sink)["message"] = slow
    return go_on


def frames_and_drops(sink: MemorySink) -> tuple[int, int]:
    rows = values(sink, "bus") if sink.of("bus") else {"frames": [], "dropped": []}
    return sum(rows["frames"]), sum(rows["dropped"])


def test_as_many_frames_as_in_4_s_at_4_khz_wait_without_loss(network: NetworkPair) -> None:
    cycles = 16_000
    with listening(network, config(network)) as sink:
        go_on = held_up(sink)
        send(network, list(numbered(cycles)))
        go_on.set()
        wait_until(lambda: len(sink.of("output")) >= cycles, "all cycles")
    assert sink.of("output") == [n.to_bytes(36, "little") for n in range(cycles)]
    assert counters(sink) == [9] * cycles and sink.losses == []


def test_frames_without_room_are_counted_exactly(network: NetworkPair) -> None:
    cycles = 12_000
    with listening(network, config(network, buffer_mb=1)) as sink:
        go_on = held_up(sink)
        send(network, list(numbered(cycles)))
        go_on.set()
        wait_until(lambda: sum(frames_and_drops(sink)) >= 2 * cycles, "all are accounted for")
    frames, dropped = frames_and_drops(sink)
    assert frames + dropped == 2 * cycles and dropped > 0
    assert sum(values(sink, "bus")["lost"]) == 0 and "ethercat_slaves_missing" not in kinds(sink)
    assert sum(count for *_, count, _ in sink.losses) == dropped
    assert {reason for *_, reason in sink.losses} == {"no room in the ring"}


def test_the_expected_counter_is_kept_across_restarts(network: NetworkPair) -> None:
    with listening(network, config(network)) as sink:
        send(network, list(numbered(20)))
        wait_until(lambda: sink.saved.get("expected"), "it is learnt")
    again, stop = MemorySink(saved=sink.saved), threading.Event()
    run_again = source.Source(config(network), "ethercat").run
    with in_namespace(network.near):
        thread = threading.Thread(target=run_again, args=(again, stop))
        thread.start()
    try:
        wait_until(lambda: "ethercat_open" in kinds(again), "the interface is open")
        send(network, [one for _ in range(3) for one in cycle(bytes(24), bytes(36), 6)])
        wait_until(lambda: "ethercat_slaves_missing" in kinds(again), "a slave is missing")
    finally:
        stop.set()
        thread.join()
    assert values(again, "bus")["expected_counter"] == [9, 9, 9]


def test_times_are_those_of_the_wire(network: NetworkPair) -> None:
    times = []
    with listening(network, config(network)) as sink, far_socket(network) as line:
        for out, back in zip(*[iter(numbered(50))] * 2, strict=True):
            line.send(out)
            before_ns = time.time_ns()
            line.send(back)
            times.append((before_ns, time.time_ns()))
        wait_until(lambda: len(sink.of("output")) >= 50, "all cycles")
    place = next(n for n, topic in enumerate(sink.topics) if topic.name == "output")
    received = [at_ns for stream, _, at_ns in sink.messages if stream == place]
    for at_ns, (before_ns, after_ns) in zip(received, times, strict=True):
        assert before_ns - MS <= at_ns <= after_ns + MS


def test_hostile_frames_are_counted_and_the_rest_goes_on(network: NetworkPair) -> None:
    head = b"\xff" * 6 + b"\x12" + bytes(5) + b"\x88\xa4"
    hostile = [head + os.urandom(size) for size in range(2, 400, 7)]
    hostile += [b"\xff" * 12 + b"\x08\x00" + bytes(50)] * 10  # the kernel's filter drops these
    with listening(network, config(network)) as sink:
        send(network, [*hostile, *numbered(5), *hostile, *numbered(5)])
        wait_until(lambda: len(sink.of("output")) == 10, "the good ones")
        wait_until(
            lambda: (
                sum(sum(values(sink, "bus")[name]) for name in ("malformed", "other", "frames"))
                == 20 + 2 * (len(hostile) - 10)
            ),
            "all are counted",
        )


def test_nothing_is_sent(network: NetworkPair) -> None:
    """The counters of the interface state that not a frame has left it."""
    counter = f"/sys/class/net/{network.interface}/statistics/tx_packets"
    command = ["ip", "netns", "exec", network.near, "cat", counter]
    with listening(network, config(network)) as sink:
        send(network, list(numbered(100)))
        sink.wait_for("output", 100)
        assert subprocess.run(command, capture_output=True, text=True).stdout.strip() == "0"


WITHOUT = """
from amberbox.blackbox.ethercat import bus
from amberbox.blackbox.ethercat.images import InterfaceOptions
from amberbox.blackbox.sources.ethercat import Config, Source
from amberbox.core.errors import AmberboxError
from amberbox.testing.contract import MemorySink
import threading
try:
    Source(Config(interfaces=[InterfaceOptions("lo")]), "ethercat").run(
        MemorySink(), threading.Event())
except AmberboxError as error:
    print(error.what, error.hint, sep="; ")
"""


def test_without_the_capability_the_error_names_the_remedy() -> None:
    command = ["setpriv", "--bounding-set", "-net_raw", sys.executable, "-c", WITHOUT]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "listening on lo needs the capability CAP_NET_RAW; AmbientCapabilities=" in done.stdout


def test_recorded_by_the_command_line(network: NetworkPair, slaves: Helper, tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: wheels\nstore: {path: store}\n")
    (folder / "black_box.yaml").write_text(
        f"""
- ethercat:
    interfaces:
      - interface_specification:
          interface: {network.interface}
          number_of_slaves: {SLAVES}
          output_message_elements:
            - element: {{name: cycles, type: uint32}}
            - element: {{name: quarter, type: float}}
            - element: {{name: echo, type: uint32}}
          input_message_size: 8
          output_data_items: {{name: wheels, variable_names: [cycles]}}
"""
    )
    with ExitStack() as stack:
        with in_namespace(network.near):
            stack.enter_context(running("record", folder, log=tmp_path / "log"))
        wait_until(
            lambda: "ethercat_open" in column(folder, "amberbox_event", "kind"), "it listens"
        )
        with started_master(network) as master:
            truth = run(master, 100)
            last = first_cycles(truth)[-1]
            wait_until(
                lambda: last in column(folder, "ethercat_wheels", "slaves_0_cycles"),
                "the cycles are recorded",
            )
    with amberbox.open(folder) as record:
        table = record.query("ethercat_wheels", ["slaves_0_cycles", "slaves_2_cycles"])
        counter = record.query("ethercat_bus", ["working_counter"])["working_counter"]
    got = first_cycles(truth)
    assert np.asarray(table["slaves_0_cycles"]).tolist()[-len(got) :] == got
    assert np.asarray(counter).tolist()[-len(got) :] == [9] * len(got)


def first_cycles(truth: Sequence[tuple[int, str, str]]) -> list[int]:
    """Return the cycles that the first slave has counted."""
    return [int.from_bytes(bytes.fromhex(received)[:4], "little") for *_, received in truth]


def column(folder: Path, item: str, name: str) -> list[Any]:
    """Return a column of the record as far as there is one."""
    try:
        with amberbox.open(folder) as record:
            return list(np.asarray(record.query(item, [name])[name]).tolist())
    except AmberboxError:
        return []


# -- configuration


@pytest.mark.needs_data
def test_the_block_of_the_ropod_robots(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "ropod/black_box_configs/data_sources-2018-09-14-with-ethercat.yaml"
    text = path.read_text()
    (tmp_path / "black_box.yaml").write_text(text[text.index("- ethercat:") :])
    (tmp_path / "robot.yaml").write_text("id: ropod\n")
    (block,) = load_folder(tmp_path).blocks
    topics = {topic.name: topic for topic in source.known_topics(block.config)}
    assert topics.keys() == {
        "ropod_output_data", "ropod_input_data", "bus", "al_status", "datagrams",
    }  # fmt: skip
    names = [column.name for column in unroller(topics["ropod_output_data"]).schema.columns]
    assert len(names) == 40 and names[:3] == ["status1", "status2", "sensor_ts"]
    sent, received = bytes(range(36)), bytes(168)
    sink = MemorySink()
    seen = source._Segment(block.config.interfaces[0], "", sink, {})
    for one in cycle(sent, received, 3):
        seen.bus.frame(one, sink.now_ns())
    assert (sink.of("ropod_input_data"), sink.of("ropod_output_data")) == ([sent], [received])


def test_the_health_of_a_segment_has_no_filters() -> None:
    filtered = TopicOptions("wheels", max_frequency=10)
    segments = [
        InterfaceOptions("eth1", output_message_elements=OUTPUT, output_data_items=filtered),
        InterfaceOptions("eth2", datagrams="none"),
    ]
    listed = source.Source(Config(interfaces=segments), "ethercat").topics()
    assert [topic.name for topic in listed] == [
        "wheels", "eth1/bus", "eth1/al_status", "eth1/datagrams", "eth2/bus", "eth2/al_status",
    ]  # fmt: skip
    assert [topic.max_frequency for topic in listed] == [10] + [None] * 5
    known = [topic.name for topic in source.known_topics(Config(interfaces=segments))]
    assert known == [topic.name for topic in listed]


def test_an_interface_that_may_send_by_itself_is_told(network: NetworkPair) -> None:
    with in_namespace(network.near):
        assert not source.may_send(network.interface)
        switch = Path("/proc/sys/net/ipv6/conf", network.interface, "disable_ipv6")
        if switch.exists():
            switch.write_text("0")
            assert source.may_send(network.interface)
