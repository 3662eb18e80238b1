"""One alarm for one cause: raised by the diagnosis, merged, and separated again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import pytest

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import AmbiguityGroup, Diagnosis, FaultFacts, Hypothesis, Status
from amberbox.monitoring.alarm_causes import AlarmCauses, DiagnosedAlarms
from amberbox.monitoring.alarms import PersonAction
from amberbox.monitoring.findings import AlarmChange, Finding
from tests.monitoring.watcher.diagnoser import answer
from tests.monitoring.watcher.test_alarm_causes import alarm

FACTS = {
    "battery#hot": FaultFacts("fatal", frozenset(["battery.warm"])),
    "laser#dead": FaultFacts("critical", frozenset(["laser/alive/alive", "log/errors/none"])),
    "motor#weak": FaultFacts("urgent", frozenset(["motor/push/pushes", "log/errors/none"])),
    "motor#worn": FaultFacts("warning", frozenset(["motor.worn"])),
}
HOT = answer(["battery#hot"], ["battery.warm"], at_ns=10 * NS)
DEAD = answer(["laser#dead"], ["laser/alive/alive", "log/errors/none"], at_ns=10 * NS)


def causes_of() -> AlarmCauses:
    return AlarmCauses(FACTS, DiagnosedAlarms("robot", "hash"))


def told(causes: AlarmCauses, *findings: Finding, until_s: float = 0) -> list[tuple[str, str, str]]:
    """Return component, state and cause of the emitted alarms, up to an instant."""
    found = causes.process(findings, round(until_s * NS))
    return [(f.component, f.state, f.cause) for f in found if isinstance(f, AlarmChange)]


def opens(component: str, at_s: float, **more: object) -> AlarmChange:
    at_ns = round(at_s * NS)
    return alarm(component, opened_ns=at_ns, changed_ns=at_ns, **more)


def lasting(causes: AlarmCauses, *monitors: AlarmChange) -> list[tuple[str, str]]:
    """Return the active alarms as shown: id and severity."""
    return [(one.id, one.severity) for one in causes.named(monitors)]


def over(diagnosis: Diagnosis, at_s: float) -> Diagnosis:
    return replace(diagnosis, state="healed", revision=9, at_ns=round(at_s * NS))


def test_a_fatal_cause_without_alarm_raises_its_own_once() -> None:
    causes = causes_of()
    assert told(causes, HOT, until_s=11.9) == []
    assert told(causes, until_s=12) == [("battery", "open", "battery#hot (very likely)")]
    assert told(causes, replace(HOT, revision=2, at_ns=20 * NS), until_s=60) == []
    (shown,) = causes.named([])
    assert (shown.severity, shown.level) == ("fatal", "error")
    assert shown.reason == "diagnosed from battery.warm"
    assert told(causes, over(HOT, 70), until_s=80) == [
        ("battery", "healed", "battery#hot (very likely)")
    ]
    assert causes.named([]) == []


@pytest.mark.parametrize("at_s", [5, 11])
def test_a_cause_with_a_monitor_s_alarm_raises_none(at_s: float) -> None:
    causes, monitor = causes_of(), opens("battery", at_s, severity="urgent")
    findings: Sequence[Finding] = [monitor, HOT] if at_s < 10 else [HOT, monitor]
    told(causes, *findings, until_s=60)
    assert lasting(causes, monitor) == [(monitor.id, "urgent")]
    healed = replace(monitor, state="healed", changed_ns=61 * NS)
    told(causes, healed, until_s=100)
    assert lasting(causes) == [], "it had its alarm"


def test_an_alarm_of_a_monitor_that_comes_later_is_part_of_it() -> None:
    causes, monitor = causes_of(), opens("battery", 30)
    told(causes, HOT, until_s=20)
    (own,) = lasting(causes)
    changes = causes.command(own[0], PersonAction("acknowledge", "anna", 21 * NS))
    assert changes is not None and changes[0].state == "acknowledged"
    assert causes.take(changes[0]).cause == "battery#hot (very likely)"
    assert told(causes, monitor, until_s=60) == []
    (shown,) = causes.named([monitor])
    assert (shown.id, shown.state, shown.who) == (own[0], "acknowledged", "anna")
    with pytest.raises(UsageError, match="is part of"):
        causes.command(monitor.id, PersonAction("acknowledge", "anna", 61 * NS))
    assert told(causes, over(HOT, 70), until_s=80)[-1] == ("battery", "open", "")
    assert lasting(causes, monitor) == [(monitor.id, "urgent")], "it lasts by itself"


def test_a_warning_raises_nothing() -> None:
    causes = causes_of()
    worn = answer(["motor#worn"], ["motor.worn"], at_ns=10 * NS)
    assert told(causes, worn, until_s=100) == []


def test_a_guess_raises_nothing() -> None:
    weak = answer(["motor#weak"], ["motor/push/pushes"], at_ns=10 * NS)
    guess = replace(weak, groups=(AmbiguityGroup(("motor#weak",), 0.4),))
    causes = causes_of()
    assert told(causes, guess, until_s=60) == []
    assert told(causes, replace(weak, revision=2, at_ns=61 * NS), until_s=70) != []
    assert told(causes, replace(guess, revision=3, at_ns=71 * NS), until_s=90) == [
        ("motor", "open", "motor#weak (possible)")
    ], "what has been raised stays"


def test_one_of_several_keeps_its_alarm_when_it_becomes_sure() -> None:
    causes = causes_of()
    one, other = (Hypothesis(name, frozenset([name]), 0.45, ("battery.warm",))
                  for name in ("battery#hot", "motor#weak"))  # fmt: skip
    group = AmbiguityGroup((one.id, other.id), 0.9)
    either = replace(HOT, hypotheses=(one, other), groups=(group,))
    assert told(causes, either, until_s=20) == [
        ("battery", "open", "battery#hot or motor#weak (very likely)")
    ]
    weak = answer(["motor#weak"], ["motor/push/pushes"], 2, 30 * NS)
    said = list(causes.process([weak], 40 * NS))
    assert [(a.component, a.state, a.reason[:12]) for a in said if isinstance(a, AlarmChange)] == [
        ("motor", "open", "diagnosed fr"),
        ("battery", "healed", "follows from"),
    ]


def test_alarms_half_a_second_apart_with_one_cause_are_one() -> None:
    causes = causes_of()
    assert told(causes, opens("laser", 9.5), until_s=9.6) == [("laser", "open", "")]
    assert told(causes, opens("log", 10), DEAD, until_s=60) == [
        ("laser", "open", "laser#dead (very likely)"),
        ("laser", "open", "laser#dead (very likely)"),
    ]
    (shown,) = causes.named([opens("laser", 9.5), opens("log", 10)])
    assert (shown.component, shown.also) == ("laser", ("log",))


def test_an_alarm_is_held_back_for_two_seconds_at_most() -> None:
    causes = causes_of()
    told(causes, opens("laser", 5))
    assert told(causes, opens("motor", 6), until_s=7.9) == []
    assert told(causes, until_s=8) == [("motor", "open", "")]


def test_one_that_opens_and_heals_meanwhile_is_said() -> None:
    causes = causes_of()
    brief = opens("motor", 6)
    healed = replace(brief, state="healed", changed_ns=7 * NS)
    found = told(causes, opens("laser", 5), brief, healed, until_s=20)
    assert [entry[:2] for entry in found] == [
        ("laser", "open"), ("motor", "open"), ("motor", "healed"),
    ]  # fmt: skip


def test_what_was_said_first_becomes_part_of_what_has_failed() -> None:
    causes = causes_of()
    log, laser = opens("log", 5), opens("laser", 9)
    found = told(causes, log, laser, DEAD, until_s=60)
    assert ("log", "healed", "laser#dead (very likely)") in found
    assert lasting(causes, log, laser) == [(laser.id, "urgent")]


def test_two_faults_are_two_alarms_each_with_its_own_cause() -> None:
    causes = causes_of()
    laser, motor = opens("laser", 9.5), opens("motor", 40)
    told(causes, laser, DEAD, until_s=30)
    both = answer(
        ["laser#dead", "motor#weak"], ["laser/alive/alive", "motor/push/pushes"], 2, 41 * NS
    )
    told(causes, motor, both, until_s=60)
    shown = {one.component: one.cause for one in causes.named([laser, motor])}
    assert shown == {
        "laser": "laser#dead (very likely)",
        "motor": "motor#weak (very likely)",
    }


def test_it_goes_on_from_a_snapshot_and_from_one_of_a_version_without_raised_alarms() -> None:
    causes = causes_of()
    told(causes, opens("laser", 5), HOT, opens("motor", 10.5), until_s=11)
    again = causes_of()
    again.resume(msgspec.json.decode(msgspec.json.encode(causes.snapshot())))
    assert told(again, until_s=60) == told(causes, until_s=60) != []
    assert [name for name, _, _ in told(causes, over(HOT, 70))] == ["battery"]
    old = {key: again.snapshot()[key] for key in ("diagnosis", "alarms", "people", "blocked")}
    older = causes_of()
    older.resume(old)
    assert older.diagnosis == HOT and "battery" in {a.component for a in older.named([])} | {
        "battery"
    }


def test_blocked_components_share_the_cause_of_what_blocks_them() -> None:
    causes = causes_of()
    bus = Status("robot", "laser", "", "error", "bad", {}, ("bus/state",), NS, NS, "", "hash")
    told(causes, bus, opens("bus", 9), DEAD, until_s=60)
    assert [(a.component, a.cause) for a in causes.named([opens("bus", 9)])] == [
        ("bus", "laser#dead (very likely)")
    ]
