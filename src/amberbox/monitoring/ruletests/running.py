"""Run rule tests: rows in memory go through the engine, and what it finds is compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem, UsageError
from amberbox.core.types import Status
from amberbox.monitoring.engine.engine import Engine
from amberbox.monitoring.engine.findings import TICK_NS, Finding
from amberbox.monitoring.plan import Plan
from amberbox.monitoring.ruletests.bench import COMPONENT, bench_plan
from amberbox.monitoring.ruletests.comparing import Outcome, component_and_mode, differences
from amberbox.monitoring.ruletests.files import (
    ExpectedAlarm,
    ExpectedStatus,
    ExpectedTransition,
    RuleFile,
    Rules,
    RuleTest,
)
from amberbox.monitoring.ruletests.rows import START_NS, Incoming, incoming


def run_rules(rules: Rules, plan: Plan) -> list[Problem]:
    """Run every test of a file; return what is not as expected, each with its line."""
    problems: list[Problem] = []
    if rules.mode is not None:
        plan, problems = bench_plan(rules.mode, rules.file, rules.folder)
        mode = plan.components[0].modes[0].id
        of = rules.file.of or f"{COMPONENT}/{mode}"
        rules = rules._replace(file=replace(rules.file, of=of))
    if any(problem.is_error for problem in problems):
        return problems
    return problems + [
        problem
        for number in range(len(rules.file.tests))
        for problem in _run_test(rules, number, plan)
    ]


def _run_test(rules: Rules, number: int, plan: Plan) -> list[Problem]:
    test = _with_names(rules.file, rules.file.tests[number])
    where = f"test '{test.test}'"
    unknown = list(_unknown_names(rules, number, test, plan))
    if unknown:
        return unknown
    named = {component_and_mode(entry.of)[0] for entry in _entries(test)}
    plan = _part_of(plan, named) if named else plan
    try:
        rows = incoming(test, test.interval or rules.file.interval, plan)
        outcome = _run(test, rows, plan)
    except UsageError as error:
        return [rules.places(number)[0].problem(where, error.what, error.hint)]
    return differences(rules, number, test, outcome)


def _run(test: RuleTest, rows: Incoming, plan: Plan) -> Outcome:
    engine = Engine(plan)
    engine.begin(START_NS - TICK_NS)
    for batch in rows.batches():
        engine.feed(batch)
    end_s = rows.intervals * rows.interval_ns / NS
    times = sorted({entry.at for entry in test.expect})
    changes: list[ExpectedTransition | ExpectedAlarm]
    changes = [*(test.transitions or ()), *(test.alarms or ())]
    last = [entry.at for entry in changes if entry.at is not None]
    findings: list[Finding] = []
    statuses: dict[float, Mapping[tuple[str, str], Status]] = {}
    for at in times:
        findings += engine.advance(START_NS + round(at * NS))
        statuses[at] = {(s.component, s.mode): s for s in engine.statuses()}
    findings += engine.advance(START_NS + round(max([end_s, *times, *last]) * NS))
    return Outcome(statuses, findings)


def _with_names(file: RuleFile, test: RuleTest) -> RuleTest:
    """Write out whom each expectation is about."""
    component = component_and_mode(file.of)[0]
    return replace(
        test,
        expect=[replace(entry, of=entry.of or file.of) for entry in test.expect],
        transitions=test.transitions
        and [replace(entry, of=entry.of or file.of) for entry in test.transitions],
        alarms=test.alarms and [replace(entry, of=entry.of or component) for entry in test.alarms],
    )


def _entries(
    test: RuleTest,
) -> Iterator[ExpectedStatus | ExpectedTransition | ExpectedAlarm]:
    yield from test.expect
    yield from test.transitions or ()
    yield from test.alarms or ()


def _unknown_names(rules: Rules, number: int, test: RuleTest, plan: Plan) -> Iterator[Problem]:
    known = {c.id for c in plan.components} | {f"{c.id}/{m.id}" for c, m in plan.modes()}
    for key in ("expect", "transitions", "alarms"):
        for place, entry in zip(rules.places(number, key), getattr(test, key) or (), strict=True):
            if entry.of not in known:
                what = f"there is no component or mode '{entry.of}'{did_you_mean(entry.of, known)}"
                hint = "" if entry.of else "name it with 'of', here or at the top of the file"
                yield place.problem(f"test '{test.test}'", what, hint)


def _part_of(plan: Plan, wanted: set[str]) -> Plan:
    """Return the components that a test is about, and what they depend on."""
    by_id = {component.id: component for component in plan.components}
    reached: set[str] = set()
    waiting = [name for name in wanted if name in by_id]
    while waiting:
        name = waiting.pop()
        if name in reached:
            continue
        reached.add(name)
        waiting += [d.component for d in by_id[name].dependencies if d.component in by_id]
    return replace(plan, components=[c for c in plan.components if c.id in reached])
