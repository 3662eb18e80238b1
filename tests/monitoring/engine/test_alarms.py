"""Alarms: one for each root, counted and not repeated, and people's actions on them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.alarms import PersonAction
from amberbox.monitoring.findings import AlarmChange, Finding
from tests.monitoring.engine.stand import Stand, alarms, at_ns, component, mode, output, seconds

CHAIN = (component("loc", "laser"), component("laser"))
LASER = "laser-20260921t141322"


def brief(findings: list[Finding]) -> list[tuple[float, str, str, int]]:
    return [(seconds(a.changed_ns), a.component, a.state, a.count) for a in alarms(findings)]


def well(*components: Any) -> Stand:
    """Make a bench on which everything has been ok since second 1."""
    stand = Stand(*components)
    stand.ok(1, *(f"{place.component}/{place.mode}/{place.output.name}" for place in stand.places))
    assert alarms(stand.until(1)) == []
    return stand


def with_alarm() -> Stand:
    stand = well(*CHAIN)
    stand.bad(2, "laser", why="gone")
    stand.until(3)
    return stand


def test_an_alarm_opens_and_heals() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "laser", why="gone")
    stand.ok(4, "laser")
    opened, healed = alarms(stand.until(10))
    reason = "working is false, expected true: gone"
    assert opened == AlarmChange(
        "r1", LASER, "laser", "urgent", "open", "error", reason,
        at_ns(2), at_ns(2), 1, "", None, "hash",
    )  # fmt: skip
    assert (healed.id, healed.state, healed.changed_ns) == (LASER, "healed", at_ns(4))
    assert stand.states.alarms() == []


def test_only_the_root_opens_one() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "laser", "loc")
    assert brief(stand.until(10)) == [(2, "laser", "open", 1)]


def test_one_that_failed_first_folds_into_its_root() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "loc")
    stand.stale(7, "laser")
    found = stand.until(10)
    assert brief(found) == [(2, "loc", "open", 1), (7, "laser", "open", 1), (7, "loc", "healed", 1)]
    assert alarms(found)[2].reason == "follows from laser"


def test_what_stays_bad_when_its_root_has_healed_opens_its_own() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "laser", "loc")
    stand.ok(20, "laser")
    assert brief(stand.until(60))[1:] == [(20, "laser", "healed", 1), (25, "loc", "open", 1)]


def test_what_recovers_soon_after_its_root_opens_none() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "laser", "loc")
    stand.ok(20, "laser")
    stand.ok(24, "loc")
    stand.bad(24.5, "loc")  # a fault of its own
    assert brief(stand.until(60))[2:] == [(24.5, "loc", "open", 1)]


def test_unknown_opens_and_heals_nothing() -> None:
    stand = with_alarm()
    stand.find(4, "laser", "unknown", None, "crashed: ZeroDivisionError")
    stand.find(4, "loc", "unknown", None, "no value")
    assert alarms(stand.until(6)) == []
    assert [alarm.id for alarm in stand.states.alarms()] == [LASER]


def test_what_is_blocked_by_something_unknown_keeps_its_alarm() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "loc")
    stand.until(3)
    stand.find(4, "laser", "unknown", None, "no value")
    assert alarms(stand.until(6)) == []


def test_a_new_epoch_keeps_the_alarms() -> None:
    stand = with_alarm()
    assert alarms(stand.begin(10)) == []
    stand.bad(11, "laser")
    assert alarms(stand.until(12)) == []
    stand.ok(13, "laser")
    assert brief(stand.until(14)) == [(13, "laser", "healed", 1)]


def test_one_that_is_not_initialised_for_its_own_fault_opens_one() -> None:
    stand = Stand(*CHAIN)
    stand.bad(1, "laser", "loc")
    assert brief(stand.until(2)) == [(1, "laser", "open", 1)]


def test_it_is_counted_and_not_repeated() -> None:
    stand = with_alarm()
    stand.ok(4, "laser")
    stand.bad(64, "laser")
    stand.ok(65, "laser")
    stand.bad(126, "laser")
    found = stand.until(130)
    assert brief(found) == [
        (4, "laser", "healed", 1),
        (64, "laser", "open", 2),
        (65, "laser", "healed", 2),
        (126, "laser", "open", 1),
    ]
    assert [alarm.id for alarm in alarms(found)] == [LASER] * 3 + ["laser-20260921t141526"]


def test_flapping_is_one_alarm_that_stays() -> None:
    stand = well(*CHAIN)
    for number in range(40):
        stand.find(2 + number / 2, "laser", "ok" if number % 2 else "bad", number % 2 == 1)
    found = stand.until(200)
    assert [(a.id, a.count) for a in alarms(found)][-1] == (LASER, 4)
    assert len(alarms(found)) == 8
    assert brief(found)[-1] == (81.5, "laser", "healed", 4)


def test_the_severity_is_the_highest_and_rises() -> None:
    outputs = output("low", severity="warning"), output("empty", severity="fatal")
    stand = well(component("battery", modes=[mode("m", *outputs)]))
    stand.bad(2, "battery/m/low")
    stand.bad(3, "battery/m/empty")
    stand.ok(4, "battery/m/empty")
    stand.ok(5, "battery/m/low")
    found = alarms(stand.until(6))
    assert [(a.state, a.level, a.severity) for a in found] == [
        ("open", "warn", "warning"),
        ("open", "error", "fatal"),
        ("healed", "error", "fatal"),
    ]


def test_acknowledged() -> None:
    stand = with_alarm()
    (told,) = stand.states.command(LASER, PersonAction("acknowledge", "anna", at_ns(5)))
    assert (told.state, told.who, told.live_only, told.changed_ns) == (
        "acknowledged", "anna", True, at_ns(5),
    )  # fmt: skip
    stand.ok(6, "laser")
    stand.bad(7, "laser")  # the same alarm: it stays acknowledged
    found = alarms(stand.until(8))
    assert [(a.state, a.live_only, a.count) for a in found] == [
        ("healed", False, 1), ("open", False, 2), ("acknowledged", True, 2),
    ]  # fmt: skip
    assert [a.state for a in stand.states.alarms()] == ["acknowledged"]


def test_what_gets_worse_is_open_again() -> None:
    outputs = output("low", severity="warning"), output("empty")
    stand = well(component("battery", modes=[mode("m", *outputs)]))
    stand.bad(2, "battery/m/low")
    (opened,) = alarms(stand.until(3))
    stand.states.command(opened.id, PersonAction("acknowledge", "anna", at_ns(4)))
    stand.bad(5, "battery/m/empty")
    (worse,) = alarms(stand.until(6))
    assert (worse.state, worse.level, worse.who) == ("open", "error", "")
    assert [a.state for a in stand.states.alarms()] == ["open"]


def test_a_new_alarm_is_not_acknowledged() -> None:
    stand = with_alarm()
    stand.states.command(LASER, PersonAction("acknowledge", "anna", at_ns(3)))
    stand.ok(4, "laser")
    stand.bad(100, "laser")
    assert [a.state for a in alarms(stand.until(101))] == ["healed", "open"]


def test_shelved_until_it_expires() -> None:
    stand = with_alarm()
    (told,) = stand.states.command(LASER, PersonAction("shelve", "bo", at_ns(5), at_ns(300)))
    assert (told.state, told.who, told.until_ns) == ("shelved", "bo", at_ns(300))
    stand.ok(6, "laser")
    stand.bad(100, "laser")  # another alarm, of what is shelved
    found = alarms(stand.until(400))
    assert [(a.id == LASER, a.state, a.live_only) for a in found] == [
        (True, "healed", False),
        (False, "open", False),
        (False, "shelved", True),
        (False, "open", True),
    ]
    assert seconds(found[-1].changed_ns) == 300
    assert [a.state for a in stand.states.alarms()] == ["open"]


def test_a_shelf_that_expires_after_it_healed_says_nothing() -> None:
    stand = with_alarm()
    stand.states.command(LASER, PersonAction("shelve", "bo", at_ns(5), at_ns(10)))
    stand.ok(6, "laser")
    assert [a.state for a in alarms(stand.until(20))] == ["healed"]


def test_unshelved() -> None:
    stand = with_alarm()
    stand.states.command(LASER, PersonAction("shelve", "bo", at_ns(5), at_ns(50)))
    (told,) = stand.states.command(LASER, PersonAction("unshelve", "anna", at_ns(6)))
    assert (told.state, told.who, told.until_ns, told.live_only) == ("open", "anna", None, True)
    assert alarms(stand.until(60)) == []


@pytest.mark.parametrize(
    ("action", "alarm_id", "until_s", "what"),
    [
        ("acknowledge", "laser-2026", None, "did you mean 'laser-20260921t141322'"),
        ("shelve", LASER, None, "shelved for some time"),
        ("shelve", LASER, 3, "shelved for some time"),
        ("unshelve", LASER, None, "is not shelved"),
        ("eat", LASER, None, "'eat' is nothing"),
    ],
)
def test_what_makes_no_sense_is_refused(
    action: Any, alarm_id: str, until_s: float | None, what: str
) -> None:
    stand = with_alarm()
    until_ns = None if until_s is None else at_ns(until_s)
    with pytest.raises(UsageError, match=what):
        stand.states.command(alarm_id, PersonAction(action, "anna", at_ns(4), until_ns))
    assert [a.state for a in stand.states.alarms()] == ["open"]


def test_what_people_say_changes_nothing_that_replay_sees() -> None:
    def story(ask: bool) -> list[AlarmChange]:
        stand = with_alarm()
        if ask:
            stand.states.command(LASER, PersonAction("shelve", "bo", at_ns(5), at_ns(90)))
        stand.ok(6, "laser")
        stand.bad(70, "laser", "loc")
        found = alarms(stand.until(80))
        if ask:
            stand.states.command(found[-1].id, PersonAction("acknowledge", "anna", at_ns(81)))
        stand.ok(82, "laser")
        return [a for a in found + alarms(stand.until(200)) if not a.live_only]

    assert story(ask=True) == story(ask=False)
    assert len(story(ask=False)) == 4


def test_alarms_go_on_from_a_snapshot() -> None:
    stand = with_alarm()
    stand.states.command(LASER, PersonAction("shelve", "bo", at_ns(5), at_ns(20)))
    held = json.loads(json.dumps(stand.states.snapshot()))
    again = Stand(*CHAIN, begin=False)
    again.view = stand.view
    assert again.states.resume(held)
    assert again.states.alarms() == stand.states.alarms()
    assert again.until(30) == stand.until(30)
    assert brief(again.findings) == [(20, "laser", "open", 1)]


def test_a_component_goes_on_recovering_after_resume() -> None:
    stand = well(*CHAIN)
    stand.bad(2, "laser", "loc")
    stand.ok(20, "laser")
    stand.until(21)
    held = json.loads(json.dumps(stand.states.snapshot()))
    again = Stand(*CHAIN, begin=False)
    assert again.states.resume(held)
    assert brief(again.until(60)) == [(25, "loc", "open", 1)]


def test_it_follows_from_what_is_wrong_at_the_end_of_the_chain() -> None:
    stand = well(component("nav", "loc"), *CHAIN)
    stand.bad(2, "nav")
    stand.until(3)
    stand.begin(10)
    stand.ok(11, "loc")
    stand.bad(11, "nav")
    assert alarms(stand.until(12)) == []  # loc waits for laser, of which nothing is known
    stand.bad(13, "laser")
    found = alarms(stand.until(14))
    assert {(a.component, a.state, a.reason[:16]) for a in found} == {
        ("laser", "open", "working is false"), ("nav", "healed", "follows from loc"),
    }  # fmt: skip


def test_with_another_configuration_only_alarms_are_taken_over() -> None:
    stand = with_alarm()
    held = json.loads(json.dumps(stand.states.snapshot()))
    again = Stand(component("loc"), component("camera"), begin=False)
    assert again.states.resume({**held, "config_hash": "other"}) is False
    (gone,) = alarms(again.begin(20))
    assert (gone.id, gone.state, gone.reason) == (LASER, "healed", "no longer monitored")
    assert again.states.resume({**held, "version": 0}) is False
