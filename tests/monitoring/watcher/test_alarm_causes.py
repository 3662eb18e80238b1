"""The alarms that a diagnosis concerns, and their causes over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.alarm_causes import AlarmCauses
from amberbox.monitoring.findings import AlarmChange, Finding
from tests.monitoring.watcher.diagnoser import answer

WORDS = "laser#dead (very likely)"


def alarm(component: str = "laser", **more: object) -> AlarmChange:
    plain = AlarmChange(
        "robot", f"{component}-1", component, "urgent", "open", "error", "it is dead", NS, NS, 1,
        "", None, "hash",
    )  # fmt: skip
    return replace(plain, **more)  # type: ignore[arg-type]  # its fields


def status(component: str, *blocked_by: str) -> Status:
    return Status("robot", component, "", "error", "bad", {}, blocked_by, NS, NS, "", "hash")


def through(causes: AlarmCauses, *findings: Finding) -> list[tuple[str, str, int]]:
    """Return component, cause and time of the resulting alarms."""
    found = causes.process(findings)
    return [(f.component, f.cause, f.changed_ns) for f in found if isinstance(f, AlarmChange)]


DEAD = answer(["laser#dead"], ["laser/heartbeat/alive"], at_ns=2 * NS)


@pytest.mark.parametrize(
    ("component", "explains"),
    [("laser", []), ("scan", ["scan/rate/fine"]), ("motor", ["motor.hot"]), ("hub", ["hub#x.0"])],
)
def test_failed_components_and_those_with_symptoms_are_concerned(
    component: str, explains: Sequence[str]
) -> None:
    told = answer(["laser#dead"], explains, at_ns=2 * NS)
    assert through(AlarmCauses(), alarm(component), told) == [
        (component, "", NS),
        (component, WORDS, 2 * NS),
    ]
    assert through(AlarmCauses(), alarm("wifi"), told) == [("wifi", "", NS)]


def test_what_blocks_a_component_with_symptoms_is_concerned() -> None:
    told = answer(["cable#loose"], ["scan/rate/fine"], at_ns=2 * NS)
    blocked = status("scan", "bus/state", "host")
    found = through(AlarmCauses(), alarm("bus"), alarm("host"), blocked, told)
    assert [name for name, cause, _ in found if cause] == ["bus", "host"]
    assert through(AlarmCauses(), alarm("bus"), blocked, status("scan"), told) == [("bus", "", NS)]


def test_a_later_change_carries_the_cause_on_and_healing_ends_it() -> None:
    causes = AlarmCauses()
    through(causes, alarm(), DEAD)
    assert through(causes, alarm(severity="fatal", changed_ns=3 * NS)) == [("laser", WORDS, 3 * NS)]
    assert through(causes, replace(DEAD, revision=2, mass_covered=0.5)) == []
    over = replace(DEAD, state="healed", at_ns=4 * NS)
    assert through(causes, over) == [("laser", "", 4 * NS)]
    assert causes.diagnosis is None
    assert through(causes, alarm("laser", state="healed", changed_ns=5 * NS)) == [
        ("laser", "", 5 * NS)
    ]
    assert through(causes, DEAD) == [], "an alarm that has healed is not said again"


def test_another_leading_answer_that_does_not_concern_it_takes_the_cause_away() -> None:
    causes = AlarmCauses()
    through(causes, alarm(), DEAD)
    other = answer(["wifi#weak"], ["wifi/link/strong"], 2, 3 * NS)
    assert through(causes, other) == [("laser", "", 3 * NS)]


def test_what_people_said_is_said_again_after_the_cause() -> None:
    causes = AlarmCauses()
    said = alarm(state="acknowledged", who="anna", live_only=True)
    through(causes, alarm())
    causes.take(said)
    found = [f for f in causes.process([DEAD]) if isinstance(f, AlarmChange)]
    assert [(f.state, f.who, f.live_only, f.cause) for f in found] == [
        ("open", "", False, WORDS),
        ("acknowledged", "anna", True, WORDS),
    ]
    causes.take(alarm(live_only=True, who="anna"))
    assert len(list(causes.process([replace(DEAD, state="healed")]))) == 2


def test_alarms_of_before_are_known_too() -> None:
    causes = AlarmCauses()
    causes.adopt([alarm(state="shelved", until_ns=9 * NS, who="bo", live_only=True)])
    found = [f for f in causes.process([DEAD]) if isinstance(f, AlarmChange)]
    assert [(f.state, f.until_ns, f.live_only) for f in found] == [
        ("open", None, False),
        ("shelved", 9 * NS, True),
    ]


def test_it_goes_on_from_a_snapshot() -> None:
    causes, again = AlarmCauses(), AlarmCauses()
    through(causes, alarm(), alarm("bus"), status("scan", "bus"), DEAD)
    causes.take(alarm(state="acknowledged", who="anna", live_only=True))
    again.resume(causes.snapshot())
    assert again == causes
    last: Diagnosis = answer(["bus#cut"], ["scan/rate/fine"], 2, 3 * NS)
    assert through(again, last) == through(causes, last) != []
    standing = again.named([alarm("bus"), alarm()])
    assert [(a.cause, a.changed_ns) for a in standing] == [
        ("bus#cut (very likely)", 3 * NS), ("", 3 * NS),
    ]  # fmt: skip
