"""Segments by their frames: directions, process images, working counters, states, hostile bytes."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.ethercat.bus import LOST_NS, EtherCatBus
from amberbox.blackbox.ethercat.images import ElementOptions, InterfaceOptions
from amberbox.core.types import Topic
from tests.support.can_bus import columns_of
from tests.support.ethercat_frames import Part, cycle, frame

ELEMENTS = (ElementOptions("status", "uint16"), ElementOptions("speed", "float"))
COMMANDS = (ElementOptions("setpoint", "int32"),)
MS = 1_000_000


class Observed:
    """A segment and what it has put."""

    def __init__(self, **options: Any) -> None:
        self.messages: list[tuple[str, bytes, int]] = []
        self.told: list[str] = []
        self.topics: dict[str, Topic] = {}
        self.bus = EtherCatBus(InterfaceOptions("eth1", **options), self._put, self._tell)
        self.now_ns = 10**18

    def _put(self, topic: Topic, data: bytes, time_ns: int) -> None:
        self.topics[topic.name] = topic
        self.messages.append((topic.name, data, time_ns))

    def _tell(self, kind: str, text: str) -> None:
        self.told.append(kind)

    def take(self, *frames: bytes, step_ns: int = MS, sent: bool | None = None) -> None:
        for one in frames:
            self.now_ns += step_ns
            self.bus.frame(one, self.now_ns, sent)

    def of(self, topic: str) -> list[bytes]:
        return [data for name, data, _ in self.messages if name == topic]

    def columns(self, topic: str) -> dict[str, list[Any]]:
        rows = unroller(self.topics[topic]).rows(self.of(topic))
        return columns_of(rows)


def segment(slaves: int = 2, **more: Any) -> Observed:
    return Observed(
        output_message_elements=ELEMENTS, input_message_elements=COMMANDS,
        number_of_slaves=slaves, **more,
    )  # fmt: skip


def test_an_image_is_found_by_size_and_cut_into_elements() -> None:
    one = segment()
    sent, received = bytes(range(8)), bytes.fromhex("010000004040020000008040")
    one.take(*cycle(sent, received, 6))
    assert (one.of("input"), one.of("output")) == ([sent], [received])
    assert one.columns("output") == {
        "slaves_0_status": [1], "slaves_0_speed": [3.0],
        "slaves_1_status": [2], "slaves_1_speed": [4.0],
    }  # fmt: skip
    assert one.of("datagrams") == [] and one.told == ["ethercat_process_data"]


def test_who_sends_the_output_messages_may_be_the_master() -> None:
    one = segment(outputs_from="master")
    one.take(*cycle(bytes(range(12)), bytes(range(20, 28)), 6))
    assert (one.of("output"), one.of("input")) == ([bytes(range(12))], [bytes(range(20, 28))])


@pytest.mark.parametrize(
    ("parts", "output", "input_"),
    [
        ([Part(10, 0x100, bytes(range(12)), 2)], [bytes(range(12))], []),
        ([Part(11, 0x200, bytes(range(8)), 2)], [], [bytes(range(8))]),
        ([Part(12, 0, bytes(range(12)), 6)], [bytes(range(12))], []),  # one place for both
        ([Part(12, 0, bytes(range(13)), 6)], [], []),
        ([Part(4, 0x1234, bytes(range(12)), 1)], [], []),
    ],
)
def test_read_write_and_overlapping_commands(
    parts: list[Part], output: list[bytes], input_: list[bytes]
) -> None:
    one = segment()
    one.take(frame(*parts, returned=True))
    assert (one.of("output"), one.of("input")) == (output, input_)


def test_an_image_by_address_may_come_in_several_datagrams() -> None:
    one = segment(output_address=0x10004, input_address=0x20000)
    whole = bytes(range(12))
    parts = [Part(10, 0x10000, b"none" + whole[:7], 1), Part(12, 0x1000B, whole[7:] + b"rest", 1)]
    one.take(frame(parts[0], returned=True))  # its end is missing
    one.take(frame(*(part._replace(counter=0) for part in parts)), frame(*parts, returned=True))
    one.take(frame(parts[1], returned=True))  # its beginning is missing
    assert one.of("output") == [whole] and one.of("input") == []


def test_no_slave_answers() -> None:
    one = segment()
    one.take(*cycle(bytes(8), bytes(12), 0))
    assert one.of("output") == [] and len(one.of("input")) == 1
    assert one.columns("bus")["working_counter"] == [0]


@pytest.mark.parametrize(("marks", "told"), [(True, None), (False, None), (False, True)])
def test_frames_out_and_back_are_told_apart(marks: bool, told: bool | None) -> None:
    one = Observed(datagrams="all")
    for index in range(20):
        out = frame(Part(12, 0, b"\1\2", 0, index % 3), marks=marks, pad=0 if told else 60)
        back = frame(Part(12, 0, b"\1\2", 0, index % 3), returned=True, marks=marks)
        one.take(out, sent=told)
        one.take(back, sent=None if told is None else not told)
    assert one.columns("datagrams")["returned"] == [False, True] * 20
    assert (one.bus.counts.sent, one.bus.counts.returned, one.bus.counts.lost) == (20, 20, 0)


def test_lost_frames_are_cycles_without_slaves() -> None:
    one = segment()
    good = cycle(bytes(8), bytes(12), 6)
    for _ in range(20):
        one.take(*good)
    for index in range(2, 7):
        one.take(cycle(bytes(8), bytes(12), 6, index)[0])
    one.bus.tick(one.now_ns + LOST_NS)
    rows = one.columns("bus")
    assert rows["working_counter"] == [6] * 20 + [0] * 5
    assert (sum(rows["lost"]), one.bus.counts.lost) == (5, 5)
    assert rows["incomplete"] == [False] * 22 + [True] * 3
    assert one.told[-1] == "ethercat_slaves_missing"


def test_a_frame_whose_return_may_have_been_dropped_is_not_lost() -> None:
    one = segment()
    for index in range(3):
        one.take(cycle(bytes(8), bytes(12), 6, index)[0])
    one.bus.dropped(5, one.now_ns)
    one.take(cycle(bytes(8), bytes(12), 6, 9)[0])
    one.bus.tick(one.now_ns + LOST_NS)
    assert one.bus.counts.lost == 1


def test_the_expected_counter_is_learnt_and_single_dips_are_no_fault() -> None:
    one = segment()
    for counter in [2] * 12 + [6] * 12 + [4] + [6] * 3 + [4] * 5 + [6] * 5:
        one.take(*cycle(bytes(8), bytes(12), counter))
    rows = one.columns("bus")
    expected = [0] * 9 + [2] * 12 + [6] * 17
    assert rows["expected_counter"] == expected
    assert [n for n, bad in enumerate(rows["incomplete"]) if bad] == [30, 31, 32, 33, 34]
    assert one.told == ["ethercat_process_data", "ethercat_slaves_missing", "ethercat_slaves_back"]
    assert list(one.bus.learnt.values()) == [6]
    again = segment()
    again.bus.learnt.update(one.bus.learnt)
    again.take(*cycle(bytes(8), bytes(12), 4))
    assert again.columns("bus")["expected_counter"] == [6]


def test_a_configured_counter_is_not_learnt() -> None:
    one = segment(expected_working_counter=6, debounce_cycles=1)
    for counter in [9] * 20:
        one.take(*cycle(bytes(8), bytes(12), counter))
    assert set(one.columns("bus")["expected_counter"]) == {6}
    assert all(one.columns("bus")["incomplete"])


def test_times_of_a_cycle() -> None:
    one = segment()
    for _ in range(3):
        one.take(*cycle(bytes(8), bytes(12), 6))
    rows = one.columns("bus")
    assert rows["round_trip"] == pytest.approx([0.001] * 3)
    assert math.isnan(rows["cycle_time"][0])
    assert rows["cycle_time"][1:] == pytest.approx([0.002] * 2)
    assert rows["frames"] == [2, 2, 2]


def test_a_quiet_segment_has_a_row_each_second() -> None:
    one = segment()
    one.take(frame(Part(4, 0x01301000, b"\0\0", 0)))
    for _ in range(3):
        one.bus.tick(one.now_ns)
        one.now_ns += 1_000 * MS
    rows = one.columns("bus")
    assert rows["cycles"] == [0, 0] and rows["working_counter"] == [None, None]
    assert sum(rows["frames"]) == 1


def test_states_of_slaves() -> None:
    one = Observed(datagrams="none")
    read = [
        (Part(7, 0x01300003, b"\x04\0", 3), Part(7, 0x01300000, b"\0\0")),
        (Part(4, 0x01301002, b"\x14\0\0\0\x1b\0", 1), Part(4, 0x01301002, bytes(6))),
        (Part(1, 0x01300002, b"\x08\0", 1), Part(1, 0x0130FFFF, b"\0\0")),
        (Part(4, 0x01301002, b"\x14\0\0\0\x1b\0", 1), Part(4, 0x01301002, bytes(6))),
        (Part(4, 0x01301003, b"\x08\0", 0), Part(4, 0x01301003, b"\0\0")),  # not answered
    ]
    for back, out in read:
        one.take(frame(out), frame(back, returned=True))
    assert one.columns("al_status") == {
        "addressed": [0, 2, 1], "state": [4, 4, 8], "error": [False, True, False],
        "slave": [None, 0x1002, 1], "code": [None, 0x1B, None],
    }  # fmt: skip


def test_another_image_in_flight_is_told_and_the_bytes_are_kept() -> None:
    one = segment()
    one.take(*cycle(bytes(8), bytes(12), 6))
    one.take(*cycle(bytes(8), bytes(16), 6))
    one.take(*cycle(bytes(8), bytes(12), 6))
    assert one.told == [
        "ethercat_process_data", "ethercat_unknown_image",
    ]  # fmt: skip
    assert len(one.of("output")) == 2 and len(one.of("datagrams")) == 1


def hostile() -> Iterator[bytes]:
    chance = random.Random(3)
    good = cycle(bytes(8), bytes(12), 6)[1]
    for _ in range(3000):
        data = bytearray(good)
        for _ in range(chance.randint(1, 6)):
            data[chance.randrange(14, len(data))] = chance.randrange(256)
        yield bytes(data[: chance.randint(0, len(data))])


def test_hostile_frames_are_counted_and_the_rest_goes_on() -> None:
    one = segment(datagrams="all")
    for data in hostile():
        one.take(data)
    counts = one.bus.counts
    assert counts.malformed > 1000
    assert counts.malformed + counts.other + counts.sent + counts.returned == 3000
    before = len(one.of("output"))
    one.take(*cycle(bytes(8), bytes(range(12)), 6))
    assert one.of("output")[before:] == [bytes(range(12))]
    for name in one.topics:
        assert one.columns(name)


@given(st.binary(max_size=200), st.integers(0, 2))
def test_any_bytes(data: bytes, kind: int) -> None:
    one = segment(datagrams="all")
    head = [b"", b"\xff" * 12 + b"\x88\xa4", b"\xff" * 12 + b"\x88\xa4\x40\x10"][kind]
    one.take(head + data)
    assert sum(vars(one.bus.counts).values()) == 1


def test_memory_is_bounded() -> None:
    one = segment(datagrams="none")
    for number in range(20_000):
        data = frame(
            Part(12, number, b"\0", 0, number & 255), Part(4, 0x01300000 | number, b"\1\0")
        )
        back = frame(Part(4, 0x01300000 | number & 0xFFFF, b"\1\0", 1, 9), returned=True)
        one.take(bytes(data[:6]) + number.to_bytes(6, "big") + data[12:], back, step_ns=1)
    tables = [value for value in vars(one.bus).values() if isinstance(value, dict)]
    assert max(map(len, tables)) <= 5000
