"""Short names: a whole id, its title, or its last words, as long as they mean one thing."""

from __future__ import annotations

import pytest

from amberbox.core.errors import UsageError
from amberbox.core.names import component_id, full_id, ids_ending_in

KNOWN = {
    "laser_front": "Front laser", "laser_rear": "Rear laser", "wheel_front_left": "Wheel 1",
    "robot.base-controller": "Base", "imu": "IMU",
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("laser_front", "laser_front"), ("front", "laser_front"), ("Front", "laser_front"),
        ("front laser", "laser_front"), ("left", "wheel_front_left"),
        ("front_left", "wheel_front_left"), ("controller", "robot.base-controller"),
        ("base", "robot.base-controller"), ("IMU", "imu"),
    ],
)  # fmt: skip
def test_a_component_goes_by_its_last_words_or_its_title(name: str, meant: str) -> None:
    assert component_id(name, KNOWN, KNOWN) == meant


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("laser", "no component 'laser'"), ("rea", "no component 'rea'"), ("", "no component"),
        ("_", "no component '_'"), ("laser_frnt", "did you mean 'laser_front'"),
    ],
)  # fmt: skip
def test_what_is_no_name_is_refused_with_those_that_are(name: str, what: str) -> None:
    with pytest.raises(UsageError) as caught:
        component_id(name, KNOWN, KNOWN)
    assert what in caught.value.what and "known: laser_front, laser_rear" in caught.value.hint


def test_what_means_several_names_them() -> None:
    lasers = ["a_laser", "b_laser", "laser_c"]
    assert ids_ending_in("laser", lasers) == ["a_laser", "b_laser"]
    with pytest.raises(UsageError, match="'laser' is the end of 2 components") as caught:
        component_id("laser", lasers)
    assert caught.value.hint == "name one of a_laser, b_laser"
    assert component_id("laser", [*lasers, "laser"]) == "laser", "a whole id is never in doubt"


def test_ids_of_parts_go_by_the_end_of_their_path() -> None:
    assert (
        full_id("stuck", ["fan/motor#stuck", "fan/motor#unstuck"], "symptom") == "fan/motor#stuck"
    )
