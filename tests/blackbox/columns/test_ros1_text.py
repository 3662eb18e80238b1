"""MD5 sums of ROS 1 definitions, and definitions that leave out standard types."""

from __future__ import annotations

import pytest

from amberbox.blackbox.columns.ros1_text import (
    md5sum,
    service_md5sum,
    standard_definition,
    standard_names,
    with_needed_types,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema


def schema(name: str, text: str) -> Schema:
    return with_needed_types(Schema(name, "ros1msg", text.encode()))


@pytest.mark.parametrize(
    ("request_text", "response_text", "expected"),
    [  # as genmsg computes them for the packages of Debian
        ("", "", "d41d8cd98f00b204e9800998ecf8427e"),
        ("", "bool success\nstring message", "937c9679a518e3a18d831e57125ea522"),
        ("bool data # on", "bool success\nstring message", "09fb03525b03e7ea1fd3992bafd87e16"),
        (
            "geometry_msgs/PoseStamped start\ngeometry_msgs/PoseStamped goal\nfloat32 tolerance",
            "Path plan",
            "421c8ea4d21c6c9db7054b4bbdf1e024",
        ),
    ],
)
def test_the_sum_of_a_service(request_text: str, response_text: str, expected: str) -> None:
    request = schema("nav_msgs/GetPlanRequest", request_text)
    assert service_md5sum(request, schema("nav_msgs/GetPlanResponse", response_text)) == expected


def test_the_sum_of_a_message_covers_numbers_as_they_are_written() -> None:
    hexadecimal, decimal = (
        schema("a/B", "uint8 X=0x10\nint8 y"),
        schema("a/B", "uint8 X=16\nint8 y"),
    )
    assert md5sum(hexadecimal) != md5sum(decimal)


def test_standard_types_are_added_once_with_all_that_they_need() -> None:
    whole = schema("my_msgs/Tour", "geometry_msgs/PoseStamped[] stops\nHeader header\nPlace home\n")
    added = [line for line in whole.data.decode().splitlines() if line.startswith("MSG: ")]
    assert sorted(added) == [
        "MSG: geometry_msgs/Point",
        "MSG: geometry_msgs/Pose",
        "MSG: geometry_msgs/PoseStamped",
        "MSG: geometry_msgs/Quaternion",
        "MSG: std_msgs/Header",
    ]
    with pytest.raises(AmberboxError, match="my_msgs/Place is missing"):
        md5sum(whole)


def test_a_type_that_is_given_is_not_replaced_by_the_standard_one() -> None:
    text = f"geometry_msgs/Point at\n{'=' * 80}\nMSG: geometry_msgs/Point\nint8 x\n"
    assert schema("a/B", text).data.decode() == text


def test_only_standard_types_are_standard() -> None:
    assert standard_definition("nav_msgs/Nothing") is None
    assert "nav_msgs/Path" in standard_names()


def test_a_definition_that_doubles_with_every_level_is_summed_once_for_each_type() -> None:
    parts = [f"MSG: a/T{n}\nT{n + 1} x\nT{n + 1} y\n" for n in range(60)] + ["MSG: a/T60\nint8 z\n"]
    text = f"T0 root\n{'=' * 80}\n" + f"{'=' * 80}\n".join(parts)
    assert len(md5sum(Schema("a/Root", "ros1msg", text.encode()))) == 32


@pytest.mark.parametrize("depth", [200, 5000])
def test_a_definition_without_end_is_refused(depth: int) -> None:
    parts = [f"MSG: a/T{n}\nT{n + 1} x\n" for n in range(depth)]
    text = f"T0 root\n{'=' * 80}\n" + f"{'=' * 80}\n".join(parts)
    with pytest.raises(AmberboxError):
        md5sum(Schema("a/Root", "ros1msg", text.encode()))
    with pytest.raises(AmberboxError):
        md5sum(Schema("a/T0", "ros1msg", f"T1 x\n{'=' * 80}\nMSG: a/T1\nT0 y\n".encode()))
