"""States over time: findings and their times, epochs, independent of the calls."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.expression import parse
from amberbox.core.needs import Needs, all_of
from amberbox.core.types import Status, Symptom
from amberbox.monitoring.alarms import Action, PersonAction
from amberbox.monitoring.findings import TICK_NS, Finding, OutputChange, OutputCondition, Transition
from amberbox.monitoring.plan import (
    ComponentPlan,
    DependencyPlan,
    Expectation,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)
from amberbox.monitoring.states import RobotStates, outputs_of
from tests.monitoring.engine.stand import (
    T0_NS,
    Stand,
    Values,
    alarms,
    at_ns,
    component,
    mode,
    output,
    plan,
    seconds,
    statuses,
    symptoms,
    transitions,
)

LASER = (component("loc", "laser"), component("laser"))


def told(findings: Sequence[Finding]) -> list[tuple[float, str]]:
    return [
        (seconds(s.measured_ns), f"{s.component}/{s.mode}".rstrip("/")) for s in statuses(findings)
    ]


ALL = ["loc/device", "loc", "laser/device", "laser"]


def test_all_is_told_at_every_whole_second() -> None:
    stand = Stand(*LASER, begin=False)
    assert told(stand.begin(0.4)) == [(0.4, name) for name in ALL]
    assert told(stand.until(0.95)) == []
    assert told(stand.until(2.5)) == [(second, name) for second in (1, 2) for name in ALL]


def test_what_changes_is_told_at_once() -> None:
    stand = Stand(*LASER)
    stand.ok(0.5, "laser", "loc")
    stand.until(1)
    stand.bad(1.25, "laser")
    assert told(stand.until(1.5)) == [
        (1.25, "loc/device"), (1.25, "loc"), (1.25, "laser/device"), (1.25, "laser"),
    ]  # fmt: skip
    stand.bad(1.6, "loc")
    assert told(stand.until(1.9)) == [(1.6, "loc/device"), (1.6, "loc")]


def test_values_are_told_when_bools_and_texts_change_and_not_for_numbers() -> None:
    outputs = output("word", type="string"), output("speed", type="float")
    stand = Stand(component("x", modes=[mode("m", *outputs)]))
    stand.find(0.1, "x/m/word", "ok", "RUN")
    stand.find(0.1, "x/m/speed", "ok", 1.0)
    stand.until(1)
    stand.find(1.2, "x/m/speed", "ok", 2.0)
    stand.find(1.4, "x/m/word", "ok", "STOP")
    found = stand.until(1.5)
    assert told(found) == [(1.4, "x/m")]
    assert statuses(found)[0].outputs == {"word": "STOP", "speed": 2.0}


def test_since_when_it_is_so() -> None:
    stand = Stand(*LASER)
    stand.ok(0.5, "laser", "loc")
    stand.bad(2.5, "laser", why="first")
    stand.bad(3.5, "laser", why="second")  # another reason, the same state
    stand.until(4)
    assert stand.status("laser").reason.endswith("second")
    assert seconds(stand.status("laser").since_ns) == 2.5
    assert seconds(stand.status("laser/device").since_ns) == 2.5
    assert seconds(stand.status("loc").since_ns) == 0.5
    assert seconds(stand.status("loc").measured_ns) == 4


def test_what_is_pending_counts_without_anything_further() -> None:
    slow = mode("device", output(for_s=5, heal_s=2))
    stand = Stand(component("laser", modes=[slow]))
    stand.ok(0.5, "laser")
    stand.bad(1.3, "laser")
    found = stand.until(6.25)
    assert told(found)[-2:] == [(6, "laser/device"), (6, "laser")]
    found = stand.until(6.5)
    assert told(found) == [(6.3, "laser/device"), (6.3, "laser")]
    assert [seconds(t.at_ns) for t in transitions(found)] == [6.3, 6.3]


def test_a_transition_says_what_can_be_done() -> None:
    stand = Stand(component("laser", modes=[mode("device", output(hint="plug it in"))]))
    stand.ok(0.5, "laser")
    stand.bad(1.5, "laser", why="gone")
    first, second = transitions(stand.until(2))[-2:]
    assert (first.mode, second.mode) == ("device", "")
    for transition in (first, second):
        assert (transition.before, transition.after) == (("ok", "nominal"), ("error", "working"))
        assert transition.hint == "plug it in"
        assert transition.at_ns == at_ns(1.5)
    assert second.text == "laser: nominal -> working: working is false, expected true: gone"


def test_the_first_epoch_begins_without_transitions() -> None:
    stand = Stand(*LASER)
    stand.ok(0.5, "laser", "loc")
    stand.until(2)
    assert [(t.component, t.mode, t.before.state, t.after.state) for t in transitions(
        stand.findings
    )] == [
        ("loc", "", "not_initialised", "nominal"),
        ("laser", "", "not_initialised", "nominal"),
    ]  # fmt: skip


def test_a_new_epoch_is_one_transition_for_each_component() -> None:
    stand = Stand(*LASER, component("bus", modes=[]))
    stand.ok(0.5, "laser", "loc")
    stand.until(2)
    found = stand.begin(3)
    assert [(t.component, t.mode, t.text) for t in transitions(found)] == [
        ("loc", "", "loc: nominal -> not_initialised: waits for laser: not measured yet"),
        ("laser", "", "laser: nominal -> not_initialised: not measured yet"),
    ]
    assert {s.level for s in statuses(found)} == {"unknown"}
    assert {s.since_ns for s in statuses(found)} == {at_ns(3)}
    assert {v for s in statuses(found) for v in s.outputs.values()} == {None}
    assert transitions(stand.begin(4)) == []


def test_after_a_new_epoch_only_what_differs_is_a_transition_of_a_mode() -> None:
    stand = Stand(*LASER)
    stand.ok(0.5, "laser")
    stand.bad(0.5, "loc")
    stand.until(2)
    stand.begin(3)
    stand.bad(3.5, "laser", "loc")
    found = stand.until(4)
    assert [(t.component, t.text) for t in transitions(found) if t.mode] == [
        ("laser", "laser/device: nominal -> working: working is false, expected true")
    ]


def test_an_epoch_may_begin_earlier_than_the_last_one_ended() -> None:
    stand = Stand(*LASER)
    stand.until(100)
    stand.begin(10)
    stand.ok(10.5, "laser", "loc")
    found = stand.until(11)
    assert told(found)[-4:] == [(11, name) for name in ALL]
    assert stand.now("laser") == ("ok", "nominal")


def test_statuses_are_known_before_anything_and_after_resume() -> None:
    fresh = RobotStates(plan(*LASER))
    assert [(s.component, s.mode, s.level) for s in fresh.statuses()] == [
        ("loc", "device", "unknown"), ("loc", "", "unknown"),
        ("laser", "device", "unknown"), ("laser", "", "unknown"),
    ]  # fmt: skip
    stand = Stand(*LASER)
    stand.ok(0.5, "laser", "loc")
    stand.until(1.5)
    fresh.resume(json.loads(json.dumps(stand.states.snapshot())))
    (status,) = [s for s in fresh.statuses() if (s.component, s.mode) == ("laser", "device")]
    assert (status.level, status.outputs) == ("ok", {"working": True})


def test_a_snapshot_is_small() -> None:
    modes = [mode("m", *(output(f"o{k}", type="float") for k in range(4)))]
    stand = Stand(*(component(f"c{n}", modes=modes) for n in range(50)))
    for place in stand.places:
        stand.find(0.5, f"{place.component}/{place.mode}/{place.output.name}", "ok", 1.0)
    stand.until(1)
    assert len(json.dumps(stand.states.snapshot())) < 50 * 70


def test_a_fault_state_by_its_condition_is_followed_after_resume() -> None:
    charge = output("charge", type="float", expectation=Expectation(20, ">="))
    battery = mode("battery", charge, states={"empty": parse("charge < 5")})
    stand = Stand(component("battery", modes=[battery]))
    stand.find(0.5, "battery", "bad", 15.0)
    stand.until(0.9)
    held = json.loads(json.dumps(stand.states.snapshot()))
    stand.states = RobotStates(stand.plan)
    assert stand.states.resume(held)
    stand.find(1.5, "battery", "bad", 4.0)
    stand.until(2)
    assert stand.now("battery/battery") == ("error", "empty")


# What follows: whatever the plan and whatever is found, in whatever pieces it is asked for.

WHATS: list[OutputCondition] = ["ok", "bad", "unknown", "stale"]


@st.composite
def output_plans(draw: st.DrawFn, name: str) -> OutputPlan:
    delays = st.sampled_from([0.0, 0.0, 0.12, 1.0])
    return output(
        name,
        type=draw(st.sampled_from(["bool", "float", "string"])),
        severity=draw(st.sampled_from(["warning", "urgent", "fatal"])),
        expectation=draw(st.sampled_from([Expectation(), Expectation(3, "<=")])),
        for_s=draw(delays),
        heal_s=draw(delays),
        flaps=draw(st.sampled_from([1, 2, 6])),
        flap_s=draw(st.sampled_from([1.0, 3.0])),
    )


@st.composite
def mode_plans(draw: st.DrawFn, name: str) -> ModePlan:
    outputs = [draw(output_plans(f"o{n}")) for n in range(draw(st.integers(1, 2)))]
    states = {"odd": parse("o0 == 1.5 or o0 == 'b'")} if draw(st.booleans()) else {}
    problem = "it cannot run" if draw(st.integers(0, 9)) == 0 else ""
    return mode(name, *outputs, states=states, problem=problem)


@st.composite
def plans(draw: st.DrawFn) -> MonitoringPlan:
    """Draw a robot whose components need later ones, in mixed order."""
    made: list[ComponentPlan] = []
    for number in range(draw(st.integers(1, 6))):
        modes = [draw(mode_plans(f"m{n}")) for n in range(draw(st.integers(0, 2)))]
        needs = [draw(edges(other)) for other in made if draw(st.booleans())]
        policy = draw(st.sampled_from(["all", "any", "majority"]))
        gates = draw(st.none() | some_of([edge.name for edge in needs])) if needs else None
        made.append(component(f"c{number}", *needs, modes=modes, policy=policy, needs=gates))
    return plan(*draw(st.permutations(made)))


@st.composite
def some_of(draw: st.DrawFn, names: Sequence[str]) -> Needs:
    """Draw needs of some of the names, perhaps of two gates."""
    cut = draw(st.integers(0, len(names) - 1))
    inner = names[cut:]
    gate = Needs(draw(st.integers(1, len(inner))), tuple(inner))
    if not cut:
        return gate
    return Needs(draw(st.integers(1, cut + 1)), (*names[:cut], gate))


@st.composite
def edges(draw: st.DrawFn, other: ComponentPlan) -> DependencyPlan:
    if draw(st.integers(0, 9)) == 0:
        return DependencyPlan(other.id, component=other.id, judged=False)
    if not other.modes or draw(st.booleans()):
        return DependencyPlan(other.id, component=other.id)
    judge = draw(st.sampled_from(list(other.modes)))
    named = draw(st.sampled_from(["", judge.mappings[0].outputs[0].name]))
    return DependencyPlan(other.id, "functional", other.id, judge.id, named)


@dataclass(frozen=True)
class Story:
    """What happens to a robot: in each chapter something is found; then an epoch begins, or a
    person acknowledges or shelves an alarm."""

    plan: MonitoringPlan
    chapters: Sequence[Sequence[OutputChange]]
    ends: Sequence[int]
    between: Sequence[str]


@st.composite
def stories(draw: st.DrawFn) -> Story:
    drawn = draw(plans())
    count = len(outputs_of(drawn))
    now = T0_NS
    chapters, ends = [], []
    for _ in range(draw(st.integers(1, 3))):
        found: list[OutputChange] = []
        for _ in range(draw(st.integers(0, 25)) if count else 0):
            now += draw(st.sampled_from([0, 1, 1, 3, 9, 20, 130])) * TICK_NS
            number = draw(st.integers(0, count - 1))
            found.append(_drawn_found(draw, drawn, now + TICK_NS, number))
        now += draw(st.integers(1, 200)) * TICK_NS
        chapters.append(sorted(found, key=lambda entry: entry[:2]))
        ends.append(now)
    between = [draw(st.sampled_from(["begin", "acknowledge", "shelve", ""])) for _ in ends]
    return Story(drawn, chapters, ends, between)


def _drawn_found(draw: st.DrawFn, drawn: MonitoringPlan, now: int, number: int) -> OutputChange:
    what = draw(st.sampled_from([*WHATS, "ok", "bad", "ok", "bad"]))
    why = draw(st.sampled_from(["a", "b"])) if what in ("unknown", "stale") else ""
    values: dict[str, list[bool | float | str]] = {
        "bool": [True, False], "float": [1.5, 2.5, 7.25], "string": ["a", "b"],
    }  # fmt: skip
    value = draw(st.sampled_from(values[outputs_of(drawn)[number].output.type]))
    return OutputChange(now, number, what, None if why else value, why)


def tell(story: Story, cuts: Sequence[int] = (), resumes: bool = False) -> list[Finding]:
    """Return all findings, with calls at the cuts as well, optionally with a new object
    each time.
    """
    states, view = RobotStates(story.plan), Values(story.plan)
    findings = states.begin(T0_NS)
    for chapter, end, between in zip(story.chapters, story.ends, story.between, strict=True):
        view.take(chapter)
        left = list(chapter)
        for until in sorted({cut for cut in cuts if cut < end} | {end}):
            taken = [entry for entry in left if entry.at_ns <= until]
            left = left[len(taken) :]
            findings += states.advance(taken, until, view)
            if resumes:
                held = json.loads(json.dumps(states.snapshot(), allow_nan=False))
                states = RobotStates(story.plan)
                assert states.resume(held)
        findings += _do(states, between, end)
    return findings


def _do(states: RobotStates, what: str, now_ns: int) -> list[Finding]:
    if what == "begin":
        return states.begin(now_ns)
    standing = states.alarms()
    if not what or not standing:
        return []
    until_ns = now_ns + 41 * TICK_NS if what == "shelve" else None
    action: Action = "shelve" if what == "shelve" else "acknowledge"
    return list(states.command(standing[0].id, PersonAction(action, "anna", now_ns, until_ns)))


@settings(max_examples=60)
@given(stories(), st.data())
def test_it_does_not_matter_how_often_it_is_asked_or_resumed(
    story: Story, data: st.DataObject
) -> None:
    whole = tell(story)
    ticks = st.integers(0, (story.ends[-1] - T0_NS) // TICK_NS)
    cuts = [T0_NS + tick * TICK_NS for tick in data.draw(st.lists(ticks, max_size=12))]
    assert tell(story, cuts) == whole
    assert tell(story, cuts, resumes=True) == whole


@settings(max_examples=60)
@given(stories())
def test_what_is_told_holds_together(story: Story) -> None:
    findings = tell(story)
    _each_once(story, findings)
    _transitions_follow_one_another(findings)
    _blocked_by_what_is_below(story.plan, findings)
    _alarms_are_of_roots(findings)
    _symptoms_are_what_statuses_say(story.plan, findings)


def _each_once(story: Story, findings: Sequence[Finding]) -> None:
    began = {T0_NS} | {e for e, b in zip(story.ends, story.between, strict=True) if b == "begin"}
    told = Counter((s.component, s.mode, s.measured_ns) for s in statuses(findings))
    assert all(n == 1 or key[2] in began for key, n in told.items())
    times = [s.measured_ns for s in statuses(findings)]
    assert times == sorted(times)


def _transitions_follow_one_another(findings: Sequence[Finding]) -> None:
    """See that each begins where the one before ended, and that statuses are where it led to."""
    now: dict[tuple[str, str], tuple[str, str]] = {}
    for finding in findings:
        if isinstance(finding, Transition):
            key = finding.component, finding.mode
            assert now.get(key, finding.before) == finding.before != finding.after
            now[key] = finding.after
        elif isinstance(finding, Status) and (not finding.mode or finding.level != "unknown"):
            condition = finding.level, finding.state
            assert now.setdefault((finding.component, finding.mode), condition) == condition


def _blocked_by_what_is_below(drawn: MonitoringPlan, findings: Sequence[Finding]) -> None:
    """Compare with the definition, computed again from the last statuses of all components."""
    newest = {(s.component, s.mode): s for s in statuses(findings)}
    known = {component.id: component for component in drawn.components}
    functional = ("ok", "warn")

    def blockers(name: str) -> set[str]:
        edges = {edge.name: blocking(edge) for edge in known[name].dependencies}
        return in_the_way(known[name].needs or all_of(*edges), edges)

    def in_the_way(needs: Needs, edges: Mapping[str, set[str]]) -> set[str]:
        parts = [edges[p] if isinstance(p, str) else in_the_way(p, edges) for p in needs.parts]
        is_met = parts.count(set()) >= needs.at_least
        return set() if is_met else set().union(*parts)

    def blocking(edge: DependencyPlan) -> set[str]:
        other = edge.component or ""
        if not edge.judged or edge.output:
            return set()  # one output of several: not to be seen from statuses
        if edge.mode:
            level = newest[other, edge.mode].level
            return set() if level in functional else {f"{other}/{edge.mode}"}
        if known[other].modes and newest[other, ""].level not in functional:
            return {other}
        return blockers(other)

    for name in known:
        by_output = any(e.output for c in drawn.components for e in c.dependencies)
        found = set(newest[name, ""].blocked_by)
        assert blockers(name) <= found if by_output else blockers(name) == found


def _alarms_are_of_roots(findings: Sequence[Finding]) -> None:
    for alarm in alarms(findings):
        if alarm.state == "healed" or alarm.live_only:
            continue
        at_that_time = [
            s for s in statuses(findings)
            if s.component == alarm.component and s.measured_ns <= alarm.changed_ns and not s.mode
        ]  # fmt: skip
        assert at_that_time[-1].blocked_by == ()
        assert alarm.level in ("warn", "stale", "error")


SAYS = {"ok": "absent", "warn": "present", "error": "present"}


def _symptoms_are_what_statuses_say(drawn: MonitoringPlan, findings: Sequence[Finding]) -> None:
    """Compare each with the statuses of its instant; none is repeated, none is missing.

    Only a symptom that is no evidence may be missing after unknown.
    """
    of_mode = _expected_alone(drawn)
    last: dict[str, tuple[str, tuple[str, ...]]] = {}
    for finding in findings:
        if isinstance(finding, Symptom):
            said: tuple[str, tuple[str, ...]] = finding.state, finding.blocked_by
            assert said != last.get(finding.id, ("unknown", finding.blocked_by))
            assert finding.id in last or said[0] == "present" or said == ("absent", ())
            assert (finding.onset_ns is not None) == (finding.state == "present")
            last[finding.id] = said
        elif isinstance(finding, Status) and (finding.component, finding.mode) in of_mode:
            name = of_mode[finding.component, finding.mode]
            said = SAYS.get(finding.level, "unknown"), finding.blocked_by
            counts = said[0] == "present" or said == ("absent", ())
            before = last.get(name, ("unknown", ()))
            assert before == said or (before[0] == "unknown" and not counts)
    known = {s.id for s in symptoms(findings)}
    expected = {f"{p.component}/{p.mode}/{p.output.name}" for p in outputs_of(drawn)
                if p.output.expectation.value is not None}  # fmt: skip
    assert known <= expected


def _expected_alone(drawn: MonitoringPlan) -> dict[tuple[str, str], str]:
    """Return the modes of one output of which something is expected, and the output's address."""
    alone = {}
    for place in outputs_of(drawn):
        key = place.component, place.mode
        of_same = [p for p in outputs_of(drawn) if (p.component, p.mode) == key]
        if len(of_same) == 1 and place.output.expectation.value is not None:
            alone[key] = f"{place.component}/{place.mode}/{place.output.name}"
    return alone
