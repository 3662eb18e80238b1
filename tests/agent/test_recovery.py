"""Rules of recovery: when they act, how often, and when they leave it to people."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from amberbox.agent.recovery import PresentCauses, RecoveryPolicy, RuleReport, leading_modes
from amberbox.blackbox.robot_folder.robot_yaml import RecoveryRule
from amberbox.core.command import OrderLimit
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Level, Status
from amberbox.testing.clock import ManualClock

CRASH, SILENT = "laser#crash", "laser#silent"
RULE = RecoveryRule(CRASH, "restart", OrderLimit(2, 3600.0), {"unit": "laser"}, wait=30.0)


@dataclass
class Bench:
    """Rules with a gate, causes and a clock that are moved by hand."""

    rules: list[RecoveryRule]
    clock: ManualClock = field(default_factory=ManualClock)
    causes: dict[str, bool | None] = field(default_factory=dict)
    obstacle: str = ""
    is_allowed: bool = True
    made: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.policy = RecoveryPolicy(self.rules, self, self.clock, self)

    def has(self, cause: str, /) -> bool | None:
        return self.causes.get(cause)

    def allows(self, rule: RecoveryRule, /) -> bool:
        return self.is_allowed or not rule.condition

    def attempts(self, rule: str, within_s: float, /) -> int:
        return self.made.count(rule)

    def order_obstacle(self) -> str:
        return self.obstacle

    def pass_(self, seconds: int) -> list[str]:
        """Let time pass; return the actions that were ordered, each of which ends at once."""
        found = []
        for _ in range(seconds):
            rule = self.policy.due()
            if rule is not None:
                self.made.append(rule.key)
                self.policy.ordered(rule, f"id{len(self.made)}", "")
                self.policy.ended(f"id{len(self.made)}", "done", "")
                found.append(rule.do)
            self.clock.advance(1.0)
        return found

    def report(self) -> RuleReport:
        return self.policy.reports()[0]


def test_a_cause_has_to_last_before_each_attempt_and_the_limit_ends_them() -> None:
    bench = Bench([RULE], causes={CRASH: True})
    assert bench.pass_(30) == []
    assert bench.pass_(1) == ["restart"]
    bench.causes[CRASH] = False
    assert bench.pass_(100) == [] and bench.report().state == "idle"
    bench.causes[CRASH] = True
    assert bench.pass_(31) == ["restart"]
    assert bench.pass_(1000) == [] and bench.report().state == "gave_up"
    bench.made.clear()  # the hour is over: the same cause is left to people all the same
    assert bench.pass_(100) == []
    bench.causes[CRASH] = None
    assert bench.pass_(10) == [] and bench.report().state == "gave_up"
    bench.causes[CRASH] = False
    bench.pass_(1)
    bench.causes[CRASH] = True
    assert bench.pass_(31) == ["restart"]


def test_nothing_is_done_without_a_watcher() -> None:
    bench = Bench([RULE], causes={CRASH: True})
    bench.pass_(25)
    bench.causes[CRASH] = None
    bench.pass_(10)
    bench.causes[CRASH] = True
    assert bench.pass_(30) == [], "it has to last anew"
    assert bench.pass_(1) == ["restart"]


def test_it_waits_while_somebody_holds_the_robot() -> None:
    bench = Bench([RULE], causes={CRASH: True}, obstacle="the lease is held by anna")
    assert bench.pass_(100) == [] and bench.report().text == "the lease is held by anna"
    bench.obstacle = ""
    assert bench.pass_(1) == ["restart"]


def test_who_stops_it_or_a_robot_that_refuses_ends_it() -> None:
    bench = Bench([RULE], causes={CRASH: True})
    bench.pass_(30)
    due = bench.policy.due()
    assert due is RULE
    bench.policy.ordered(due, "id", "")
    assert bench.policy.due() is None, "one at a time"
    bench.policy.ended("id", "aborted", "aborted by nico")
    assert bench.pass_(100) == [] and "nico" in bench.report().text
    other = Bench([RULE], causes={CRASH: True})
    other.pass_(30)
    due = other.policy.due()
    assert due is not None
    other.policy.ordered(due, "id", "this robot has no action restart")
    assert other.pass_(100) == [] and "no action" in other.report().text


def test_the_next_rule_of_a_cause_begins_where_the_first_gave_up() -> None:
    power = RecoveryRule(CRASH, "power_cycle", OrderLimit(1, 3600.0), wait=60.0)
    bench = Bench([RULE, power], causes={CRASH: True})
    assert bench.pass_(200) == ["restart", "restart", "power_cycle"]


def test_a_condition_has_to_be_known_to_be_true() -> None:
    rule = RecoveryRule(CRASH, "restart", OrderLimit(1, 60.0), wait=1.0, condition="battery.v > 20")
    bench = Bench([rule], causes={CRASH: True}, is_allowed=False)
    assert bench.pass_(50) == [] and "battery.v > 20" in bench.report().text
    bench.is_allowed = True
    assert bench.pass_(1) == ["restart"]


def status(mode: str, level: Level, *blocked_by: str) -> Status:
    component, _, name = mode.partition("/")
    return Status("r", component, name, level, "x", {}, blocked_by, 0, 0, "", "")


def diagnosis(*found: tuple[frozenset[str], float], indistinct: int = 1) -> Diagnosis:
    hypotheses = tuple(
        Hypothesis(str(n), faults, share, ("laser/process/running", "map/match/fits"))
        for n, (faults, share) in enumerate(found)
    )
    first = hypotheses[:indistinct]
    group = AmbiguityGroup(tuple(h.id for h in first), sum(h.probability for h in first))
    return Diagnosis("d", 1, "r", 0, "", hypotheses, 1.0, groups=(group,))


@pytest.mark.parametrize(
    ("levels", "found", "leads"),
    [
        (("error", "error"), diagnosis((frozenset({CRASH}), 0.9)), {CRASH}),
        (("unknown", "ok"), diagnosis((frozenset({CRASH}), 0.9)), {CRASH}),
        (("ok", "error"), diagnosis((frozenset({CRASH}), 0.9)), set()),
        (("error", "error"), diagnosis((frozenset({CRASH}), 0.4)), set()),
        (("error", "error"), diagnosis(
            (frozenset({CRASH}), 0.5), (frozenset({SILENT}), 0.4), indistinct=2), set()),
        (("error", "error"), diagnosis(
            (frozenset({CRASH}), 0.5), (frozenset({CRASH, SILENT}), 0.4), indistinct=2), {CRASH}),
    ],
)  # fmt: skip
def test_what_leads_shows_still_and_is_the_same_in_all_that_lead(
    levels: tuple[Level, Level], found: Diagnosis, leads: set[str]
) -> None:
    statuses = {
        "laser/process": status("laser/process", levels[0]),
        "map/match": status("map/match", levels[1]),
    }
    assert leading_modes(found, statuses) == leads


def test_a_component_is_a_cause_while_it_is_in_error_by_itself() -> None:
    statuses = {
        "a": status("a", "error"), "b": status("b", "error", "a"), "c/m": status("c/m", "stale"),
        "d": status("d", "warn"), "e": status("e", "unknown"),
    }  # fmt: skip
    causes = PresentCauses(0, statuses, frozenset())
    found = [causes.has(name) for name in ("a", "b", "c/m", "d", "e", "f", "a#x")]
    assert found == [True, False, True, False, None, None, False]
    assert PresentCauses(0, {}, frozenset()).has("a#x") is None
