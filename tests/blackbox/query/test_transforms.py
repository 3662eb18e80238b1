"""Frames of a record: the transform between two at a time, against matrices; and 'amberbox tf'."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import foxglove
import numpy as np
import pytest
from foxglove import Context
from foxglove import messages as fox
from foxglove.channels import FrameTransformChannel
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer

import amberbox
from amberbox.blackbox.query.transforms import slerp
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from tests.support.tf_messages import IDENTITY, KIND, STORE, Sent, tf_message

T0_NS = 1_700_000_000 * NS
STEP_NS = NS // 10


def about_z(angle_rad: float) -> tuple[float, float, float, float]:
    return (0.0, 0.0, math.sin(angle_rad / 2), math.cos(angle_rad / 2))


def matrix(translation: Sequence[float], angle_rad: float) -> NDArray[np.float64]:
    found = np.eye(4)
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    found[:2, :2] = [[c, -s], [s, c]]
    found[:3, 3] = translation
    return found


def write_bag(path: Path, sent: Sequence[tuple[str, int, Sent]]) -> Path:
    """Write messages of one transform each: topic, time of receipt, transform."""
    with Writer(path) as writer:
        topics = {topic for topic, _, _ in sent}
        connections = {
            topic: writer.add_connection(topic, KIND, typestore=STORE) for topic in sorted(topics)
        }
        for topic, received_ns, transform in sent:
            writer.write(connections[topic], received_ns, tf_message(transform))
    return path


def drive(n: int) -> tuple[tuple[float, float, float], float]:
    """Return where odom sees base_link at a step, and its heading."""
    return (n * 0.1, 2.0, 0.0), n * 0.02


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    sent: list[tuple[str, int, Sent]] = []
    static = ("base_link", "laser", T0_NS, (0.5, 0.0, 0.2), about_z(math.pi / 2))
    sent.append(("/tf_static", T0_NS, static))
    for n in range(100):
        at_ns = T0_NS + n * STEP_NS
        where, heading = drive(n)
        sent.append(("/tf", at_ns + 10**6, ("odom", "base_link", at_ns, where, about_z(heading))))
        if n % 10 == 0:
            sent.append(("/tf", at_ns + 10**6, ("/map", "odom", at_ns, (1.0, 0.0, 0.0), IDENTITY)))
    sent.append(("/tf", T0_NS, ("else", "where", T0_NS, (0.0, 0.0, 0.0), IDENTITY)))
    sent.append(("/tf", T0_NS + NS, ("else", "where", T0_NS + 8 * NS, (0.0,) * 3, IDENTITY)))
    return write_bag(tmp_path / "tf.bag", sent)


@pytest.mark.parametrize("step", [0, 10, 33, 33.4, 89.95])
def test_chains_are_those_of_matrices(bag: Path, step: float) -> None:
    at_ns = T0_NS + round(step * STEP_NS)
    (x, y, z), heading = drive(0)
    odom = matrix((x + step * 0.1, y, z), heading + step * 0.02)
    laser = matrix((0.5, 0.0, 0.2), math.pi / 2)
    wanted = matrix((1.0, 0.0, 0.0), 0.0) @ odom @ laser
    with amberbox.open(bag) as record:
        found = record.transform("map", "laser", at_ns)
        np.testing.assert_allclose(found.matrix, wanted, atol=1e-9)
        back = record.transform("laser", "/map", at_ns)
        np.testing.assert_allclose(back.matrix, np.linalg.inv(wanted), atol=1e-9)
        side = record.transform("laser", "odom", at_ns)
        np.testing.assert_allclose(side.matrix, np.linalg.inv(odom @ laser), atol=1e-9)
        same = record.transform("odom", "odom", at_ns)
        np.testing.assert_allclose(same.matrix, np.eye(4))
    assert (found.target, found.source, found.at_ns) == ("map", "laser", at_ns)


def test_without_a_time_it_is_the_newest_that_all_frames_have(bag: Path) -> None:
    with amberbox.open(bag) as record:
        assert record.transform("map", "laser").at_ns == T0_NS + 90 * STEP_NS
        assert record.transform("odom", "laser").at_ns == T0_NS + 99 * STEP_NS
        assert record.transform("base_link", "laser").translation.tolist() == [0.5, 0.0, 0.2]


@pytest.mark.parametrize(
    ("frames", "step", "what", "hint"),
    [
        (("map", "lasr"), 5, "no frame 'lasr'; did you mean 'laser'?", "frames: base_link"),
        (("map", "where"), 5, "no path from 'where' to 'map'", "'where' is below 'else'"),
        (("map", "laser"), 95, "'odom' is not known at", "from 2023-11-14T22:13:20"),
        (("odom", "laser"), -5, "'base_link' is not known at", "from 2023-11-14T22:13:20"),
    ],
)
def test_what_cannot_be_answered_is_told(
    bag: Path, frames: tuple[str, str], step: int, what: str, hint: str
) -> None:
    with amberbox.open(bag) as record, pytest.raises(UsageError) as caught:
        record.transform(*frames, T0_NS + step * STEP_NS)
    assert what in caught.value.what and hint in caught.value.hint


def test_a_new_parent_counts_from_its_stamp_on_and_cycles_are_told(tmp_path: Path) -> None:
    def sent(parent: str, child: str, n: int, x: float) -> tuple[str, int, Sent]:
        at_ns = T0_NS + n * STEP_NS
        return "/tf", at_ns, (parent, child, at_ns, (x, 0.0, 0.0), IDENTITY)

    messages = [
        sent("table", "cup", 0, 1.0), sent("table", "cup", 2, 3.0), sent("hand", "cup", 4, 9.0),
        sent("hand", "cup", 8, 9.0), sent("b", "a", 0, 0.0), sent("a", "b", 0, 0.0),
        sent("b", "a", 9, 0.0), sent("a", "b", 9, 0.0),
    ]  # fmt: skip
    with amberbox.open(write_bag(tmp_path / "t.bag", messages)) as record:
        assert record.transform("table", "cup", T0_NS + STEP_NS).translation[0] == 2.0
        assert record.transform("table", "cup", T0_NS + 3 * STEP_NS).translation[0] == 3.0
        assert record.transform("hand", "cup", T0_NS + 4 * STEP_NS).translation[0] == 9.0
        with pytest.raises(UsageError, match="no path"):
            record.transform("table", "cup", T0_NS + 4 * STEP_NS)
        with pytest.raises(UsageError, match="own parents"):
            record.transform("a", "b", T0_NS)


def test_slerp_takes_the_shortest_arc_at_even_speed() -> None:
    start, end = np.array(about_z(0.2)), -np.array(about_z(1.4))
    for part in (0.0, 0.25, 0.5, 1.0):
        wanted = np.array(about_z(0.2 + part * 1.2))
        assert abs(float(slerp(start, end, part) @ wanted)) == pytest.approx(1.0, abs=1e-12)


def test_transforms_without_a_rotation_or_of_another_clock_do_no_harm(tmp_path: Path) -> None:
    zero: Sent = ("a", "broken", T0_NS, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 0.0))
    simulated = [
        ("/tf", T0_NS + n * NS, ("a", "b", n * NS + NS, (float(n), 0.0, 0.0), IDENTITY))
        for n in range(100)
    ]
    bag = write_bag(tmp_path / "t.bag", [("/tf", T0_NS, zero), *simulated])
    with amberbox.open(bag) as record:
        assert record.transform("a", "b", 50 * NS + NS // 2).translation[0] == 49.5
        with pytest.raises(UsageError, match="no frame 'broken'"):
            record.transform("a", "broken")


def test_frames_of_foxglove_are_found(tmp_path: Path) -> None:
    path, context = tmp_path / "fox.mcap", Context()
    with foxglove.open_mcap(path, context=context):
        channel = FrameTransformChannel("/frames", context=context)
        for n in range(3):
            channel.log(
                fox.FrameTransform(
                    timestamp=fox.Timestamp(T0_NS // NS + n, 0), parent_frame_id="map",
                    child_frame_id="base", translation=fox.Vector3(x=float(n), y=0.0, z=0.0),
                    rotation=fox.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
                ),
                log_time=T0_NS + n * NS,
            )  # fmt: skip
    with amberbox.open(path) as record:
        found = record.transform("map", "base", T0_NS + NS // 2)
        assert found.translation.tolist() == [0.5, 0.0, 0.0]


def test_the_command_prints_the_tree_and_transforms(
    bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tf", str(bag)]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.split("  ")[0] if line[:1] != " " else line.rstrip() for line in lines]
    order = [next(i for i, line in enumerate(lines) if line.strip().startswith(f"{frame} ")
                  or line.strip() == frame)
             for frame in ("else", "where", "map", "odom", "base_link", "laser")]  # fmt: skip
    assert order == sorted(order), names
    assert "static" in lines[order[-1]] and "10" in lines[order[-2]]
    assert main(["tf", str(bag), "--json", "--at", "2023-11-14T22:13:25Z"]) == 0
    frames = {row["frame"]: row for row in json.loads(capsys.readouterr().out)}
    assert frames["base_link"]["parent"] == "odom"
    assert frames["base_link"]["rate_hz"] == pytest.approx(10.0)
    assert 0 <= frames["base_link"]["age_s"] <= 0.1 and frames["laser"]["static"]
    assert main(["tf", str(bag), "map", "laser", "--at", "2023-11-14T22:13:21Z"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("laser in map at 2023-11-14T22:13:21")
    assert "101.459156 deg" in out
    assert main(["tf", str(bag), "map", "laser", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["matrix"][3] == [0, 0, 0, 1]
    assert main(["tf", str(bag), "map"]) == 2
    assert main(["tf", str(bag), "map", "nowhere"]) == 2
    assert "hint: frames:" in capsys.readouterr().err


@pytest.mark.needs_data
def test_a_real_recording_of_an_old_ros_has_its_frames(shared_data: Path) -> None:
    """``tf/tfMessage``, before tf2; the twin on generated data is above."""
    with amberbox.open(shared_data / "recordings" / "plotjuggler_tilt_laser.bag") as record:
        found = record.transform("tilt_base", "laser")
        back = record.transform("laser", "tilt_base", found.at_ns)
        np.testing.assert_allclose(found.matrix @ back.matrix, np.eye(4), atol=1e-9)
        rotation = found.matrix[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
