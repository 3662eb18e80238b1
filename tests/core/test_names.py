"""Names of items and columns."""

from __future__ import annotations

import hashlib
import re

from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.names import extend_names, identifier, is_reserved, item_name, unique_names

PATHS = st.lists(st.text("ab/_.A9-parent", max_size=6), unique=True, max_size=30)


def digits(path: str) -> str:
    return hashlib.sha256(path.encode()).hexdigest()[:4]


def test_item_names_follow_the_topic() -> None:
    assert item_name("ros", "/ropod/odom") == "ros_ropod_odom"
    assert item_name("zyre", "TASK") == "zyre_TASK"
    assert item_name("left arm", "/a-b/") == "left_arm_a_b"
    assert item_name("zmq", "") == "zmq"
    assert item_name("2nd", "/x") == "_2nd_x"


def test_identifier_replaces_what_a_name_cannot_hold() -> None:
    assert identifier("pose/pose/position.x") == "pose_pose_position_x"
    assert identifier("grün") == "gr_n"
    assert identifier("3d") == "_3d"
    assert identifier("") == "_"


def test_the_first_path_keeps_the_name() -> None:
    names = unique_names(["a/b", "a_b", "A/B"])
    assert names == {
        "a/b": "a_b",
        "a_b": f"a_b_{digits('a_b')}",
        "A/B": f"A_B_{digits('A/B')}",
    }


def test_reserved_names_step_aside() -> None:
    names = unique_names(["timestamp", "Seq", "header/seq", "parent/seq", "index"])
    assert names["timestamp"] == f"timestamp_{digits('timestamp')}"
    assert names["Seq"] == f"Seq_{digits('Seq')}"
    assert names["header/seq"] == "header_seq"
    assert names["parent/seq"] == f"_parent_seq_{digits('parent/seq')}"
    assert not any(is_reserved(name) for name in names.values())


def test_a_taken_hash_gets_more_digits() -> None:
    clash = f"a_b_{digits('a_b')}"
    names = unique_names(["a/b", clash, "a_b"])
    assert names["a_b"] == f"a_b_{hashlib.sha256(b'a_b').hexdigest()[:5]}"


@given(PATHS)
def test_names_are_unique_without_case_and_well_formed(paths: list[str]) -> None:
    names = unique_names(paths)
    assert list(names) == paths
    assert len({name.casefold() for name in names.values()}) == len(paths)
    assert all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) for name in names.values())
    assert not any(is_reserved(name) for name in names.values())


@given(PATHS, st.integers(0, 30))
def test_names_never_change_when_paths_are_added(paths: list[str], first: int) -> None:
    before = unique_names(paths[:first])
    after = extend_names(before, paths)
    assert {path: after[path] for path in before} == before
    assert after == unique_names(paths)
