"""Results of probes of units, processes, containers and ROS."""

from __future__ import annotations

import pytest

from amberbox.core.mode import FALSE, TRUE, UNKNOWN
from amberbox.core.plugins import get
from amberbox.monitoring.modes import service as mode
from amberbox.monitoring.modes.service import Config
from amberbox.testing.modes import assert_mode_contract, at_s, one_input


def test_contract() -> None:
    assert_mode_contract(mode, "service", parts={"state": "string"})
    assert_mode_contract(mode, "service", parts={"count": "int"}, examples=20)
    assert_mode_contract(mode, "service", parts={"listens": "bool", "answers": "bool"}, examples=20)


@pytest.mark.parametrize(
    "kind",
    [
        "unit",
        "process",
        "container",
        "ros_node",
        "ros_topic",
        "ros_service",
        "ros_master",
        "ros2_node",
        "http",
    ],
)
def test_every_kind_has_a_probe(kind: str) -> None:
    probe, subject = mode.probe_of(Config(kind), "roscore")  # type: ignore[arg-type] # one of them
    assert subject == "roscore"
    assert get("amberbox.monitoring.probes", probe, defines=("measure",)).name == probe


def test_a_container_that_is_down_is_not_well() -> None:
    entry = one_input(
        "overpass", times_s=[0, 1, 2], values=[True, False, None],
        parts={"state": ["running", "exited", None]},
    )  # fmt: skip
    found = mode.evaluate(Config("container"), [entry], at_s(0, 1, 2))
    assert found["active"].tolist() == [TRUE, FALSE, UNKNOWN]
    assert found["state"].tolist() == ["running", "exited", ""]


def test_a_node_that_hangs_is_told_from_one_that_died() -> None:
    entry = one_input(
        "/laser", times_s=[0, 1, 2, 3], values=[True, False, False, None],
        parts={"listens": [True, True, False, None], "answers": [True, False, False, None]},
    )  # fmt: skip
    found = mode.evaluate(Config("ros_node"), [entry], at_s(0, 1, 2, 3))
    assert found["running"].tolist() == [TRUE, TRUE, FALSE, UNKNOWN]
    assert found["responds"].tolist() == [TRUE, FALSE, UNKNOWN, UNKNOWN]
    hangs = {"active": False, "running": True, "responds": False, "state": ""}
    assert mode.explain(Config("ros_node"), hangs) == "it is there and does not answer"


def test_explanations() -> None:
    assert mode.explain(Config(), {"active": False, "state": "failed"}) == "it is failed"
    assert mode.explain(Config(), {"active": False, "state": ""}) == "it is not there"
    assert mode.explain(Config(), {"active": None, "state": ""}) == ""
