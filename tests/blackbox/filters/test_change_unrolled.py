"""The change filter on real message types as the unroller lays them out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.filters.change import ChangeFilter
from amberbox.core.source import ChangeOptions
from amberbox.core.types import Schema, Topic

STORE = get_typestore(Stores.ROS1_NOETIC)
TYPES = STORE.types


def header(seq: int) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=seq, nanosec=0)
    return TYPES["std_msgs/msg/Header"](seq=seq, stamp=stamp, frame_id="base")


def diagnostics(seq: int, *states: tuple[str, int, dict[str, str]]) -> Any:
    status, pair = TYPES["diagnostic_msgs/msg/DiagnosticStatus"], "diagnostic_msgs/msg/KeyValue"
    return TYPES["diagnostic_msgs/msg/DiagnosticArray"](
        header=header(seq),
        status=[
            status(
                level=level,
                name=name,
                message="",
                hardware_id="",
                values=[TYPES[pair](key=key, value=value) for key, value in values.items()],
            )
            for name, level, values in states
        ],
    )


def path(seq: int, x: float) -> Any:
    quaternion = TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    point = TYPES["geometry_msgs/msg/Point"](x=x, y=0.0, z=0.0)
    pose = TYPES["geometry_msgs/msg/Pose"](position=point, orientation=quaternion)
    stamped = TYPES["geometry_msgs/msg/PoseStamped"](header=header(seq), pose=pose)
    return TYPES["nav_msgs/msg/Path"](header=header(seq), poses=[stamped])


def kept(messages: list[Any], options: ChangeOptions) -> list[bool]:
    kind = messages[0].__msgtype__
    definition, _ = STORE.generate_msgdef(kind)
    schema = Schema(kind.replace("/msg/", "/"), "ros1msg", definition.encode())
    unroll = unroller(Topic("/topic", "ros1", schema))
    change = ChangeFilter(options, unroll.schema)
    assert change.unused == ()
    answer: list[bool] = []
    for begin in range(0, len(messages), 2):
        data = [bytes(STORE.serialize_ros1(m, kind)) for m in messages[begin : begin + 2]]
        answer += change.mask(unroll.rows(data), np.arange(begin, begin + len(data))).tolist()
    return answer


def test_diagnostics_are_kept_when_any_value_in_them_changes() -> None:
    stream = [
        diagnostics(1, ("motor", 0, {"t": "20"})),
        diagnostics(2, ("motor", 0, {"t": "20"})),
        diagnostics(3, ("motor", 0, {"t": "21"})),
        diagnostics(4, ("motor", 0, {"t": "21", "u": "24"})),
        diagnostics(5, ("motor", 0, {"t": "21", "u": "24"}), ("disk", 0, {})),
        diagnostics(6, ("motor", 0, {"t": "21", "u": "24"}), ("disk", 0, {})),
        diagnostics(7, ("motor", 2, {"t": "21", "u": "24"}), ("disk", 0, {})),
        diagnostics(8, ("motor", 2, {"t": "21", "u": "24"}), ("disk", 0, {})),
    ]
    assert kept(stream, ChangeOptions()) == [True, False, True, True, True, False, True, False]
    levels = ChangeOptions(variables=("status/level",))
    assert kept(stream, levels) == [True, False, False, False, True, False, True, False]


@pytest.mark.parametrize(
    "options",
    [
        ChangeOptions(absolute=0.25),
        ChangeOptions(variables=("position",), absolute=0.25),
        ChangeOptions(bands={"poses/pose/position/x": 0.25}),
    ],
)
def test_paths_are_kept_when_they_move_although_all_their_headers_count_up(
    options: ChangeOptions,
) -> None:
    stream = [path(seq, x) for seq, x in enumerate([0.0, 0.25, 0.5, 0.5, 0.125, 0.0])]
    assert kept(stream, options) == [True, False, True, False, True, False]
