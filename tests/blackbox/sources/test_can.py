"""The source of CAN buses, with peers on a multicast group and an adapter on a pseudo-terminal.

There is no SocketCAN here: what the source asks of it is tested on the text that ``ip`` prints.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import pytest

from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.sources import can as source
from amberbox.blackbox.sources.can import CanLink, Config, parse_link
from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe, observe_in_process
from tests.support.can_bus import DBC, EDS, MulticastBus, columns_of, frames, plugged_in
from tests.support.processes import free_port

BUS_SPEED = 9000  # frames per second; a full bus of 1 Mbit/s has about 8000


@pytest.fixture
def bus() -> Iterator[MulticastBus]:
    with MulticastBus(free_port()) as made:
        yield made


@pytest.fixture
def dbc(tmp_path: Path) -> str:
    path = tmp_path / "base.dbc"
    path.write_text(DBC)
    return str(path)


def kinds(sink: MemorySink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def opened(sink: MemorySink, times: int = 1) -> None:
    wait_until(lambda: kinds(sink).count("can_open") >= times, "the interface is open")


def values(sink: MemorySink, topic: str) -> dict[str, list[Any]]:
    """Return the columns of a topic."""
    reader = unroller(next(t for t in sink.topics if t.name == topic))
    return columns_of(reader.rows(sink.of(topic)))


def total(sink: MemorySink, column: str) -> int:
    return sum(values(sink, "bus")[column]) if sink.of("bus") else 0


def send_at_bus_speed(bus: MulticastBus, sent: Sequence[can.Message]) -> None:
    """Send frames one after another; who was held up does not catch up, as no bus does."""
    due_s = time.monotonic()
    for frame in sent:
        while (late_s := time.monotonic() - due_s) < 0:
            time.sleep(0.001)
        bus.peer.send(frame)
        due_s += max(late_s - 0.01, 0.0) + 1 / BUS_SPEED


def assert_all_arrive(bus: MulticastBus, dbc: str, sent: Sequence[can.Message]) -> None:
    """Send frames at bus speed; each must be recorded with its data, in order."""
    with observe(source.Source(Config(**bus.block, dbc=dbc, bitrate=1_000_000), "can")) as sink:
        opened(sink)
        send_at_bus_speed(bus, sent)
        wait_until(lambda: len(sink.messages) - len(sink.of("bus")) >= len(sent), "all frames")
        wait_until(lambda: total(sink, "frames") == len(sent), "all are counted")
    known = {topic.name for topic in source.known_topics(Config(**bus.block, dbc=dbc))}
    described: dict[str, list[bytes]] = {name: [] for name in known}
    ids = {d.id: d.name for d in _messages(dbc)}
    for frame in sent:
        name = ids.get(frame.arbitration_id, "frames")
        described[name].append(bytes(frame.data))
    for name in known - {"frames", "errors", "bus"}:
        assert sink.of(name) == described[name]
    assert values(sink, "frames")["data"] == described["frames"]
    assert sink.losses == [] and total(sink, "lost") == total(sink, "malformed") == 0
    assert max(values(sink, "bus")["load"]) > 10.0


class _Named:
    def __init__(self, number: int, name: str) -> None:
        self.id, self.name = number, name


def _messages(dbc: str) -> list[_Named]:
    import cantools

    found: Any = cantools.database.load_file(dbc)
    return [_Named(message.frame_id, message.name) for message in found.messages]


def test_no_frame_is_lost_at_bus_speed(bus: MulticastBus, dbc: str) -> None:
    assert_all_arrive(bus, dbc, frames(8000))


@pytest.mark.needs_data
def test_no_frame_of_a_real_car_is_lost_at_bus_speed(bus: MulticastBus, shared_data: Path) -> None:
    with can.LogReader(shared_data / "can" / "can_sample.log") as log:
        sent = list(log)
    assert len(sent) == 82_558
    assert_all_arrive(bus, str(shared_data / "can" / "sample_can_spec.dbc"), sent)


def test_frames_without_room_are_counted_exactly(bus: MulticastBus) -> None:
    waits = threading.Event()
    sent = frames(40_000)
    with observe(source.Source(Config(**bus.block), "can")) as sink:
        opened(sink)
        pass_on = sink.message

        def slow(stream: int, data: bytes, received_ns: int) -> None:
            waits.wait()
            pass_on(stream, data, received_ns)

        vars(sink)["message"] = slow
        bus.peer.send(sent[0])
        for frame in sent[1:]:
            bus.peer.send(frame)
        waits.set()
        wait_until(
            lambda: total(sink, "frames") + total(sink, "lost") == len(sent),
            "all are accounted for",
        )
    assert total(sink, "lost") > 0
    assert sum(count for *_, count, _ in sink.losses) == total(sink, "lost")
    assert {(topic, reason) for topic, *_, reason in sink.losses} == {
        ("bus", "no room in the socket")
    }


def test_hostile_datagrams_are_counted_and_the_rest_goes_on(bus: MulticastBus, dbc: str) -> None:
    family = socket.AF_INET6 if ":" in bus.group else socket.AF_INET
    hostile = [b"", b"\xc1", b"x" * 5000, b"\x93\x01\x02\x03", b"\x81\xa2id\xa0" * 9, b"\xff" * 70]
    with observe(source.Source(Config(**bus.block, dbc=dbc), "can")) as sink:
        opened(sink)
        with socket.socket(family, socket.SOCK_DGRAM) as other:
            if family == socket.AF_INET:
                other.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for data in hostile:
                other.sendto(data, (bus.group, bus.port))
        wait_until(lambda: total(sink, "malformed") == len(hostile), "all are counted")
        bus.peer.send(can.Message(arbitration_id=513, is_extended_id=False, data=bytes(8)))
        sink.wait_for("MOTORS", 1)
    assert kinds(sink) == ["can_open"]


def test_fd_remote_and_error_frames(bus: MulticastBus, dbc: str) -> None:
    other = can.Message(arbitration_id=513, is_extended_id=False, is_remote_frame=True, dlc=4)
    long = can.Message(
        arbitration_id=0x12345678, is_fd=True, bitrate_switch=True, data=bytes(range(64))
    )
    overflow = can.Message(arbitration_id=0x44, is_error_frame=True, dlc=8, data=[0, 1, *bytes(6)])
    with observe(source.Source(Config(**bus.block, dbc=dbc, fd=True), "can")) as sink:
        opened(sink)
        for frame in (other, long, overflow):
            bus.peer.send(frame)
        sink.wait_for("errors", 1)
        wait_until(lambda: total(sink, "errors") == 1, "it is counted")
    raw = values(sink, "frames")
    assert raw["id"] == [513, 0x12345678]
    assert (raw["extended"], raw["remote"], raw["fd"]) == (
        [False, True],
        [True, False],
        [False, True],
    )
    assert (raw["length"], raw["data"]) == ([4, 64], [None, bytes(range(64))])
    errors = values(sink, "errors")
    assert (errors["bus_off"], errors["controller"], errors["controller_state"]) == (
        [True], [True], [1],
    )  # fmt: skip
    assert "can_bus_off" in kinds(sink)
    assert [reason for *_, reason in sink.losses] == ["receive overflow in the controller"]


def test_only_chosen_messages_are_recorded(bus: MulticastBus, dbc: str) -> None:
    config = Config(**bus.block, dbc=dbc, topics=[TopicOptions("MOT*")], frames="none")
    with observe(source.Source(config, "can")) as sink:
        opened(sink)
        for frame in frames(40):
            bus.peer.send(frame)
        sink.wait_for("MOTORS", 10)
        wait_until(lambda: total(sink, "frames") == 40, "all are counted")
    names = Counter(sink.topics[stream].name for stream, _, _ in sink.messages)
    assert names.keys() == {"MOTORS", "bus"}


def test_every_frame_is_also_recorded_as_it_was(bus: MulticastBus, dbc: str) -> None:
    with observe(source.Source(Config(**bus.block, dbc=dbc, frames="all"), "can")) as sink:
        opened(sink)
        for frame in frames(8):
            bus.peer.send(frame)
        sink.wait_for("frames", 8)
    assert (len(sink.of("MOTORS")), len(sink.of("BATTERY"))) == (2, 2)


def line(frame: can.Message) -> bytes:
    """Return a frame in the protocol slcan."""
    head = "T%08X" if frame.is_extended_id else "t%03X"
    return f"{head % frame.arbitration_id}{frame.dlc}{frame.data.hex().upper()}\r".encode()


def serial(link: Path, dbc: str) -> Config:
    return Config(
        channel=str(link), interface="slcan", dbc=dbc, bitrate=500_000,
        driver={"sleep_after_open": 0},
    )  # fmt: skip


def test_an_adapter_is_opened_listen_only_and_may_be_unplugged(
    tmp_path: Path, dbc: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "_WAIT_S", (0.05, 0.1))
    link, sent = tmp_path / "tty", frames(2000)
    sink: ObservedSink
    with observe(source.Source(serial(link, dbc), "can")) as sink:
        wait_until(lambda: "can_missing" in kinds(sink), "the adapter is missing")
        with plugged_in(link) as adapter:
            opened(sink)
            for frame in sent[:1000]:
                adapter.send(line(frame))
            adapter.send(b"t20\xff\xfe7garbage\r" + b"\x07" * 3)
            wait_until(lambda: total(sink, "frames") == 1000, "the frames before the garbage")
            wait_until(lambda: total(sink, "malformed") >= 1, "the garbage is counted")
            told = adapter.told
        wait_until(lambda: "can_lost" in kinds(sink), "it is unplugged")
        with plugged_in(link) as adapter:
            opened(sink, 2)
            for frame in sent[1000:]:
                adapter.send(line(frame))
            wait_until(lambda: total(sink, "frames") == 2000, "the frames after it")
    assert b"L\r" in told
    assert not [word for word in told.split(b"\r") if word[:1] in b"tTrRdDbB" and word]
    assert sink.of("MOTORS") == [bytes(f.data) for f in sent if f.arbitration_id == 513]
    ways = [way for way, topic, *_ in sink.links if topic == "MOTORS"]
    assert ways[:3] == ["up", "down", "up"]


def test_it_runs_in_a_process_of_its_own(bus: MulticastBus, dbc: str) -> None:
    block = f"""
- can:
    channel: "{bus.group}"
    interface: udp_multicast
    driver: {{port: {bus.port}, hop_limit: 0}}
    dbc: {dbc}
"""
    with observe_in_process(source, block) as sink:
        opened(sink)
        for frame in frames(400):
            bus.peer.send(frame)
        assert len(sink.wait_for("MOTORS", 100)) == 100


# -- configuration


def problems(text: str, folder: Path) -> list[str]:
    found: list[Problem] = []
    node = parse_yaml(text, "black_box.yaml", found)
    assert node is not None
    config = build(Config, node, found, "can")
    wrong = [] if config is None else config.in_folder(folder).wrong_files()
    return [problem.what for problem in found] + [what for _, what in wrong]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("{channel: can0, dbc: base.dbc, topics: [topic: {name: MOTOR}]}", "no file describes"),
        ("{channel: can0, dbc: [base.dbc, base.dbc]}", "base.dbc:5: MOTORS has the identifier"),
        ("{channel: can0, nodes: [{id: 200}]}", "200 is no number of a CANopen node"),
        ("{channel: can0, nodes: [{id: 5}, {id: 5, name: x}]}", "node 5 is there twice"),
        ("{channel: '', bitrate: -1}", "must be above 0"),
    ],
)
def test_errors_of_the_configuration(tmp_path: Path, text: str, error: str) -> None:
    (tmp_path / "base.dbc").write_text(DBC)
    assert error in "; ".join(problems(text, tmp_path))


def test_a_file_that_is_missing_is_a_note_until_the_bus_is_recorded(tmp_path: Path) -> None:
    assert problems("{channel: can0, dbc: none.dbc, topics: [topic: {name: A}]}", tmp_path) == []
    config = Config(channel="can0", dbc="none.dbc").in_folder(tmp_path)
    assert [key for key, _ in config.notes()] == ["dbc"]
    with pytest.raises(AmberboxError, match="No such file"):
        config.definitions()


def test_a_bus_of_both_kinds_of_files_is_right(tmp_path: Path) -> None:
    (tmp_path / "base.dbc").write_text(DBC)
    (tmp_path / "lift.eds").write_text(EDS)
    text = "{channel: can0, dbc: base.dbc, nodes: [{id: 5, name: lift, eds: lift.eds}]}"
    assert problems(text, tmp_path) == []


def test_other_drivers_run_in_a_process_and_say_that_they_acknowledge() -> None:
    config = Config(channel="0", interface="vector")
    assert source.needs_process(config)
    assert [key for key, _ in config.notes()] == ["interface"]
    assert "may acknowledge" in config.seen_as
    assert not source.needs_process(Config(channel="can0"))


def link(modes: list[str], **more: Any) -> str:
    """Return what iproute2 prints of a CAN interface, after its ``print_can_opt``."""
    data = {"ctrlmode": modes, "state": "ERROR-ACTIVE", "bittiming": {"bitrate": 500000}, **more}
    return json.dumps([{"ifname": "can0", "linkinfo": {"info_kind": "can", "info_data": data}}])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (link(["LISTEN-ONLY", "FD"], data_bittiming={"bitrate": 2000000}),
         CanLink(True, 500000, 2000000)),
        (link([]), CanLink(False, 500000)),
        ('[{"linkinfo": {"info_kind": "vcan"}}]', CanLink(False, is_virtual=True)),
        ("[{}]", CanLink(problem="it is no CAN interface, or 'ip' is too old")),
        ("nonsense", CanLink(problem="it is no CAN interface, or 'ip' is too old")),
    ],
)  # fmt: skip
def test_listen_only_is_read_from_ip(text: str, expected: CanLink) -> None:
    assert parse_link(text) == expected


def test_an_interface_that_is_missing_is_not_a_can_interface() -> None:
    assert source.read_link("nosuchcan0").problem
    assert source.read_link("lo").problem


def test_known_topics_have_their_columns(dbc: str) -> None:
    topics: dict[str, Topic] = {
        topic.name: topic for topic in source.known_topics(Config(channel="can0", dbc=dbc))
    }
    assert topics.keys() == {"MOTORS", "BATTERY", "LAMP", "frames", "errors", "bus"}
    names = [column.name for column in unroller(topics["MOTORS"]).schema.columns]
    assert names == ["SPEED_L", "SPEED_R", "STATE", "CURRENT"]
