"""Coverage: undetected failure modes, unexplained symptoms, indistinguishable failure modes."""

from __future__ import annotations

import pytest

from amberbox.diagnosis.fmea.criticality import coverage
from amberbox.diagnosis.fmea.model import DependencyStructure, links_by_mode, lost
from tests.diagnosis.fmea.small import ADDRESSES, small


def test_modes_with_the_same_symptoms_are_alike_and_tests_tell_them_apart() -> None:
    groups = {group.modes: group for group in coverage(small()).ambiguous}
    group = groups["laser_front#dirty", "laser_front#wet"]
    assert group.symptoms == ("laser_front/window/clear",)
    assert group.tests == ("laser_front.look",) and group.left == ()


def test_what_no_test_tells_apart_is_said() -> None:
    fmea = small("tests: {look: {outcome: wet, detects: 0.8}}", "tests: {look: dirty}")
    group = next(g for g in coverage(fmea).ambiguous if g.modes[0] == "laser_front#dirty")
    assert group.tests == () and group.left == (group.modes,)


def test_a_loss_shows_through_functions() -> None:
    fmea = small()
    assert [link.symptom for link in links_by_mode(fmea)["hook#bent"]] == [
        "tasks/log/none_given_up"
    ]
    assert [link.symptom for link in links_by_mode(fmea)["laser_front#dead"]] == [
        "laser_front/heartbeat/alive"
    ]
    found = coverage(fmea)
    assert found.weak["hook#bent"] == pytest.approx(0.4)
    assert not found.unseen and found.modes == 10


def test_what_nobody_sees_and_what_nothing_explains() -> None:
    fmea = small("    symptoms: [{symptom: tasks/log/none_given_up, detects: 0.4}]\n", "")
    found = coverage(fmea, (*ADDRESSES, "arm/motor/turns"))
    assert found.unseen == {"hook#bent": "it has no sensor"}
    assert found.unexplained == ("tasks/log/none_given_up", "arm/motor/turns")


def test_signatures_are_counted() -> None:
    found = coverage(small())
    assert found.distinct == 10 - 2  # each laser has one pair that looks the same


def test_what_is_lost() -> None:
    fmea = small()
    assert lost(fmea, ["laser_front#dead"]) == {"laser_front"}
    assert lost(fmea, ["laser_front#dead", "laser_rear#dead"]) == {
        "laser_front", "laser_rear", "see", "carry",
    }  # fmt: skip
    assert lost(fmea, ["laser_front#dirty", "laser_rear#dirty"]) == frozenset()
    assert lost(fmea, ["host#off"]) == {
        "host", "laser_front", "laser_rear", "hook", "see", "carry",
    }  # fmt: skip
    assert DependencyStructure.of(fmea.needs()).dependents(["hook"]) == {"carry"}
