"""ROS 1 bags read like rosbags reads them; broken ones as far as they go, with a report."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader

from amberbox.blackbox.formats._open import open_recording
from amberbox.blackbox.formats.ros1_bag import parse_fields
from amberbox.core.errors import AmberboxError
from tests.blackbox.formats.conftest import read_all
from tests.fuzzing import examples, fuzz

Messages = list[tuple[str, int, bytes]]
WriteBag = Callable[..., None]
BAG_SIZE_WITHOUT_MAGIC = 13


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_generated_bag_gives_every_message(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag, compression: str
) -> None:
    ros1_bag(tmp_path / "a.bag", messages, compression)
    found, recording = read_all(tmp_path / "a.bag")
    assert found == messages
    assert recording.report.damage == []
    assert recording.report.messages == len(messages)
    assert recording.progress == 1.0
    assert (recording.report.start_ns, recording.report.end_ns) == (messages[0][1], messages[-1][1])
    odom = next(t for t in recording.topics if t.name == "/odom")
    assert odom.message_encoding == "ros1"
    assert odom.schema is not None
    assert (odom.schema.name, odom.schema.encoding) == ("geometry_msgs/Pose", "ros1msg")
    assert b"MSG: geometry_msgs/Quaternion" in odom.schema.data


def test_messages_of_a_time_range(tmp_path: Path, messages: Messages, ros1_bag: WriteBag) -> None:
    ros1_bag(tmp_path / "a.bag", messages)
    low, high = messages[500][1], messages[1500][1]
    with open_recording(tmp_path / "a.bag") as recording:
        found = [m.data for m in recording.messages(low, high)]
    assert found == [data for _, t, data in messages if low <= t < high]


def test_messages_out_of_order_come_in_order(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag
) -> None:
    shuffled = list(messages)
    random.Random(3).shuffle(shuffled)  # a repeatable sequence, no secret
    ros1_bag(tmp_path / "a.bag", shuffled)
    found, _ = read_all(tmp_path / "a.bag")
    assert [t for _, t, _ in found] == [t for _, t, _ in messages]
    assert sorted(found) == sorted(messages)


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1))
def test_truncated_bag_gives_a_prefix(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag, compression: str, share: float
) -> None:
    whole = tmp_path / "whole.bag"
    if not whole.exists():
        ros1_bag(whole, messages[:600], compression)
    content = whole.read_bytes()
    cut = BAG_SIZE_WITHOUT_MAGIC + int(share * (len(content) - BAG_SIZE_WITHOUT_MAGIC))
    torn = tmp_path / "torn.bag"
    torn.write_bytes(content[:cut])
    found, recording = read_all(torn)
    assert found == messages[: len(found)]
    assert len(found) == 600 or recording.report.damage
    if not compression and cut < len(content):
        # a message is lost only if it is cut itself: the next one ends behind the cut
        ends = content.find(messages[len(found)][2]) if len(found) < 600 else len(content)
        assert ends + len(messages[min(len(found), 599)][2]) > cut


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1), length=st.sampled_from([1, 100, 4096]), fill=st.binary(min_size=1))
def test_damage_costs_only_what_it_touches(
    tmp_path: Path,
    messages: Messages,
    ros1_bag: WriteBag,
    compression: str,
    share: float,
    length: int,
    fill: bytes,
) -> None:
    whole = tmp_path / "whole.bag"
    if not whole.exists():
        ros1_bag(whole, messages[:600], compression)
    content = bytearray(whole.read_bytes())
    at = BAG_SIZE_WITHOUT_MAGIC + int(share * (len(content) - length - BAG_SIZE_WITHOUT_MAGIC))
    content[at : at + length] = (fill * length)[:length]
    broken = tmp_path / "broken.bag"
    broken.write_bytes(content)
    found, recording = read_all(broken)
    chunk, smallest_chunk = 4096 + 400, 700  # bytes unpacked at most, packed at least
    touched = length // (smallest_chunk if compression else chunk) + 2
    assert len(set(found) & set(messages)) >= 600 - touched * (chunk // 50)
    assert len(found) == 600 or recording.report.damage


def overwrite(content: bytes, at: int, value: bytes) -> bytes:
    return content[:at] + value + content[at + len(value) :]


def test_a_wrong_length_costs_no_other_message(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag
) -> None:
    """A message that claims those behind it as well ends where the next one starts."""
    ros1_bag(tmp_path / "a.bag", messages[:300])
    content = (tmp_path / "a.bag").read_bytes()
    for claimed in (3, 500, 1 << 30):
        for number in (0, 99, 130):
            data = messages[number][2]
            length = (len(data) + claimed).to_bytes(4, "little")
            (tmp_path / "b.bag").write_bytes(overwrite(content, content.find(data) - 4, length))
            found, recording = read_all(tmp_path / "b.bag")
            assert found == messages[:300], (claimed, number)
            assert any("too many" in d.reason for d in recording.report.damage)


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_a_damaged_chunk_header_costs_no_message(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag, compression: str
) -> None:
    ros1_bag(tmp_path / "a.bag", messages[:300], compression)
    content = (tmp_path / "a.bag").read_bytes()
    name = f"compression={compression or 'none'}".encode()
    at = content.find(name, content.find(name) + 1)  # of the second chunk
    ends = content.find(b"size=", at) + 9
    length = int.from_bytes(content[ends : ends + 4], "little")
    broken = [
        overwrite(content, ends, (length + 5000).to_bytes(4, "little")),
        overwrite(content, ends, (1 << 30).to_bytes(4, "little")),
        overwrite(content, ends - 4, (100).to_bytes(4, "little")),
        overwrite(content, at, b"compression=?"),
    ]
    for number, changed in enumerate(broken):
        (tmp_path / "b.bag").write_bytes(changed)
        found, recording = read_all(tmp_path / "b.bag")
        assert found == messages[:300], number
        assert recording.report.damage or (number == 2 and not compression)


@fuzz
@settings(
    max_examples=examples(60),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_costs_one_message_at_most(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag, share: float, bit: int
) -> None:
    whole = tmp_path / "whole.bag"
    if not whole.exists():
        ros1_bag(whole, messages[:200])
    content = bytearray(whole.read_bytes())
    first, last = content.find(b"op=\x05"), content.rfind(b"op=\x04")
    at = first + int(share * (last - first))  # the chunks and what the index says of each
    content[at] ^= 1 << bit
    (tmp_path / "flipped.bag").write_bytes(content)
    found, _ = read_all(tmp_path / "flipped.bag")
    assert len(set(found) & set(messages[:200])) >= 199


def test_report_names_where_a_bag_is_cut(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag
) -> None:
    ros1_bag(tmp_path / "a.bag", messages)
    content = (tmp_path / "a.bag").read_bytes()
    torn = tmp_path / "torn.bag"
    torn.write_bytes(content[:100_000])
    _, recording = read_all(torn)
    damage = next(d for d in recording.report.damage if d.reason.startswith("chunk cut short"))
    assert 100_000 - 6000 < damage.offset < 100_000
    assert damage.offset + damage.length == 100_000
    assert damage.file == "torn.bag"
    lines = recording.report.lines(recording.topics)
    assert f"damaged: torn.bag: {damage.length} bytes at byte {damage.offset}" in "\n".join(lines)
    assert any(line.endswith("chunks missing") for line in lines)


def test_two_connections_of_a_topic_are_one_topic_and_latched_is_kept(
    tmp_path: Path, messages: Messages, ros1_bag: WriteBag
) -> None:
    ros1_bag(tmp_path / "a.bag", messages[:10])
    content = (tmp_path / "a.bag").read_bytes()
    with open_recording(tmp_path / "a.bag") as recording:
        assert [t.latched for t in recording.topics] == [False, False]
    # the second connection gets the name and type of the first
    assert content.count(b"topic=/text") > 0
    renamed = content.replace(b"topic=/text", b"topic=/odom")
    (tmp_path / "b.bag").write_bytes(renamed)
    with open_recording(tmp_path / "b.bag") as recording:
        names = [(t.name, t.schema.name) for t in recording.topics if t.schema]
    assert names == [("/odom", "geometry_msgs/Pose"), ("/odom", "std_msgs/String")]


def test_encrypted_bag_is_refused(tmp_path: Path, messages: Messages, ros1_bag: WriteBag) -> None:
    ros1_bag(tmp_path / "a.bag", messages[:10])
    content = (tmp_path / "a.bag").read_bytes()
    start = len(b"#ROSBAG V2.0\n")
    length = int.from_bytes(content[start : start + 4], "little")
    field = b"encryptor=rosbag/AesCbcEncryptor"
    header = content[start + 4 : start + 4 + length] + len(field).to_bytes(4, "little") + field
    rest = content[start + 4 + length :]
    made = content[:start] + len(header).to_bytes(4, "little") + header + rest
    (tmp_path / "b.bag").write_bytes(made)
    with pytest.raises(AmberboxError, match="encrypted"):
        open_recording(tmp_path / "b.bag")


@pytest.mark.parametrize("header", [b"\1", b"\5\0\0\0abc", b"\3\0\0\0abc"])
def test_what_is_no_header_is_none(header: bytes) -> None:
    assert parse_fields(header) is None


@pytest.mark.needs_data
@pytest.mark.parametrize(
    "name",
    [
        "imu_ardrone.bag",
        "plotjuggler_fake_joint_state.bag",
        "plotjuggler_tilt_laser.bag",
        "rosbagjs_example.bag",
        "rosbagjs_example-bz2.bag",
        "rosbagjs_example-lz4.bag",
    ],
)
def test_real_bag_equals_rosbags(shared_data: Path, name: str) -> None:
    path = shared_data / "recordings" / name
    with Reader(path) as reader:
        expected = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        types = {(c.topic, c.msgtype.replace("/msg/", "/")) for c in reader.connections}
        definitions = {c.topic: c.msgdef.data for c in reader.connections}
    found, recording = read_all(path)
    assert found == expected
    assert recording.report.damage == []
    assert {(t.name, t.schema.name) for t in recording.topics if t.schema} == types
    for topic in recording.topics:
        assert topic.schema is not None
        assert topic.schema.data.decode() == definitions[topic.name]


@pytest.mark.needs_data
def test_real_truncated_bag_gives_what_is_there(shared_data: Path) -> None:
    found, recording = read_all(shared_data / "recordings" / "test_truncated.bag")
    assert [(topic, len(data)) for topic, _, data in found] == [
        ("/rosout_agg", 110),
        ("/rosout_agg", 101),
        ("/rosout_agg", 103),
    ]
    assert [d.reason for d in recording.report.damage] == [
        "chunk cut short, 3718 bytes are missing",
        "no record can be read here",
    ]
    assert recording.report.notes == ["the bag was never closed; it has no index"]
