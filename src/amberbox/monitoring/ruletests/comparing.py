"""Compare what a rule test expects with what the engine found, and say what differs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.core.types import Output, Status
from amberbox.monitoring.engine.findings import AlarmChange, Finding, Transition
from amberbox.monitoring.ruletests.files import (
    ExpectedAlarm,
    ExpectedStatus,
    ExpectedTransition,
    Rules,
    RuleTest,
)
from amberbox.monitoring.ruletests.notation import shown
from amberbox.monitoring.ruletests.rows import START_NS

_NEAR = 1e-9


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a test: statuses at the times asked for, and all that was found."""

    statuses: Mapping[float, Mapping[tuple[str, str], Status]]
    findings: Sequence[Finding]


def differences(rules: Rules, number: int, test: RuleTest, outcome: Outcome) -> list[Problem]:
    """Return what is not as a test expects, each with the line of the expectation."""
    return [*_statuses(rules, number, test, outcome), *_changes(rules, number, test, outcome)]


def component_and_mode(of: str) -> tuple[str, str]:
    """Split a name as tests write it; the mode of a component is empty."""
    component, _, mode = of.partition("/")
    return component, mode


def _statuses(rules: Rules, number: int, test: RuleTest, outcome: Outcome) -> Iterator[Problem]:
    for place, entry in zip(rules.places(number, "expect"), test.expect, strict=True):
        status = outcome.statuses[entry.at][component_and_mode(entry.of)]
        for what in _differences(entry, status):
            named = " ".join(dict.fromkeys((status.level, status.state)))
            got = f"it is {named}" + (f": {status.reason}" if status.reason else "")
            yield _problem(place, test, entry.at, f"{entry.of}: {what}", got)


def _differences(entry: ExpectedStatus, status: Status) -> Iterator[str]:
    if entry.level is not None and entry.level != status.level:
        yield f"expected level {entry.level}, got {status.level}"
    if entry.state is not None and entry.state != status.state:
        yield f"expected state {entry.state}, got {status.state}"
    if entry.reason not in status.reason:
        yield f"expected a reason with '{entry.reason}', got '{status.reason}'"
    if entry.blocked_by is not None and set(entry.blocked_by) != set(status.blocked_by):
        yield f"expected blocked_by {_listed(entry.blocked_by)}, got {_listed(status.blocked_by)}"
    for name, expected in entry.outputs.items():
        if name not in status.outputs:
            known = ", ".join(status.outputs) or "none"
            near = did_you_mean(name, status.outputs)
            yield f"there is no output '{name}'{near} (outputs: {known})"
        elif not _is_as(expected, status.outputs[name]):
            yield f"expected {name} {_written(expected)}, got {_written(status.outputs[name])}"


def _is_as(expected: Any, value: Output) -> bool:
    """Compare an output with what was written: a value, or a range ``9.8 .. 10.2``."""
    if isinstance(expected, str) and ".." in expected and not isinstance(value, str):
        low, _, high = expected.partition("..")
        return isinstance(value, int | float) and float(low) <= value <= float(high)
    if isinstance(expected, bool) or isinstance(value, bool):
        return expected is value
    if isinstance(expected, int | float) and isinstance(value, int | float):
        return math.isclose(expected, value, rel_tol=_NEAR, abs_tol=_NEAR)
    return bool(expected == value)


def _changes(rules: Rules, number: int, test: RuleTest, outcome: Outcome) -> Iterator[Problem]:
    if test.transitions is not None:
        found = [finding for finding in outcome.findings if isinstance(finding, Transition)]
        places = rules.places(number, "transitions")
        for name in dict.fromkeys(entry.of for entry in test.transitions):
            of_name = [t for t in found if (t.component, t.mode) == component_and_mode(name)]
            listed = [
                (place, entry)
                for place, entry in zip(places, test.transitions, strict=True)
                if entry.of == name
            ]
            yield from _compare(test, listed, _from_first(listed[0][1], of_name), _as_transition)
    if test.alarms is not None:
        changes = [finding for finding in outcome.findings if isinstance(finding, AlarmChange)]
        listed_alarms = list(zip(rules.places(number, "alarms"), test.alarms, strict=True))
        if test.alarms:
            yield from _compare(test, listed_alarms, changes, _as_alarm)
        else:
            place = rules.place(number, "alarms")
            yield from (_surplus(place, test, c.changed_ns, _alarm_text(c)) for c in changes)


def _from_first(entry: ExpectedTransition, found: Sequence[Transition]) -> Sequence[Transition]:
    """Leave out what came before the first that is listed, such as the initialisation."""
    for place, transition in enumerate(found):
        if not list(_as_transition(entry, transition)):
            return found[place:]
    return found


def _compare(
    test: RuleTest,
    listed: Sequence[tuple[Node, Any]],
    found: Sequence[Any],
    differences: Callable[[Any, Any], Iterator[str]],
) -> Iterator[Problem]:
    """Compare a list with what came, one after the other; tell the first difference only."""
    for number, (place, entry) in enumerate(listed):
        if number >= len(found):
            yield _problem(place, test, entry.at, f"{entry.of}: it did not come", "")
            return
        wrong = list(differences(entry, found[number]))
        if wrong:
            yield _problem(
                place, test, entry.at, f"{entry.of}: {'; '.join(wrong)}", _text(found[number])
            )
            return
    if len(found) > len(listed):
        extra = found[len(listed)]
        yield _surplus(listed[-1][0], test, _time_of(extra), _text(extra))


def _as_transition(entry: ExpectedTransition, found: Transition) -> Iterator[str]:
    yield from _at(entry.at, found.at_ns)
    if entry.level is not None and entry.level != found.after.level:
        yield f"expected level {entry.level}, got {found.after.level}"
    if entry.state is not None and entry.state != found.after.state:
        yield f"expected state {entry.state}, got {found.after.state}"
    if entry.reason not in found.reason:
        yield f"expected a reason with '{entry.reason}', got '{found.reason}'"


def _as_alarm(entry: ExpectedAlarm, found: AlarmChange) -> Iterator[str]:
    yield from _at(entry.at, found.changed_ns)
    if entry.of != found.component:
        yield f"expected an alarm of {entry.of}, got one of {found.component}"
    if entry.state != found.state:
        yield f"expected state {entry.state}, got {found.state}"
    if entry.severity is not None and entry.severity != found.severity:
        yield f"expected severity {entry.severity}, got {found.severity}"
    if entry.count is not None and entry.count != found.count:
        yield f"expected count {entry.count}, got {found.count}"
    if entry.reason not in found.reason:
        yield f"expected a reason with '{entry.reason}', got '{found.reason}'"


def _at(expected_s: float | None, at_ns: int) -> Iterator[str]:
    if expected_s is not None and round(expected_s * NS) + START_NS != at_ns:
        yield f"expected at {expected_s:g} s, came at {_seconds(at_ns):g} s"


def _text(found: Transition | AlarmChange) -> str:
    text = found.text if isinstance(found, Transition) else _alarm_text(found)
    return f"at {_seconds(_time_of(found)):g} s came {text}"


def _alarm_text(change: AlarmChange) -> str:
    return f"alarm of {change.component} ({change.severity}) {change.state}: {change.reason}"


def _time_of(found: Transition | AlarmChange) -> int:
    return found.at_ns if isinstance(found, Transition) else found.changed_ns


def _surplus(place: Node, test: RuleTest, at_ns: int, text: str) -> Problem:
    return _problem(place, test, _seconds(at_ns), "a change came that is not listed", text)


def _problem(place: Node, test: RuleTest, at_s: float | None, what: str, got: str) -> Problem:
    when = "" if at_s is None else f" at {at_s:g} s"
    told = f"{what} ({got})" if got else what
    return place.problem(f"test '{test.test}'{when}", told)


def _seconds(at_ns: int) -> float:
    return (at_ns - START_NS) / NS


def _listed(names: Sequence[str]) -> str:
    return f"[{', '.join(sorted(names))}]"


def _written(value: Any) -> str:
    return value if isinstance(value, str) and ".." in value else shown(value)
