from __future__ import annotations

from dataclasses import replace

import pytest

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import evidence_of_situation
from amberbox.diagnosis.tracker import FaultTracker
from tests.diagnosis.tracker.robot import (
    T0_NS,
    TEXT,
    At,
    begun,
    copied,
    diagnoses,
    gone,
    knowledge,
    leading,
    rows,
    run,
    seconds,
)

ALIVE, CLEAR, POWER = "laser/heartbeat/alive", "laser/scan/clear", "laser/power/on"
TURNS, FOLLOWS, DONE = "motor/encoder/turns", "base/drive/follows", "tasks/log/done"
WELL = [gone(0.1, name) for name in (ALIVE, CLEAR, POWER, TURNS, FOLLOWS, DONE)]


def states(tracker: FaultTracker) -> dict[str, str]:
    """Return what counts, as evidence has it."""
    found = evidence_of_situation(tracker.knowledge, tracker.situation())
    return {name: one.state for name, one in found.observations.items()}


def test_nothing_present_is_no_diagnosis() -> None:
    tracker = begun()
    assert run(tracker, WELL, 100) == []
    assert tracker.current() is None
    assert states(tracker) == dict.fromkeys((ALIVE, CLEAR, POWER, TURNS, FOLLOWS, DONE), "absent")


def test_opens_at_once_with_the_first_symptom_and_keeps_its_id() -> None:
    tracker = begun()
    found = diagnoses(run(tracker, [*WELL, At(20.05, CLEAR), At(21.2, ALIVE)], 21.5))
    assert [(one.at_ns, one.revision) for one in found] == [(seconds(20.05), 1), (seconds(21.5), 2)]
    assert {one.id for one in found} == {"robot_1-20260921t141340"}
    assert [leading(one) for one in found] == ["laser#dirty", "laser#dead"]
    assert found[1].symptoms == (CLEAR, ALIVE) and found[1].state == "open"
    assert (found[1].robot, found[1].config_hash) == ("robot_1", "c0ffee")
    assert tracker.current() == found[1]


def test_unknown_outputs_and_those_never_told_are_no_evidence() -> None:
    tracker = begun()
    run(tracker, [At(1, CLEAR), At(1, ALIVE, "unknown")], 60)
    assert states(tracker) == {CLEAR: "present"}


def test_a_blocked_symptom_is_no_evidence_unless_what_blocks_may_show_it() -> None:
    tracker = begun()
    assert diagnoses(run(tracker, [*WELL, At(5, CLEAR, blocked_by=("bus",))], 30)) == []
    tracker = begun()
    found = run(tracker, [*WELL, At(5, FOLLOWS, blocked_by=("motor",))], 30)
    assert next(iter(diagnoses(found))).at_ns == seconds(5)
    assert states(tracker)[FOLLOWS] == "present"


def test_the_absence_of_a_blocked_symptom_is_no_evidence() -> None:
    tracker = begun()
    run(tracker, [At(1, ALIVE, "absent", ("bus",)), At(5, CLEAR)], 60)
    assert ALIVE not in states(tracker)


def test_absence_counts_only_after_the_time_a_cause_may_take() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR)], 23.9)
    assert states(tracker) == {CLEAR: "present", TURNS: "absent", FOLLOWS: "absent"}
    run(tracker, [], 24)
    assert states(tracker)[POWER] == "absent" and ALIVE not in states(tracker)
    run(tracker, [], 30)
    assert states(tracker)[ALIVE] == "absent" and DONE not in states(tracker)
    run(tracker, [], 50)
    assert states(tracker)[DONE] == "absent", "the loss of what the laser serves has 30 s"


def test_absence_makes_a_revision_when_it_begins_to_count() -> None:
    tracker = begun()
    found = diagnoses(run(tracker, [*WELL, At(20.1, CLEAR)], 40))
    assert [one.at_ns for one in found] == [seconds(at) for at in (20.1, 24.5, 30.5)]
    dead = [sum(h.probability for h in one.hypotheses if "laser#dead" in h.id) for one in found]
    assert dead[0] > 0.3 > 0.1 > dead[1] > 0.01 > dead[2]


def test_the_onset_begins_the_wait_not_the_finding() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR, onset_s=17)], 21)
    assert states(tracker)[POWER] == "absent"


def test_missing_symptoms_of_a_second_fault_are_not_held_against_it_while_it_is_young() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, FOLLOWS)], 60)
    assert leading(tracker.current()) == "motor#weak"
    assert states(tracker)[ALIVE] == "absent" and states(tracker)[CLEAR] == "absent"
    run(tracker, [At(60.1, ALIVE)], 61)
    assert leading(tracker.current()) == "laser#dead + motor#weak"
    assert CLEAR not in states(tracker), "it has 10 s"
    run(tracker, [At(66, CLEAR), At(67, POWER)], 80)
    assert leading(tracker.current()) == "laser#dead + motor#weak"


def test_a_shared_symptom_of_the_first_fault_does_not_age_the_second() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, FOLLOWS)], 100)
    assert states(tracker)[TURNS] == "absent", "stuck would have turned up by now"
    run(tracker, [At(100.1, CLEAR), At(101.1, TURNS)], 102)
    assert states(tracker)[TURNS] == "present"
    tracker.feed(rows("motor", [102.2, 103], temperature=[20.0, 20.0]))
    run(tracker, [], 103)
    assert "motor.hot" not in states(tracker), "stuck may have begun at 101.1 only"
    tracker.feed(rows("motor", [103 + 0.5 * i for i in range(1, 8)], temperature=[20.0] * 7))
    run(tracker, [], 106.5)
    assert states(tracker)["motor.hot"] == "absent"


def test_a_symptom_that_comes_and_goes_within_its_hold_is_one() -> None:
    comes = [At(20 + 2 * i, CLEAR) for i in range(5)]
    goes = [gone(21 + 2 * i, CLEAR) for i in range(5)]
    flapping, steady = begun(), begun()
    out = diagnoses(run(flapping, [*WELL, *comes, *goes], 30))
    assert out == diagnoses(run(steady, [*WELL, At(20, CLEAR)], 30))
    assert [one.state for one in diagnoses(run(flapping, [], 31))] == ["healed"]


def test_heals_when_all_are_absent_and_the_hold_is_over() -> None:
    tracker = begun()
    happens = [*WELL, At(20, CLEAR), At(21, ALIVE), gone(25, CLEAR), gone(25.1, ALIVE)]
    found = diagnoses(run(tracker, happens, 27))
    assert [one.state for one in found] == ["open"] * len(found)
    last = diagnoses(run(tracker, [], 60))
    assert last == [
        replace(found[-1], revision=found[-1].revision + 1, at_ns=seconds(27.5), state="healed")
    ]
    assert leading(last[0]) == "laser#dead" and tracker.current() is None


def test_what_goes_is_not_held_against_the_answer_at_once() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR), At(20, ALIVE), At(20, POWER)], 50)
    before = tracker.current()
    run(tracker, [gone(60, ALIVE)], 71.9)
    assert tracker.current() == before and ALIVE not in states(tracker)
    run(tracker, [], 72)
    assert states(tracker)[ALIVE] == "absent", "2 s of hold and 10 s to go"
    assert tracker.current() != before


def test_a_new_diagnosis_has_a_new_id_even_in_the_same_second() -> None:
    tracker = begun(TEXT.replace("hold_s: 2", "hold_s: 0"))
    comes, goes = [At(20, CLEAR), At(20.6, CLEAR)], [gone(20.2, CLEAR), gone(20.7, CLEAR)]
    found = diagnoses(run(tracker, [*WELL, *comes, *goes, At(21.1, CLEAR)], 30))
    opened = [one.id.removeprefix("robot_1-20260921t1413") for one in found if one.revision == 1]
    assert opened == ["40", "40a", "41"]


def test_two_diagnoses_never_overlap() -> None:
    tracker = begun(TEXT.replace("hold_s: 2", "hold_s: 0"))
    happens = [At(20, CLEAR), gone(20.1, CLEAR), At(20.4, ALIVE), gone(25, ALIVE)]
    found = diagnoses(run(tracker, [*WELL, *happens], 30))
    assert len({one.id for one in found}) == 1 and found[-1].state == "healed"


def test_a_symptom_that_the_analysis_does_not_have_opens_nothing() -> None:
    tracker = begun()
    assert run(tracker, [*WELL, At(3, "lamp/light/on")], 30) == []
    found = diagnoses(run(tracker, [At(40, CLEAR)], 40.4))
    assert found[0].findings == ("lamp/light/on",)
    run(tracker, [gone(41, "lamp/light/on"), gone(41, CLEAR)], 50)
    assert tracker.current() is None


def test_an_epoch_forgets_what_was_known_but_not_the_diagnosis() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR), At(20, ALIVE)], 30)
    before = tracker.current()
    tracker.begin(seconds(-50))  # the clock of the new run is behind
    assert tracker.current() == before and states(tracker) == {}
    lost = [At(-50, name, "unknown") for name in (ALIVE, CLEAR)]
    assert run(tracker, lost, -40) == [] and tracker.current() == before
    assert run(tracker, [gone(-39, CLEAR)], -30) == []
    found = diagnoses(run(tracker, [gone(-29.8, ALIVE)], -20))
    assert before is not None
    assert found == [
        replace(before, revision=before.revision + 1, at_ns=seconds(-29.5), state="healed")
    ]


def test_an_epoch_in_which_a_symptom_is_seen_again_goes_on_with_the_diagnosis() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR), At(20, ALIVE)], 30)
    before = tracker.current()
    tracker.begin(seconds(100))
    found = diagnoses(run(tracker, [At(101, CLEAR), gone(101, ALIVE)], 130))
    assert before is not None and before.id == found[0].id
    assert found[0].revision == before.revision + 1
    assert [leading(one) for one in found][-1] == "laser#dirty"


def test_an_hour_without_any_symptom_ends_a_diagnosis_that_nothing_denies() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR), At(40, CLEAR, "unknown")], 4241.5)
    assert tracker.current() is not None
    found = diagnoses(run(tracker, [], 4300))
    assert [(one.at_ns, one.state) for one in found] == [(seconds(4242), "healed")]
    assert tracker.current() is None


def test_an_hour_counts_anew_in_a_new_epoch() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, CLEAR), At(40, CLEAR, "unknown")], 3000)
    tracker.begin(seconds(5000))
    assert run(tracker, [], 8599.9) == []
    found = diagnoses(run(tracker, [], 8700))
    assert [(one.at_ns, one.state) for one in found] == [(seconds(8600), "healed")]


def test_readings_that_the_watcher_makes_itself_are_no_tests() -> None:
    tracker = begun()
    run(tracker, [At(20, FOLLOWS)], 21)
    current = tracker.current()
    assert current is not None and [one.id for one in current.next_tests] == ["shaft"]


def test_conditions_of_the_analysis_are_symptoms_too() -> None:
    tracker = begun()
    assert tracker.items == {"motor", "amberbox_event"} and tracker.history_s == 6.0
    times = [0.1 * i for i in range(1, 100)]
    tracker.feed(rows("motor", times, temperature=[20.0 if at < 5 else 80.0 for at in times]))
    found = run(tracker, WELL, 9)
    assert [(one.state, one.confirmed_ns, one.source) for one in found
            if isinstance(one, Symptom)] == [
        ("absent", seconds(0.25), "condition"), ("present", seconds(5), "condition"),
    ]  # fmt: skip
    assert [type(one).__name__ for one in found[:3]] == ["Symptom", "Symptom", "Diagnosis"]
    assert leading(tracker.current()) == "motor#stuck"


def test_goes_on_from_a_snapshot() -> None:
    tracker = begun()
    happens = [At(20, CLEAR), At(21, ALIVE), gone(22, CLEAR)]
    run(tracker, [*WELL, *happens], 22.3)
    other = copied(tracker)
    assert other.current() == tracker.current() and other.situation() == tracker.situation()
    later = [gone(24, ALIVE)]
    assert run(other, later, 60) == run(tracker, later, 60) != []


def test_refuses_a_snapshot_of_another_folder() -> None:
    snapshot = begun().snapshot()
    other = FaultTracker(replace(knowledge(), config_hash="decaf"))
    with pytest.raises(UsageError, match="another version or folder"):
        other.resume(snapshot)


def test_looks_at_nothing_when_all_is_well() -> None:
    tracker = begun()
    run(tracker, WELL, 1)
    assert tracker.advance([], T0_NS + 86_400 * NS) == []


def test_a_repaired_cause_leaves_an_answer_whose_other_cause_stays() -> None:
    tracker = begun()
    run(tracker, [*WELL, At(20, FOLLOWS), At(21, CLEAR), At(21, ALIVE), At(21, POWER)], 60)
    assert leading(tracker.current()) == "laser#dead + motor#weak"
    out = diagnoses(run(tracker, [gone(60.2, name) for name in (CLEAR, ALIVE, POWER)], 62.2))
    assert [leading(one) for one in out] == [], "2 s of hold"
    out = diagnoses(run(tracker, [], 64))
    assert [(leading(one), one.at_ns, one.state) for one in out] == [
        ("motor#weak", seconds(62.5), "open")
    ]
    assert not any("laser#dead" in one.faults for one in out[0].hypotheses[:1])


DEAD = [At(20, CLEAR), At(20, ALIVE), At(20, POWER)]
LONG = TEXT.replace(
    "laser/scan/clear, {symptom", "{symptom: laser/scan/clear, hold_s: 300}, {symptom"
)


def test_what_goes_accuses_no_other_cause() -> None:
    tracker = begun()
    run(tracker, [*WELL, *DEAD], 50)
    assert leading(tracker.current()) == "laser#dead"
    out = diagnoses(run(tracker, [gone(60, ALIVE), gone(60, POWER), gone(65, CLEAR)], 66.5))
    assert [leading(one) for one in out] == [], "with nothing but that it would be dirt"
    assert states(tracker)[POWER] == "absent"
    assert [one.state for one in diagnoses(run(tracker, [], 75))] == ["healed"]


def test_what_is_remembered_long_goes_with_all_else_that_its_cause_has_shown() -> None:
    tracker = begun(LONG)
    run(tracker, [*WELL, *DEAD], 50)
    out = diagnoses(run(tracker, [gone(60, ALIVE), gone(60, POWER), gone(63, CLEAR)], 120))
    assert [(one.state, one.at_ns) for one in out] == [("healed", seconds(65))]
    run(tracker, [At(200, CLEAR), gone(210, CLEAR)], 400)
    assert tracker.current() is not None, "alone it is remembered for its 300 s"
    assert [one.state for one in diagnoses(run(tracker, [], 520))] == ["healed"]


def test_what_nobody_can_look_at_keeps_its_cause() -> None:
    tracker = begun(LONG)
    run(tracker, [*WELL, *DEAD], 50)
    run(tracker, [gone(60, ALIVE), gone(60, POWER), At(63, CLEAR, "unknown")], 300)
    assert leading(tracker.current()) == "laser#dead"
