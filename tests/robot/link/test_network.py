"""What may go over which network, and when journals are copied."""

from __future__ import annotations

import pytest

from amberbox.blackbox.folder.server import rule_problem as problem
from amberbox.robot.link.copyrule import Situation, may_copy
from amberbox.robot.link.network import Network, allowed, default_interface

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
    assert allowed(mobile, ["wwan*"]).lanes == {"urgent", "status"}
    assert allowed(mobile, ["wwan*"], statuses=False).lanes == {"urgent"}
    assert not allowed(mobile, ["wwan*"]).copies and not allowed(mobile, ["wwan*"]).live
    assert "backlog" in allowed(mobile, ["Guest"]).lanes
    assert not allowed(Network("wlan0", "Guest"), ["Guest"]).copies


@pytest.mark.parametrize(
    ("when", "situation", "copies"),
    [
        ("always", Situation(), True),
        ("docked", Situation(docked=True), True),
        ("docked", Situation(docked=False), False),
        ("docked", Situation(docked=None), False),
        ("on_request", Situation(docked=True), False),
        ("network Lab", Situation(network=Network("wlan0", "Lab")), True),
        ("network Lab", Situation(network=Network("wlan0", "Guest")), False),
    ],
)
def test_when_journals_are_copied(when: str, situation: Situation, copies: bool) -> None:
    assert not problem(when)
    assert may_copy(when, situation) is copies


@pytest.mark.parametrize("when", ["", "never", "network ", "network"])
def test_other_words_are_no_rule(when: str) -> None:
    assert when in problem(when) and problem(when)
