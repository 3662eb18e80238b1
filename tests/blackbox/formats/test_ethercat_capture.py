"""Captures of EtherCAT: both formats and byte orders, as tshark reads them, hostile files."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.formats import ethercat_capture
from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats._recording import ReadOptions, RecordingReader
from amberbox.cli.main import main
from amberbox.core.errors import AmberboxError
from tests.support.can_bus import columns_of
from tests.support.ethercat_frames import Part, Stamped, cycle, frame, pcap, pcapng

START_NS = 1_700_000_000_123_456_000
BLOCK = """
- ethercat:
    interfaces:
      - interface_specification:
          interface: eth1
          number_of_slaves: 2
          output_message_elements:
            - element: {name: status, type: uint16}
            - element: {name: speed, type: float}
          input_message_elements:
            - element: {name: setpoint, type: int32}
          output_data_items: {name: wheels}
"""


def drive(cycles: int = 50) -> list[tuple[int, bytes]]:
    """Return the frames of some cycles; in each the state of a slave is read, too."""
    frames = []
    for number in range(cycles):
        out, back = cycle(
            number.to_bytes(8, "little"), number.to_bytes(12, "little"), 6, number % 16
        )
        time_ns = START_NS + number * 1_000_000
        state = Part(4, 0x01301001, b"\x08\0\0\0\0\0", 0, number % 16 + 100)
        frames += [(time_ns, out), (time_ns + 40_000, back)]
        frames += [
            (time_ns + 50_000, frame(state, Part(8, 0x09100000, b"\1\2"))),
            (time_ns + 90_000, frame(
                state._replace(counter=1), Part(8, 0x09100002, b"\1\2", 2), returned=True)),
        ]  # fmt: skip
    return frames


def messages(recording: RecordingReader) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    for place, time_ns, _, data in recording.messages():
        found.setdefault(recording.topics[place].name, []).append((time_ns, data))
    return found


def read(path: Path, options: ReadOptions = ReadOptions()) -> dict[str, list[tuple[int, bytes]]]:  # noqa: B008 - frozen
    with open_recording(path, options) as recording:
        return messages(recording)


@pytest.fixture
def options(tmp_path: Path) -> ReadOptions:
    (tmp_path / "black_box.yaml").write_text(BLOCK)
    return ReadOptions(ethercat=tmp_path / "black_box.yaml")


def written(path: Path, kind: str, frames: Stamped) -> Path:
    if kind.startswith("ng"):
        return pcapng(path, frames, kind[-1])
    return pcap(path, frames, kind[-1], "ns" in kind)


@pytest.mark.parametrize("kind", ["us<", "us>", "ns<", "ns>", "ng<", "ng>"])
def test_each_format_gives_the_same_messages(
    tmp_path: Path, options: ReadOptions, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ethercat_capture, "_BLOCK", 17)
    monkeypatch.setattr("amberbox.blackbox.formats._recording.ROOM_BYTES", 3000)
    found = read(written(tmp_path / "run", kind, drive()), options)
    assert found["wheels"] == [
        (START_NS + n * 1_000_000 + 40_000, n.to_bytes(12, "little")) for n in range(50)
    ]
    assert found["input"] == [
        (START_NS + n * 1_000_000, n.to_bytes(8, "little")) for n in range(50)
    ]
    assert len(found["bus"]) == 50 and len(found["datagrams"]) == 100
    assert len(found["al_status"]) == 1


def columns(path: Path) -> dict[str, Any]:
    with open_recording(path) as recording:
        found = messages(recording)["datagrams"]
        topic = next(topic for topic in recording.topics if topic.name == "datagrams")
    return columns_of(unroller(topic).rows([data for _, data in found]))


def assert_equal_to_tshark(path: Path) -> None:
    """Compare each datagram: command, index, addresses, working counter."""
    names = ("cmd", "idx", "adp", "ado", "lad", "cnt")
    command = ["tshark", "-r", str(path), "-Y", "ecat", "-T", "fields", "-E", "aggregator= "]
    for name in names:
        command += ["-e", f"ecat.{name}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    read: dict[str, list[int]] = {name: [] for name in names}
    for line in done.stdout.splitlines():
        for name, text in zip(names, line.split("\t"), strict=True):
            read[name] += [int(word, 0) for word in text.split()]
    ours = columns(path)
    assert ours["command"] == read["cmd"] and len(read["cmd"]) > 0
    assert ours["datagram_index"] == read["idx"]
    assert [n for n in ours["slave"] if n is not None] == read["adp"]
    assert [n for n in ours["register"] if n is not None] == read["ado"]
    assert [n for n in ours["logical_address"] if n is not None] == read["lad"]
    assert ours["working_counter"] == read["cnt"]


@pytest.mark.parametrize("kind", ["us<", "ng>"])
def test_datagrams_are_equal_to_tshark(tmp_path: Path, kind: str) -> None:
    assert_equal_to_tshark(written(tmp_path / "run", kind, drive()))


@pytest.mark.needs_data
def test_datagrams_of_real_captures_are_equal_to_tshark(shared_data: Path) -> None:
    captures = sorted((shared_data / "ethercat").glob("*.pcapng"))
    assert len(captures) == 4
    for path in captures:
        assert_equal_to_tshark(path)


@pytest.mark.needs_data
def test_a_run_of_simulated_drives(shared_data: Path, tmp_path: Path) -> None:
    """22 bytes each way of two drives; the positions follow."""
    layout = tmp_path / "black_box.yaml"
    layout.write_text(
        """
ethercat:
  interfaces:
    - interface: ec0
      number_of_slaves: 2
      output_message_size: 11
      output_message_elements: [{name: statusword, type: uint16}]
      input_message_size: 11
      input_message_elements: [{name: controlword, type: uint16}]
"""
    )
    path = shared_data / "ethercat" / "soem_kickcat_ds402.pcapng"
    with open_recording(path, ReadOptions(ethercat=layout)) as recording:
        found = messages(recording)
        topics = {topic.name: topic for topic in recording.topics}
    assert len(found["output"]) == len(found["input"]) == 5000
    rows = unroller(topics["output"]).rows([data for _, data in found["output"]])
    words = np.asarray(rows.columns["slaves_1_statusword"])
    assert (words[0] & 0x6F, words[-1] & 0x6F) == (0x40, 0x27)


def test_the_command_line_imports_a_capture(
    tmp_path: Path, options: ReadOptions, capsys: pytest.CaptureFixture[str]
) -> None:
    path = pcapng(tmp_path / "run.pcapng", drive())
    words = ["import", str(path), "--store", str(tmp_path / "store")]
    assert main([*words, "--ethercat", str(options.ethercat)]) == 0
    assert "eth1: 100 frames out, 100 back, 0 lost" in capsys.readouterr().out
    with amberbox.open(tmp_path / "store") as record:
        table = record.query("ethercat_wheels", ["slaves_0_status"])
        assert np.asarray(table["slaves_0_status"]).tolist() == list(range(50))
        health = record.query("ethercat_bus", ["working_counter"])
        assert set(np.asarray(health["working_counter"]).tolist()) == {6}


def test_direction_flags_of_pcapng_are_used(tmp_path: Path) -> None:
    frames = [(START_NS + n, frame(Part(4, 0x01301001, b"\0\0"), marks=False)) for n in range(6)]
    flags = [2, 1, 2, 2, 2, 1]  # 2: sent
    found = columns(pcapng(tmp_path / "run.pcapng", frames, flags=flags))
    assert found["returned"] == [False, True, False, False, False, True]


def test_other_frames_are_counted(tmp_path: Path) -> None:
    frames = [*drive(2), (START_NS, b"\xff" * 12 + b"\x08\x00" + bytes(50))]
    with open_recording(pcap(tmp_path / "run.pcap", frames)) as recording:
        messages(recording)
        assert any("1 of other protocols" in note for note in recording.report.notes)


@pytest.mark.parametrize("kind", ["us<", "ng<"])
def test_a_cut_capture_is_read_up_to_the_cut(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / "run", kind, drive())
    path.write_bytes(path.read_bytes()[:-30])
    with open_recording(path) as recording:
        assert len(messages(recording)["datagrams"]) == 298
        assert [damage.reason for damage in recording.report.damage] == ["the file is cut short"]


@pytest.mark.parametrize("place", [24 + 8, 28 + 4])
def test_hostile_lengths_are_damage(tmp_path: Path, place: int) -> None:
    path = written(tmp_path / "run", "us<" if place == 32 else "ng<", drive())
    data = bytearray(path.read_bytes())
    data[place : place + 4] = b"\xff\xff\xff\x7f"
    path.write_bytes(data)
    with open_recording(path) as recording:
        assert messages(recording) == {}
        assert "says that it has" in recording.report.damage[0].reason


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(["us<", "ng>"]),
    changes=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=8),
    end=st.integers(4, 3000),
)
def test_any_damage_is_survived(
    tmp_path: Path, kind: str, changes: list[tuple[int, int]], end: int
) -> None:
    path = written(tmp_path / "run", kind, drive(5))
    data = bytearray(path.read_bytes())[:end]
    for place, value in changes:
        if 4 <= place < len(data):
            data[place] = value
    path.write_bytes(data)
    with open_recording(path) as recording:
        found = messages(recording)
        topics = {topic.name: topic for topic in recording.topics}
    for name, some in found.items():
        unroller(topics[name]).rows([data for _, data in some])


def test_a_file_without_the_block_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text("- can: {channel: can0}\n")
    path = pcap(tmp_path / "run.pcap", drive(2))
    with pytest.raises(AmberboxError, match="no blocks 'ethercat:'"):
        read(path, ReadOptions(ethercat=tmp_path / "black_box.yaml"))
