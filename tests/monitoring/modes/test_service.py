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


@pytest.mark.parametrize(
    "kind", ["unit", "process", "container", "ros_node", "ros_topic", "ros_master", "http"]
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


def test_explanations() -> None:
    assert mode.explain(Config(), {"active": False, "state": "failed"}) == "it is failed"
    assert mode.explain(Config(), {"active": False, "state": ""}) == "it is not there"
    assert mode.explain(Config(), {"active": None, "state": ""}) == ""
