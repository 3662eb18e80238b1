"""What may go over which network, and when journals are copied."""

from __future__ import annotations

import pytest

from amberbox.blackbox.robot_folder.robot_yaml import rule_problem as problem
from amberbox.link.policy import (
    CopySituation,
    Network,
    allowed_traffic,
    default_interface,
    may_copy,
)

ROUTES = """Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
wwan0\t00000000\t0102A8C0\t0003\t0\t0\t700\t00000000\t0\t0\t0
wlan0\t00000000\t0102A8C0\t0003\t0\t0\t600\t00000000\t0\t0\t0
wlan0\t0002A8C0\t00000000\t0001\t0\t0\t600\t00FFFFFF\t0\t0\t0
"""


def test_the_default_route_with_the_least_metric_counts() -> None:
    assert default_interface(ROUTES) == "wlan0"
    assert default_interface(ROUTES.splitlines()[0]) == ""


def test_what_costs_money_carries_what_cannot_wait() -> None:
    mobile = Network("wwan0")
    assert allowed_traffic(mobile, ["wwan*"]).lanes == {"urgent", "command", "status"}
    assert allowed_traffic(mobile, ["wwan*"], statuses=False).lanes == {"urgent", "command"}
    assert (
        not allowed_traffic(mobile, ["wwan*"]).copies
        and not allowed_traffic(mobile, ["wwan*"]).live
    )
    assert "backlog" in allowed_traffic(mobile, ["Guest"]).lanes
    assert not allowed_traffic(Network("wlan0", "Guest"), ["Guest"]).copies


@pytest.mark.parametrize(
    ("when", "situation", "copies"),
    [
        ("always", CopySituation(), True),
        ("docked", CopySituation(docked=True), True),
        ("docked", CopySituation(docked=False), False),
        ("docked", CopySituation(docked=None), False),
        ("on_request", CopySituation(docked=True), False),
        ("network Lab", CopySituation(network=Network("wlan0", "Lab")), True),
        ("network Lab", CopySituation(network=Network("wlan0", "Guest")), False),
    ],
)
def test_when_journals_are_copied(when: str, situation: CopySituation, copies: bool) -> None:
    assert not problem(when)
    assert may_copy(when, situation) is copies


@pytest.mark.parametrize("when", ["", "never", "network ", "network"])
def test_other_words_are_no_rule(when: str) -> None:
    assert when in problem(when) and problem(when)
