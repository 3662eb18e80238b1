"""Variables by the names people use."""

from __future__ import annotations

import pytest

from amberbox.blackbox.columns.variables import (
    configured_columns,
    find_columns,
    resolve_columns,
    suggest_names,
)
from amberbox.core.errors import UsageError
from amberbox.core.types import Column

PATHS = [
    "pose/pose/position/x",
    "pose/pose/position/y",
    "pose/covariance/0",
    "pose/covariance/17",
    "twist/twist/linear/x",
    "header/stamp",
    "x",
]
COLUMNS = [Column(path.replace("/", "_"), path, "float64") for path in PATHS]
COLUMNS.append(Column("ranges", "ranges", "list<float32>"))


def paths(columns: list[Column]) -> list[str]:
    return [column.path for column in columns]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pose_pose_position_x", ["pose/pose/position/x"]),
        ("POSE_POSE_POSITION_X", ["pose/pose/position/x"]),
        ("pose/pose/position/x", ["pose/pose/position/x"]),
        ("pose.pose.position.x", ["pose/pose/position/x"]),
        ("/position/y", ["pose/pose/position/y"]),
        ("stamp", ["header/stamp"]),
        ("x", ["x"]),
        ("covariance[17]", ["pose/covariance/17"]),
        ("pose.covariance[0]", ["pose/covariance/0"]),
        ("position", ["pose/pose/position/x", "pose/pose/position/y"]),
        ("twist/twist", ["twist/twist/linear/x"]),
        ("nothing", []),
        ("", []),
    ],
)
def test_find(name: str, expected: list[str]) -> None:
    assert paths(find_columns(COLUMNS, name)) == expected


def test_a_name_that_fits_twice_is_ambiguous() -> None:
    with pytest.raises(UsageError, match="ambiguous: pose/pose/position/x or twist/twist/linear/x"):
        find_columns(COLUMNS[:-2], "x")


def test_an_element_of_a_list_has_a_name_of_its_own() -> None:
    wanted = resolve_columns(COLUMNS, ["ranges[17]", "ranges", "ranges[-1]"], "scan")
    assert [(w.name, w.element) for w in wanted] == [
        ("ranges[17]", 17),
        ("ranges", None),
        ("ranges[-1]", -1),
    ]


def test_each_column_comes_once_in_the_order_asked_for() -> None:
    wanted = resolve_columns(COLUMNS, ["position/y", "position"], "odom")
    assert [w.column.path for w in wanted] == ["pose/pose/position/y", "pose/pose/position/x"]


@pytest.mark.parametrize(
    ("name", "hint"), [("positon/x", "position/x"), ("rangse", "ranges"), ("!!", "it has")]
)
def test_an_unknown_name_is_answered_with_the_closest(name: str, hint: str) -> None:
    with pytest.raises(UsageError, match="odom has no variable") as caught:
        resolve_columns(COLUMNS, [name], "odom")
    assert hint in caught.value.hint


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([], [*PATHS, "ranges"]),
        (["linear/x"], ["twist/twist/linear/x"]),
        (["x"], ["x"]),
        (["pose/pose"], ["pose/pose/position/x", "pose/pose/position/y"]),
        (["covariance/*"], ["pose/covariance/0", "pose/covariance/17"]),
        (["pose_cov*"], ["pose/covariance/0", "pose/covariance/17"]),
        (["header.stamp", "stamp"], ["header/stamp"]),
    ],
)
def test_select_as_configured(names: list[str], expected: list[str]) -> None:
    assert paths(configured_columns(COLUMNS, names)) == expected


def test_select_takes_every_path_that_ends_in_a_name() -> None:
    assert paths(configured_columns(COLUMNS[:-2], ["x"])) == [
        "pose/pose/position/x",
        "twist/twist/linear/x",
    ]


def test_closest_items() -> None:
    hint = suggest_names("ros_odmo", ["ros_odom", "ros_scan"])
    assert hint == "did you mean ros_odom? there are: ros_odom, ros_scan"
    assert suggest_names("zzz", ["a", "b"]) == "there are: a, b"
    assert suggest_names("zzz", []) == "nothing has been recorded yet"
