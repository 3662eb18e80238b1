"""Symptoms of outputs: emitted when they change, and when they become blocked."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.mode import Result
from amberbox.core.types import Symptom
from amberbox.monitoring.findings import TICK_NS, Finding, OutputChange
from amberbox.monitoring.plan import (
    ComponentPlan,
    Expectation,
    InputPlan,
    MappingPlan,
    ModePlan,
    OutputPlan,
)
from amberbox.monitoring.states import RobotStates, SymptomEmitter, outputs_of
from tests.monitoring.engine.stand import (
    T0_NS,
    Stand,
    Values,
    at_ns,
    component,
    mode,
    output,
    plan,
    seconds,
    symptoms,
)

ID = "laser/device/working"


def expected(name: str = "working", **more: Any) -> OutputPlan:
    return output(name, expectation=Expectation(True), **more)


def laser(*needs: str, name: str = "laser", **more: Any) -> ComponentPlan:
    return component(name, *needs, modes=[mode("device", expected(**more))])


def told(findings: Iterable[Finding]) -> list[tuple[float, str, str, tuple[str, ...]]]:
    """Return time, output, state and blockers of the symptoms."""
    return [
        (seconds(s.confirmed_ns or 0), s.id.removesuffix("/device/working"), s.state, s.blocked_by)
        for s in symptoms(findings)
    ]


def test_what_is_known_first_is_told_and_then_what_changes() -> None:
    stand = Stand(laser())
    assert told(stand.until(1)) == []
    stand.ok(1.5, "laser")
    stand.bad(3.2, "laser", why="gone")
    stand.find(4, "laser", "bad", False, "still gone")
    stand.stale(5, "laser")
    stand.find(6, "laser", "unknown", None, "not in the message")
    stand.ok(7, "laser")
    assert told(stand.until(9)) == [
        (1.5, "laser", "absent", ()),
        (3.2, "laser", "present", ()),
        (5, "laser", "unknown", ()),
        (7, "laser", "absent", ()),
    ]


def test_an_output_whose_input_is_not_there_says_nothing() -> None:
    assert told(Stand(laser(place=0)).until(1)) == []


def test_an_output_that_was_never_known_says_nothing() -> None:
    stand = Stand(laser("bus"), laser(name="bus"))
    stand.find(0.5, "laser", "unknown", None, "not in the message")
    stand.stale(1, "laser")
    stand.bad(2, "bus")  # it is blocked now
    assert told(stand.until(3)) == [(2, "bus", "present", ())]


def test_a_robot_that_starts_says_each_thing_once() -> None:
    stand = Stand(
        laser("bus", name="scan"), laser("bus"), laser("host", name="bus"), laser(name="host")
    )
    stand.ok(0.1, "scan", "laser")
    stand.ok(0.5, "bus")
    stand.ok(0.7, "host")
    assert sorted(told(stand.until(1))) == [
        (0.7, n, "absent", ()) for n in ("bus", "host", "laser", "scan")
    ]
    stand.begin(2)
    stand.ok(2.1, "scan", "laser", "bus")
    stand.until(2.5)
    _leave_and_go_on(stand)
    stand.bad(3, "scan")
    stand.ok(4, "scan", "host")
    assert told(stand.until(5)) == [
        (3, "scan", "present", ("bus",)),  # speaks for a fault, blocked or not
        *((4, name, "absent", ()) for name in ("scan", "laser", "bus", "host")),
    ]


def test_an_output_of_which_nothing_is_expected_says_nothing() -> None:
    free = output("speed", type="float")
    stand = Stand(component("laser", modes=[mode("device", free, expected())]))
    stand.find(0.5, "laser/device/speed", "ok", 1.0)
    stand.ok(0.5, "laser/device/working")
    assert [s.id for s in symptoms(stand.until(1))] == [ID]


def test_an_output_of_a_mode_that_cannot_run_says_nothing() -> None:
    modes = [mode("device", expected(), problem="no monitor 'device'")]
    stand = Stand(component("laser", "bus", modes=modes), laser(name="bus"))
    stand.bad(1, "bus")
    assert told(stand.until(2)) == [(1, "bus", "present", ())]


def test_a_symptom_says_when_it_began_and_from_what_it_is_known() -> None:
    inputs = [
        InputPlan("/scan", "variable", "ros_scan", "ranges", 17),
        InputPlan("/odom", "list", "ros_odom", "speeds"),
        InputPlan("/dev/laser", "probe", "probe_path_exists"),
    ]
    reads = [inputs[1], InputPlan("amps", "variable", "sim_battery", "current")]
    mapping = MappingPlan(inputs, [expected(for_s=2.0)], reads)
    stand = Stand(
        component("laser", modes=[ModePlan("device", "device", None, mappings=[mapping])])
    )
    stand.ok(0.5, "laser")
    stand.bad(1, "laser")
    stand.ok(2, "laser")  # before it counted
    stand.bad(3, "laser")
    (first, present) = symptoms(stand.until(6))
    assert (first.state, first.onset_ns, first.evidence) == ("absent", None, ())
    assert present == Symptom(
        ID, "present", ID, at_ns(3), at_ns(5), 1.0, "monitor",
        tuple((name, at_ns(3), at_ns(5)) for name in (
            "ros_scan.ranges[17]", "ros_odom.speeds", "probe_path_exists", "sim_battery.current",
        )),
    )  # fmt: skip


def test_an_output_about_one_input_names_that_one() -> None:
    inputs = [InputPlan(n, "variable", "sim_wheels", n) for n in ("left", "right")]
    outputs = [expected("left_ok", place=0), expected("right_ok", place=1), expected("both")]
    modes = [ModePlan("device", "device", None, mappings=[MappingPlan(inputs, outputs)])]
    stand = Stand(component("drive", modes=modes))
    stand.bad(1, "drive/device/left_ok", "drive/device/right_ok", "drive/device/both")
    names = [[name for name, _, _ in s.evidence] for s in symptoms(stand.until(2))]
    left, right = "sim_wheels.left", "sim_wheels.right"
    assert names == [[left], [right], [left, right]]


def test_what_comes_back_while_it_heals_has_begun_when_it_first_did() -> None:
    stand = Stand(laser(heal_s=2.0))
    stand.ok(0.5, "laser")
    stand.bad(1, "laser")
    stand.ok(2, "laser")
    stand.bad(3, "laser")
    stand.ok(5, "laser")
    stand.bad(9, "laser")
    found = symptoms(stand.until(10))
    assert [(s.state, s.onset_ns) for s in found] == [
        ("absent", None), ("present", at_ns(1)), ("absent", None), ("present", at_ns(9)),
    ]  # fmt: skip


def test_what_flaps_is_there_all_the_time() -> None:
    stand = Stand(laser(flaps=2, flap_s=3.0))
    stand.ok(0.5, "laser")
    for second in (1, 2, 3, 4):
        (stand.bad if second % 2 else stand.ok)(second, "laser")
    assert told(stand.until(20)) == [
        (0.5, "laser", "absent", ()),
        (1, "laser", "present", ()),
        (2, "laser", "absent", ()),
        (3, "laser", "present", ()),  # the third change: it stays so at 4
        (7, "laser", "absent", ()),
    ]


def test_what_is_blocked_and_no_more_is_told_of_all_outputs_of_a_component() -> None:
    two = component("laser", "bus", modes=[mode("device", expected(), expected("second"))])
    stand = Stand(two, laser(name="bus"))
    stand.ok(0.5, "laser/device/working", "bus")
    stand.bad(0.5, "laser/device/second")
    stand.until(1)
    stand.bad(1, "bus")
    stand.ok(3, "bus")
    found = symptoms(stand.until(4))
    assert [(seconds(s.confirmed_ns or 0), s.id, s.state, s.blocked_by) for s in found] == [
        (1, ID, "absent", ("bus",)),
        (1, "laser/device/second", "present", ("bus",)),
        (1, "bus/device/working", "present", ()),
        (3, ID, "absent", ()),
        (3, "laser/device/second", "present", ()),
        (3, "bus/device/working", "absent", ()),
    ]
    assert [s.onset_ns for s in found if s.id.endswith("second")] == [at_ns(0.5)] * 2
    assert found[4].evidence == ()  # it has no inputs here


def test_all_that_was_known_is_unknown_when_an_epoch_begins() -> None:
    stand = Stand(laser(), laser(name="bus"), laser(name="never"))
    stand.ok(0.5, "laser")
    stand.bad(0.5, "bus")
    stand.until(2)
    assert told(stand.begin(3)) == [(3, "laser", "unknown", ()), (3, "bus", "unknown", ())]
    assert told(stand.begin(4)) == []
    stand.ok(4.5, "laser")
    assert told(stand.until(5)) == [(4.5, "laser", "absent", ())]


def test_an_output_that_was_known_before_it_was_left_goes_on_being_told() -> None:
    stand = Stand(laser("bus"), laser(name="bus"))
    stand.ok(0.5, "laser", "bus")
    stand.stale(1, "laser")
    stand.until(2)
    held = json.loads(json.dumps(stand.states.snapshot()))
    stand.states = RobotStates(stand.plan)
    assert stand.states.resume(held)
    stand.bad(3, "bus")
    assert told(stand.until(4)) == [
        (3, "laser", "unknown", ("bus",)), (3, "bus", "present", ()),
    ]  # fmt: skip


def test_when_it_began_is_known_after_resume() -> None:
    stand = Stand(laser("bus", for_s=5.0), laser(name="bus"))
    stand.ok(0.5, "laser", "bus")
    stand.bad(1, "laser")
    stand.until(3)  # not confirmed yet
    _leave_and_go_on(stand)
    stand.until(8)
    _leave_and_go_on(stand)
    stand.bad(9, "bus")
    onsets = [(s.id, s.onset_ns) for s in symptoms(stand.until(10))]
    assert onsets == [(ID, at_ns(1)), ("bus/device/working", at_ns(9))]


def _leave_and_go_on(stand: Stand) -> None:
    held = json.loads(json.dumps(stand.states.snapshot()))
    stand.states = RobotStates(stand.plan)
    assert stand.states.resume(held)


def test_a_snapshot_from_before_there_were_symptoms_is_taken() -> None:
    stand = Stand(laser())
    stand.bad(0.5, "laser")
    stand.until(2)
    held = stand.states.snapshot()
    del held["symptoms"]
    held["outputs"] = [entry[:9] for entry in held["outputs"]]
    stand.states = RobotStates(stand.plan)
    assert stand.states.resume(held)
    stand.ok(3, "laser")
    assert told(stand.until(4)) == [(3, "laser", "absent", ())]


def test_a_change_of_one_output_costs_nothing_for_the_others(monkeypatch: Any) -> None:
    """Count evaluated outputs: one of a thousand changes, ten are blocked by it."""
    names = [f"c{n}" for n in range(1000)]
    parts = [laser(*(["c0"] if 0 < n <= 10 else []), name=name) for n, name in enumerate(names)]
    states, view = RobotStates(plan(*parts)), Values(plan(*parts))
    states.begin(T0_NS)
    count = len(outputs_of(states.plan))
    states.advance([OutputChange(at_ns(0.5), n, "ok", True) for n in range(count)], at_ns(1), view)
    looked: list[int] = []
    real = SymptomEmitter.emit

    def counted(
        self: Any, outputs: Sequence[int], components: Iterable[int], now_ns: int
    ) -> list[Symptom]:
        numbers = {*outputs, *(n for place in components for n in self._of_component[place])}
        looked.append(len(numbers))
        return real(self, outputs, components, now_ns)

    monkeypatch.setattr(SymptomEmitter, "emit", counted)
    found = states.advance(
        [OutputChange(at_ns(1) + TICK_NS, 0, "bad", False)], T0_NS + 4 * NS, view
    )
    assert len(symptoms(found)) == 11
    assert sum(looked) == 11


def test_a_symptom_says_what_was_measured_while_it_is_there() -> None:
    stand = Stand(laser())
    stand.bad(1, "laser", why="temperature is 58.2 °C, at most 50")
    stand.ok(3, "laser")
    assert [(s.state, s.reason) for s in symptoms(stand.until(4))] == [
        ("present", "temperature is 58.2 °C, at most 50"), ("absent", ""),
    ]  # fmt: skip


def test_a_number_with_a_limit_of_its_own_says_both() -> None:
    limited = OutputPlan(
        "rate_hz", "float", Result("rate_hz", "float", "messages per second", "Hz"), place=0,
        expectation=Expectation(8.0, ">="),
    )  # fmt: skip
    stand = Stand(component("laser", modes=[mode("device", limited)]))
    stand.find(1, "laser", "bad", 3.25, "")
    (told_of,) = symptoms(stand.until(2))
    assert told_of.reason == "rate hz is 3.25 Hz, expected >= 8.0"
