"""Names of variables as people write them, legacy configurations included."""

from __future__ import annotations

import pytest

from amberbox.blackbox.columns.variables import select_columns
from amberbox.core.types import Column, ItemSchema


def schema(*paths: str, children: dict[str, ItemSchema] | None = None) -> ItemSchema:
    columns = (Column(path.replace("/", "_"), path, "float64") for path in paths)
    return ItemSchema("p/T", tuple(columns), children or {})


ODOM = schema(
    "header/frame_id",
    "child_frame_id",
    "pose/pose/position/x",
    "pose/pose/position/y",
    "pose/covariance/0",
    "pose/covariance/1",
    "twist/covariance/0",
    "sensors/0/velocity",
    "sensors/1/velocity",
    "max_x",
    children={"poses": schema("position/x", "name")},
)


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("pose/pose/position/x", ["pose_pose_position_x"]),
        ("pose.pose.position.x", ["pose_pose_position_x"]),
        ("pose_pose_position_x", ["pose_pose_position_x"]),
        ("/pose/pose/position/", ["pose_pose_position_x", "pose_pose_position_y"]),
        ("x", ["pose_pose_position_x", "poses"]),
        ("position/y", ["pose_pose_position_y"]),
        ("position/x", ["pose_pose_position_x", "poses"]),
        ("frame_id", ["header_frame_id"]),
        ("covariance", ["pose_covariance_0", "pose_covariance_1", "twist_covariance_0"]),
        ("pose/covariance", ["pose_covariance_0", "pose_covariance_1"]),
        ("covariance[1]", ["pose_covariance_1"]),
        ("sensors", ["sensors_0_velocity", "sensors_1_velocity"]),
        ("velocity", ["sensors_0_velocity", "sensors_1_velocity"]),
        ("poses", ["poses"]),
        ("poses/name", ["poses"]),
        ("poses/position", ["poses"]),
    ],
)
def test_entries_match_paths_else_endings(pattern: str, expected: list[str]) -> None:
    assert select_columns(ODOM, [pattern]) == (tuple(expected), ())


@pytest.mark.parametrize(
    "pattern", ["pos", "ose/pose", "position_x", "", "/", "X", "x/y", "poses/z"]
)
def test_entries_that_match_nothing_are_returned(pattern: str) -> None:
    assert select_columns(ODOM, [pattern, "max_x"]) == (("max_x",), (pattern,))


@pytest.mark.parametrize("patterns", [None, [], ()])
def test_no_entries_mean_everything(patterns: list[str] | None) -> None:
    names, unmatched = select_columns(ODOM, patterns)
    assert names == (*(column.name for column in ODOM.columns), "poses") and unmatched == ()


def test_an_exact_path_leaves_longer_ones_alone() -> None:
    twice = schema("velocity", "wheel/velocity", "velocity_2/velocity")
    assert select_columns(twice, ["velocity"]) == (("velocity",), ())


def test_the_result_is_in_schema_order_without_repeats() -> None:
    names, _ = select_columns(ODOM, ["position/y", "pose/pose/position", "child_frame_id"])
    assert names == ("child_frame_id", "pose_pose_position_x", "pose_pose_position_y")
