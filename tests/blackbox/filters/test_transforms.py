"""The filter of tf: each frame by itself, never thinning what changed, whatever the batches are."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.filters.transforms import TransformFilter, angle_between
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.source import TopicOptions, TransformOptions
from amberbox.core.types import ItemSchema
from tests.support.manual_recorder import ManualBox, last_counters
from tests.support.tf_messages import IDENTITY, Sent, tf_message, tf_topic

START_NS = 1_700_000_000 * NS
STEP_NS = NS // 10


def turned(angle_rad: float) -> tuple[float, float, float, float]:
    return (0.0, 0.0, math.sin(angle_rad / 2), math.cos(angle_rad / 2))


def kept(
    options: TransformOptions, sent: Sequence[Sequence[Sent]], batch: int, *, cdr: bool = False
) -> list[int]:
    """Return the numbers of the messages kept; one message each 0.1 s."""
    unroll = unroller(tf_topic(cdr=cdr))
    chooser = TransformFilter(options, unroll.schema)
    messages = [tf_message(*transforms, cdr=cdr) for transforms in sent]
    numbers = {message: number for number, message in enumerate(messages)}
    assert len(numbers) == len(messages), "stamps tell the messages apart"
    found: list[int] = []
    for first in range(0, len(messages), batch):
        part = messages[first : first + batch]
        times = START_NS + (first + np.arange(len(part))) * STEP_NS
        chosen = chooser.select(unroll.rows(part), times, part)
        for place, keeps in enumerate(chosen.kept):
            late = [numbers[data] for before, data in chosen.earlier if before == place]
            assert late == sorted(late) and (keeps or not late)
            found += [*late, first + place] if keeps else []
    assert len(set(found)) == len(found)
    return sorted(found)


def at(number: int, child: str, x: float = 0.0, rotation: Sequence[float] = IDENTITY) -> Sent:
    return ("map", child, START_NS + number * STEP_NS, (x, 0.0, 0.0), rotation)


@pytest.mark.parametrize("batch", [1, 3, 100])
@pytest.mark.parametrize("cdr", [False, True])
def test_each_frame_is_compared_with_itself(batch: int, cdr: bool) -> None:
    """Two publishers take turns on one topic; one frame stands still, the other moves once."""
    sent = [
        [at(n, "door", 1.0 if n >= 14 else 0.0)] if n % 2 else [at(n, "lamp")] for n in range(20)
    ]
    options = TransformOptions(heartbeat_s=0)
    # 13 is the last message in which the door was still where it had been
    assert kept(options, sent, batch, cdr=cdr) == [0, 1, 13, 15]


@pytest.mark.parametrize("batch", [1, 4, 100])
def test_tolerances_parents_heartbeats_and_signs(batch: int) -> None:
    options = TransformOptions(translation=0.01, rotation=0.1, heartbeat_s=1.0)
    minus = tuple(-part for part in IDENTITY)
    sent = [
        [at(0, "a")],
        [at(1, "a", 0.009)],
        [at(2, "a", 0.009, turned(0.09))],
        [at(3, "a", 0.0, minus)],  # the same rotation
        [at(4, "a", 0.011)],  # kept, and 3 before it
        [at(5, "a", 0.011, turned(0.11))],  # kept
        [("odom", *at(6, "a", 0.011, turned(0.11))[1:])],  # kept: another parent
        *([("odom", *at(n, "a", 0.011, turned(0.11))[1:])] for n in range(7, 16)),
        [("odom", *at(16, "a", 0.011, turned(0.11))[1:])],  # kept: the heartbeat
        [("odom", *at(17, "a", math.nan, turned(0.11))[1:])],  # kept
        [("odom", *at(18, "a", math.nan, turned(0.11))[1:])],
        [("odom", *at(19, "a", 0.011, turned(0.11))[1:])],  # kept, and 18 before it
        [],
    ]
    assert kept(options, sent, batch) == [0, 3, 4, 5, 6, 16, 17, 18, 19, 20]


@pytest.mark.parametrize("seed", range(6))
def test_what_was_dropped_is_within_the_tolerance_of_what_readers_interpolate(seed: int) -> None:
    rng = random.Random(seed)
    positions = {"a": 0.0, "b": 0.0, "c": 0.0}
    sent: list[list[Sent]] = []
    for n in range(300):
        frames = rng.sample(sorted(positions), rng.randrange(1, 4))
        for frame in frames:
            positions[frame] += rng.choice([0.0] * 8 + [0.004, 0.2])
        sent.append([at(n, frame, positions[frame]) for frame in frames])
    options = TransformOptions(translation=0.01, heartbeat_s=2.0)
    found = kept(options, sent, rng.randrange(1, 50))
    assert kept(options, sent, 1) == found and len(found) < 250
    for frame in positions:
        truth = [(s[2], s[3][0]) for transforms in sent for s in transforms if s[1] == frame]
        left = [(s[2], s[3][0]) for n in found for s in sent[n] if s[1] == frame]
        stamps = [float(stamp - START_NS) for stamp, _ in left]
        for stamp, x in truth:
            if stamps[0] <= stamp - START_NS <= stamps[-1]:
                seen = np.interp(stamp - START_NS, stamps, [x for _, x in left])
                assert abs(seen - x) <= 0.02 + 1e-9  # 0.01 from each end
        gaps = np.diff(stamps)
        assert gaps.max(initial=0) <= 2 * NS + 20 * STEP_NS


def test_the_angle_of_small_and_large_turns() -> None:
    for angle in (1e-9, 0.3, 3.1):
        other = [-2 * part for part in turned(angle)]
        assert angle_between(IDENTITY, other) == pytest.approx(angle, rel=1e-6)
    assert math.isnan(angle_between(IDENTITY, (0.0, 0.0, 0.0, 0.0)))


def test_the_recorder_thins_and_its_counters_add_up(tmp_path: Path) -> None:
    options = TopicOptions("/tf", transforms=TransformOptions(heartbeat_s=0))
    box = ManualBox(tmp_path / "store", [options])
    for n in range(100):
        box.hear(tf_topic(), tf_message(at(n, "a", 5.0 if n >= 60 else 1.0)))
        if n % 7 == 0:
            box.write(0.1)
    box.hear(tf_topic(), b"damaged")
    box.write()
    box.close()
    counters = last_counters(tmp_path / "store")["ros_tf"]
    assert counters["received"] == 101
    assert counters["kept"] == 4 and counters["unchanged"] == 97  # 0, 59, 60, the damaged one
    with amberbox.open(tmp_path / "store") as record:
        rows = record.query("ros_tf__transforms", ["transform_translation_x", "header_stamp"])
        assert rows.values("transform_translation_x") == [1.0, 1.0, 5.0]
        assert rows.values("header_stamp") == [START_NS + n * STEP_NS for n in (0, 59, 60)]


def test_other_messages_and_contradictions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no message of tf"):
        TransformFilter(TransformOptions(), ItemSchema("a/B", ()))
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text(
        "- ros: {topics: [{name: /tf, change: {}, transforms: {rotation: -1}}]}\n"
    )
    with pytest.raises(AmberboxError, match=r"transforms\.rotation: must be 0 or more"):
        load_folder(tmp_path)
    (tmp_path / "black_box.yaml").write_text(
        "- ros: {topics: [{name: /tf, change: {}, transforms: {}}]}\n"
    )
    with pytest.raises(AmberboxError, match="does not go together with 'change'"):
        load_folder(tmp_path)
