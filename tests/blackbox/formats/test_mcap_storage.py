"""Plain MCAP files of other writers: finished, unfinished, torn, without chunks or summary."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from amberbox.blackbox.formats._open import open_recording
from tests.blackbox.formats.conftest import read_all

Messages = list[tuple[str, int, bytes]]
EXPECTED = [
    (f"/json{n % 3}", 1000 + n, json.dumps({"n": n, "pad": "x" * (n % 50)}).encode())
    for n in range(1500)
]


def write_mcap(path: Path, *, finish: bool = True, **options: Any) -> None:
    """Write JSON messages, each channel with its own schema, one of them with none."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="", library="test")
        schema = writer.register_schema("Thing", "jsonschema", b'{"type": "object"}')
        channels = {
            f"/json{n}": writer.register_channel(f"/json{n}", "json", schema if n else 0)
            for n in range(3)
        }
        for sequence, (topic, time_ns, data) in enumerate(EXPECTED):
            writer.add_message(channels[topic], time_ns, data, time_ns - 5, sequence)
        if finish:
            writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped


VARIANTS: list[dict[str, Any]] = [
    {"compression": CompressionType.NONE, "chunk_size": 2000},
    {"compression": CompressionType.LZ4, "chunk_size": 2000},
    {"compression": CompressionType.ZSTD, "chunk_size": 2000},
    {"use_chunking": False},
    {"use_statistics": False, "chunk_size": 2000},
    {"index_types": IndexType.NONE, "chunk_size": 2000},
    {"index_types": IndexType.CHUNK, "chunk_size": 2000},
    {"repeat_channels": False, "repeat_schemas": False, "chunk_size": 2000},
    {"use_summary_offsets": False, "chunk_size": 2000, "enable_crcs": False},
    {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
        "chunk_size": 2000,
    },
]


@pytest.mark.parametrize("options", VARIANTS)
def test_finished_file_gives_every_message(tmp_path: Path, options: dict[str, Any]) -> None:
    write_mcap(tmp_path / "a.mcap", **options)
    found, recording = read_all(tmp_path / "a.mcap")
    assert found == EXPECTED
    assert recording.report.damage == []
    assert recording.report.notes == []
    by_name = {t.name: t for t in recording.topics}
    assert by_name["/json0"].schema is None
    schema = by_name["/json1"].schema
    assert schema is not None
    assert (schema.name, schema.encoding, schema.data) == (
        "Thing", "jsonschema", b'{"type": "object"}',
    )  # fmt: skip


def test_times_and_bytes_equal_the_mcap_library(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap")
    with (tmp_path / "a.mcap").open("rb") as file:
        expected = [
            (c.topic, m.log_time, m.publish_time, m.data)
            for _, c, m in make_reader(file).iter_messages()
        ]
    with open_recording(tmp_path / "a.mcap") as recording:
        found = [
            (recording.topics[m.topic_index].name, m.log_time_ns, m.publish_time_ns, m.data)
            for m in recording.messages()
        ]
    assert found == expected


def test_unfinished_file_streams_to_its_last_chunk(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", finish=False, chunk_size=2000)
    found, recording = read_all(tmp_path / "a.mcap")
    assert found == EXPECTED[: len(found)]
    assert len(found) > 1400
    assert recording.report.notes == ["a.mcap was never finished; it has no summary"]


@pytest.mark.parametrize(
    "compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]
)
def test_torn_file_gives_a_prefix(tmp_path: Path, compression: CompressionType) -> None:
    write_mcap(tmp_path / "a.mcap", compression=compression, chunk_size=2000)
    content = (tmp_path / "a.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    for cut in range(8, len(content), len(content) // 60):
        torn.write_bytes(content[:cut])
        found, recording = read_all(torn)
        assert found == EXPECTED[: len(found)]
        assert recording.report.damage or recording.report.notes


def test_one_big_torn_chunk_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", compression=CompressionType.NONE)
    content = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(content[: len(content) // 2])
    found, recording = read_all(tmp_path / "torn.mcap")
    assert found == EXPECTED[: len(found)]
    assert len(found) > 500
    note = f"{len(found)} messages come from a torn chunk that no checksum covers"
    assert note in recording.report.notes


@pytest.mark.parametrize("walked", [False, True])
def test_damaged_chunk_costs_only_itself(tmp_path: Path, walked: bool) -> None:
    write_mcap(tmp_path / "a.mcap", compression=CompressionType.ZSTD, chunk_size=2000)
    content = bytearray((tmp_path / "a.mcap").read_bytes())
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[5]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    if walked:
        content = content[:-50]
    (tmp_path / "b.mcap").write_bytes(content)
    found, recording = read_all(tmp_path / "b.mcap")
    assert len(EXPECTED) - 60 <= len(found) < len(EXPECTED)
    assert set(found) < set(EXPECTED)
    assert chunk.chunk_start_offset in [d.offset for d in recording.report.damage]


def test_definition_that_is_missing_is_completed(
    tmp_path: Path, messages: Messages, ros2_bag: Callable[..., None]
) -> None:
    pose = next(data for topic, _, data in messages if topic == "/odom")
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("geometry_msgs/msg/Pose", "", b"")
        qos = {"offered_qos_profiles": "- durability: 1\n"}
        writer.add_message(writer.register_channel("/odom", "cdr", schema, qos), 1, pose, 1)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped
    found, recording = read_all(tmp_path / "a.mcap")
    assert found == [("/odom", 1, pose)]
    assert recording.topics[0].latched
    schema_found = recording.topics[0].schema
    assert schema_found is not None
    assert (schema_found.encoding, schema_found.data[:6]) == ("ros2msg", b"geomet")
