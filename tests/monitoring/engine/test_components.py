"""Components: policies, initialisation, states, dependencies, and the chain in words."""

from __future__ import annotations

from dataclasses import replace

import pytest

from amberbox.core.expression import parse
from amberbox.core.needs import all_of, any_of, at_least
from amberbox.monitoring.component_states import in_order
from amberbox.monitoring.findings import OutputCondition
from amberbox.monitoring.plan import DependencyPlan, Expectation, Policy
from tests.monitoring.engine.stand import (
    Stand,
    component,
    mode,
    output,
    plan,
    seconds,
    statuses,
    transitions,
)

CHAIN = (component("nav", "loc"), component("loc", "laser"), component("laser"))


def judged_by(name: str, of_mode: str, of_output: str = "") -> DependencyPlan:
    return DependencyPlan(name, "functional", name, of_mode, of_output)


def test_nothing_is_initialised_before_it_was_measured() -> None:
    stand = Stand(*CHAIN)
    assert stand.now("laser") == ("unknown", "not_initialised")
    assert stand.status("laser").reason == "not measured yet"
    stand.ok(1, "laser", "loc", "nav")
    stand.until(1)
    assert [stand.now(name) for name in ("nav", "loc", "laser")] == [("ok", "nominal")] * 3


def test_what_is_waited_for_is_said_along_the_chain() -> None:
    stand = Stand(*CHAIN)
    stand.bad(1, "laser", why="/dev/front_laser is not there")
    stand.ok(1, "loc", "nav")
    stand.until(1)
    laser = "working is false, expected true: /dev/front_laser is not there"
    assert stand.now("laser") == ("error", "not_initialised")
    assert stand.status("laser").reason == laser
    assert stand.now("nav") == ("unknown", "not_initialised")
    assert stand.status("nav").reason == (
        f"waits for loc (not initialised), which waits for laser: {laser}"
    )
    assert stand.status("nav").blocked_by == ("loc",)
    assert stand.status("loc/device").blocked_by == ("laser",)


def test_a_long_chain_is_cut_but_its_end_is_named() -> None:
    names = [f"c{n}" for n in range(9)]
    stand = Stand(*(component(n, *names[k + 1 : k + 2]) for k, n in enumerate(names)))
    stand.ok(1, *names[:8])
    stand.bad(1, "c8")
    stand.until(1)
    reason = stand.status("c0").reason
    assert reason.endswith("which in the end waits for c8: working is false, expected true")
    assert reason.count("waits for") == 2
    reason = stand.status("c5").reason
    assert reason.count("waits for") == 3


def test_once_initialised_it_has_faults() -> None:
    stand = Stand(*CHAIN)
    stand.ok(1, "laser", "loc", "nav")
    stand.bad(2, "laser")
    stand.until(2)
    assert stand.now("laser") == ("error", "working")
    assert stand.now("nav") == ("ok", "nominal")
    assert stand.status("nav").blocked_by == ("laser",)  # loc is well itself
    stand.bad(3, "loc")
    stand.until(3)
    assert stand.status("nav").blocked_by == ("loc",)
    assert stand.status("loc").blocked_by == ("laser",)
    assert stand.status("loc").reason == "working is false, expected true"


def test_a_component_that_recovers_is_no_longer_in_the_way() -> None:
    stand = Stand(*CHAIN)
    stand.ok(1, "laser", "loc", "nav")
    stand.stale(2, "laser")
    stand.ok(3, "laser")
    found = stand.until(4)
    assert [(seconds(t.at_ns), t.component, t.mode, t.text) for t in transitions(found)[-4:]] == [
        (2, "laser", "device", "laser/device: nominal -> stale: nothing received of scan for 5 s"),
        (2, "laser", "", "laser: nominal -> stale: nothing received of scan for 5 s"),
        (3, "laser", "device", "laser/device: stale -> nominal"),
        (3, "laser", "", "laser: stale -> nominal"),
    ]
    assert stand.status("nav").blocked_by == ()


def test_two_roots_are_both_named() -> None:
    stand = Stand(component("nav", "laser", "odom"), component("laser"), component("odom"))
    stand.ok(1, "nav")
    stand.bad(1, "laser")
    stand.stale(1, "odom")
    stand.until(1)
    assert stand.status("nav").blocked_by == ("laser", "odom")
    assert stand.status("nav").reason == (
        "waits for laser: working is false, expected true, "
        "and for odom: nothing received of scan for 5 s"
    )
    stand.ok(2, "laser")
    stand.until(2)
    assert stand.status("nav").blocked_by == ("odom",)


def test_a_diamond_names_what_is_below_once() -> None:
    stand = Stand(
        component("top", "left", "right"),
        component("left", "base"),
        component("right", "base"),
        component("base"),
    )
    stand.ok(1, "top", "left", "right", "base")
    stand.bad(2, "base")
    stand.until(2)
    assert stand.status("top").blocked_by == ("base",)


def test_many_dependencies_are_counted() -> None:
    names = [f"c{n}" for n in range(6)]
    stand = Stand(component("top", *names), *(component(name) for name in names))
    stand.ok(1, "top")
    stand.until(1)
    reason = stand.status("top").reason
    assert reason.endswith("and for c2: not measured yet, and 3 more")
    assert stand.status("top").blocked_by == tuple(names)


def test_what_has_no_monitor_lets_through_what_is_below() -> None:
    stand = Stand(component("nav", "bus"), component("bus", "power", modes=[]), component("power"))
    assert stand.now("bus") == ("unknown", "not_monitored")
    stand.ok(1, "nav", "power")
    stand.until(1)
    assert stand.now("nav") == ("ok", "nominal")
    assert stand.status("bus").reason == "no monitor"
    stand.bad(2, "power")
    stand.until(2)
    assert stand.status("nav").blocked_by == ("power",)
    assert stand.status("bus").blocked_by == ("power",)
    assert stand.now("bus") == ("unknown", "not_monitored")


@pytest.mark.parametrize(
    "edge",
    [
        DependencyPlan("roscore", "heartbeat", component="roscore", judged=False),
        DependencyPlan("roscore", component=None, problem="nothing is called roscore"),
        DependencyPlan("roscore"),
        DependencyPlan("roscore", component="roscore", mode="missing"),
    ],
)
def test_a_dependency_that_nothing_judges_blocks_nothing_and_is_mentioned(
    edge: DependencyPlan,
) -> None:
    stand = Stand(component("laser", edge), component("roscore"))
    stand.ok(1, "laser")
    stand.until(1)
    assert stand.now("laser") == ("ok", "nominal")
    assert stand.status("laser").reason == "dependency roscore is not monitored"
    assert stand.status("laser").blocked_by == ()


def test_what_one_of_two_monitors_judges_is_monitored() -> None:
    open_edge = DependencyPlan("base", "heartbeat", component="base", judged=False)
    stand = Stand(component("laser", open_edge, judged_by("base", "device")), component("base"))
    stand.ok(1, "laser", "base")
    stand.until(1)
    assert stand.status("laser").reason == ""


def test_an_edge_may_be_judged_by_a_mode_or_by_one_output() -> None:
    stand = Stand(
        component("by_mode", judged_by("base", "alive")),
        component("by_output", judged_by("base", "device", "left")),
        component("base", modes=[mode("alive"), mode("device", output("left"), output("right"))]),
    )
    stand.ok(1, "by_mode", "by_output", "base/alive", "base/device/left", "base/device/right")
    stand.bad(2, "base/device/right")
    stand.until(2)
    assert stand.status("by_mode").blocked_by == ()
    assert stand.status("by_output").blocked_by == ()
    stand.bad(3, "base/device/left")
    stand.bad(4, "base/alive")
    stand.until(4)
    assert stand.status("by_mode").blocked_by == ("base/alive",)
    assert stand.status("by_output").blocked_by == ("base/device",)


def test_an_edge_by_output_follows_also_where_its_mode_says_the_same() -> None:
    stand = Stand(
        component("user", judged_by("base", "device", "left")),
        component("base", modes=[mode("device", output("left"), output("right"))]),
    )
    stand.ok(1, "user", "base/device/left", "base/device/right")
    stand.bad(2, "base/device/right")
    stand.find(3, "base/device/left", "unknown", None, "no value")
    stand.until(3)
    assert stand.status("user").blocked_by == ("base/device",)


def test_a_warning_is_good_enough_for_others() -> None:
    low = mode("device", output(severity="warning"))
    stand = Stand(component("nav", "battery"), component("battery", modes=[low]))
    stand.bad(1, "battery")
    stand.ok(1, "nav")
    stand.until(1)
    assert stand.now("battery") == ("warn", "working")
    assert stand.status("nav").blocked_by == ()


@pytest.mark.parametrize(
    ("policy", "found", "expected"),
    [
        ("all", "ok ok bad", "error"),
        ("all", "ok ok unknown", "unknown"),
        ("all", "ok stale bad", "error"),
        ("any", "bad stale ok", "ok"),
        ("any", "bad stale unknown", "error"),
        ("any", "stale unknown unknown", "stale"),
        ("majority", "ok ok bad", "ok"),
        ("majority", "ok bad bad", "error"),
        ("majority", "ok stale unknown", "stale"),
    ],
)
def test_modes_are_combined_by_policy(policy: Policy, found: str, expected: str) -> None:
    modes = [mode(f"m{n}") for n in range(3)]
    stand = Stand(component("x", modes=modes, policy=policy))
    stand.ok(1, "x/m0", "x/m1", "x/m2")
    for number, word in enumerate(found.split()):
        what: OutputCondition = "ok" if word == "ok" else "bad" if word == "bad" else "stale"
        what = "unknown" if word == "unknown" else what
        stand.find(2, f"x/m{number}", what, word == "ok", "" if what in ("ok", "bad") else word)
    stand.until(2)
    assert stand.status("x").level == expected


def test_lost_redundancy_is_said_where_the_component_is_ok() -> None:
    stand = Stand(component("x", modes=[mode("a"), mode("b"), mode("c")], policy="majority"))
    stand.ok(1, "x/a", "x/b", "x/c")
    stand.stale(2, "x/c")
    stand.until(2)
    assert stand.now("x") == ("ok", "nominal")
    assert stand.status("x").reason == "2 of 3 modes are ok: nothing received of scan for 5 s"


def test_half_is_no_majority() -> None:
    stand = Stand(component("x", modes=[mode("a"), mode("b")], policy="majority"))
    stand.ok(1, "x/a")
    stand.bad(1, "x/b")
    stand.until(1)
    assert stand.status("x").level == "error"


def test_half_of_the_modes_with_warnings_is_a_warning() -> None:
    warning = mode("b", output(severity="warning"))
    stand = Stand(component("x", modes=[mode("a"), warning, mode("c")], policy="majority"))
    stand.ok(1, "x/a")
    stand.bad(1, "x/b", "x/c")
    stand.until(1)
    assert stand.now("x") == ("warn", "working")


def test_a_fault_state_is_named_by_its_condition() -> None:
    charge = output("charge", type="float", expectation=Expectation(20, ">="))
    states = {"empty": parse("charge < 5"), "low": parse("charge < 20 and not charging")}
    battery = mode("battery", charge, output("charging"), states=states)
    stand = Stand(component("battery", modes=[battery]))
    stand.find(1, "battery/battery/charge", "ok", 50.0)
    stand.ok(1, "battery/battery/charging")
    stand.find(2, "battery/battery/charge", "bad", 15.0)
    stand.until(2)
    assert stand.now("battery") == ("error", "charge")
    stand.find(2.5, "battery/battery/charging", "ok", False)
    stand.find(3.4, "battery/battery/charge", "bad", 4.0)  # a number alone: at the next second
    found = stand.until(5)
    assert [(seconds(t.at_ns), t.after.state) for t in transitions(found) if not t.mode] == [
        (2.5, "low"), (4, "empty"),
    ]  # fmt: skip
    stand.find(6, "battery/battery/charge", "stale", None, "silent")
    stand.until(6)
    assert stand.now("battery") == ("stale", "stale")


def test_several_outputs_share_a_reason() -> None:
    outputs = output("left"), output("right"), output("speed")
    stand = Stand(component("x", modes=[mode("m", *outputs)]))
    stand.bad(1, "x/m/left", "x/m/right", why="no power")
    stand.bad(1, "x/m/speed")
    stand.until(1)
    assert stand.status("x/m").reason == (
        "left is false, expected true; right is false, expected true: no power; "
        "speed is false, expected true"
    )
    assert stand.now("x/m") == ("error", "left")


def test_a_mode_that_cannot_run_is_always_unknown() -> None:
    broken = mode("device", problem="there is no monitor 'lasr'")
    stand = Stand(component("nav", "laser"), component("laser", modes=[broken]))
    stand.ok(1, "laser", "nav")
    stand.until(2)
    assert stand.now("laser/device") == ("unknown", "unknown")
    assert stand.status("laser/device").reason == "there is no monitor 'lasr'"
    assert stand.status("laser/device").outputs == {"working": None}
    assert stand.status("nav").reason == "waits for laser: there is no monitor 'lasr'"


def test_dependencies_come_first_and_cycles_end() -> None:
    assert in_order(plan(*CHAIN)) == [2, 1, 0]
    circle = component("a", "b"), component("b", "c"), component("c", "a"), component("d", "d")
    order = in_order(plan(*circle))
    assert sorted(order) == [0, 1, 2, 3]
    stand = Stand(*circle)
    stand.ok(1, "a", "b", "c", "d")
    stand.until(2)
    assert {status.level for status in statuses(stand.findings[-8:])} == {"ok"}


EITHER = component("see", "front", "rear", needs=any_of("front", "rear"))
LASERS = (EITHER, component("front"), component("rear"))


def test_one_of_two_is_enough() -> None:
    stand = Stand(*LASERS)
    stand.ok(1, "see", "front")
    stand.until(1)  # nothing is known of rear
    assert stand.now("see") == ("ok", "nominal")
    stand.ok(2, "rear")
    stand.bad(3, "front")
    stand.until(3)
    assert (stand.now("see"), stand.status("see").blocked_by) == (("ok", "nominal"), ())
    stand.bad(4, "rear")
    stand.until(4)
    assert stand.status("see").blocked_by == ("front", "rear")
    stand.ok(5, "front")
    stand.until(5)
    assert stand.status("see").blocked_by == ()


def test_without_either_it_is_not_initialised_and_waits_for_both() -> None:
    stand = Stand(*LASERS)
    stand.ok(1, "see")
    stand.bad(1, "front", why="no answer")
    stand.until(1)
    assert stand.now("see") == ("unknown", "not_initialised")
    assert stand.status("see").reason == (
        "waits for front: working is false, expected true: no answer, "
        "and for rear: not measured yet"
    )
    stand.ok(2, "rear")
    stand.until(2)
    assert stand.now("see") == ("ok", "nominal")


def test_an_alarm_is_of_what_one_can_do_without_too_and_not_of_who_does() -> None:
    stand = Stand(*LASERS)
    stand.ok(1, "see", "front", "rear")
    stand.bad(2, "front")
    stand.until(3)
    stand.bad(4, "see")  # front does not excuse it
    stand.until(5)
    assert [alarm.component for alarm in stand.states.alarms()] == ["front", "see"]


def test_needs_may_be_nested() -> None:
    needs = all_of("bus", at_least(2, "a", "b", any_of("c", all_of("d", "e"))))
    names = ("bus", "a", "b", "c", "d", "e")
    stand = Stand(component("top", *names, needs=needs), *(component(name) for name in names))
    stand.ok(1, "top", *names)
    stand.bad(2, "a", "c")
    stand.until(2)
    assert stand.status("top").blocked_by == ()
    stand.bad(3, "e")
    stand.until(3)
    assert stand.status("top").blocked_by == ("a", "c", "e")  # b and d are not in the way
    stand.bad(4, "bus")
    stand.ok(4, "a")
    stand.until(4)
    assert stand.status("top").blocked_by == ("bus",)


def test_what_one_can_do_without_may_be_judged_by_modes_outputs_and_nobody() -> None:
    two = mode("m", output("left"), output("right"))
    edges = (
        judged_by("laser", "m", "left"),
        DependencyPlan("laser", "heartbeat", "bus"),  # both of them must be right
        judged_by("camera", "eye"),
    )
    top = component("top", *edges, needs=any_of("laser", "camera"))
    parts = (
        component("laser", modes=[two]),
        component("bus"),
        component("camera", modes=[mode("eye")]),
    )
    stand = Stand(top, *parts)
    stand.ok(1, "top", "laser/m/left", "laser/m/right", "bus", "camera")
    stand.bad(2, "laser/m/right", "camera")
    stand.until(2)
    assert stand.status("top").blocked_by == ()
    stand.bad(3, "bus")
    stand.until(3)
    assert stand.status("top").blocked_by == ("bus", "camera/eye")
    stand.ok(4, "bus")
    stand.bad(4, "laser/m/left")
    stand.until(4)
    assert stand.status("top").blocked_by == ("laser/m", "camera/eye")
    free = replace(edges[2], judged=False)
    stand = Stand(component("top", *edges[:2], free, needs=any_of("laser", "camera")), *parts)
    stand.ok(1, "top")
    stand.bad(1, "bus")
    stand.until(1)
    assert stand.status("top").blocked_by == ()  # nobody says that the camera does not work
    assert stand.status("top").reason == "dependency camera is not monitored"


def test_of_what_has_no_monitor_what_it_needs_counts_with_any_too() -> None:
    through = component("bus", "power", "battery", needs=any_of("power", "battery"), modes=[])
    stand = Stand(component("nav", "bus"), through, component("power"), component("battery"))
    stand.ok(1, "nav", "power")
    stand.until(1)
    assert stand.now("nav") == ("ok", "nominal")
    stand.bad(2, "power", "battery")
    stand.until(2)
    assert stand.status("nav").blocked_by == ("power", "battery")
