"""Real recordings through a store and out again: nothing is added, lost or changed.

Their twins on generated data are in ``test_export_bag`` and ``test_export_mcap``.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import View

pytestmark = pytest.mark.needs_data
Found = list[tuple[str, int, bytes]]


def contents(path: Path) -> tuple[Found, dict[str, tuple[str, str, str]]]:
    """Return messages in order, and type, MD5 sum and definition of each topic."""
    with Reader(path) as reader:
        messages = [(c.topic, at_ns, bytes(data)) for c, at_ns, data in reader.messages()]
        kinds = {c.topic: (c.msgtype, c.digest, c.msgdef.data) for c in reader.connections}
    return sorted(messages), kinds


@pytest.mark.parametrize("name", ["rosbagjs_example.bag", "plotjuggler_tilt_laser.bag"])
def test_a_bag_comes_out_as_it_went_in(shared_data: Path, tmp_path: Path, name: str) -> None:
    original = shared_data / "recordings" / name
    with amberbox.open(original) as record:
        report = export(record, View(), tmp_path / "out.bag", "bag")
    assert not report.missing
    before, after = contents(original), contents(tmp_path / "out.bag")
    assert after[0] == before[0]
    assert after[1] == before[1]


def test_a_ros2_bag_comes_out_as_it_went_in(shared_data: Path, tmp_path: Path) -> None:
    original = shared_data / "recordings" / "plotjuggler_rosbag2_test"
    with amberbox.open(original) as record:
        export(record, View(), tmp_path / "out.mcap", "mcap")
    found = []
    for path in (original, tmp_path / "out.mcap"):
        types = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([path], default_typestore=types) as reader:
            found.append(sorted((c.topic, t, bytes(data)) for c, t, data in reader.messages()))
    assert len(found[0]) > 4000
    assert found[0] == found[1]
