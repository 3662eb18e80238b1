"""A unit on a bus: its symptoms count unless the bus may be down."""

from __future__ import annotations

import pytest

from amberbox.diagnosis.symptom_presence import BlockingRules, SymptomPresences
from tests.diagnosis.tracker.robot import At, knowledge, seconds

KNOWLEDGE = knowledge("""\
symptoms:
  unit/process/running: {by_itself: true}
types:
  bus:
    failure_modes:
      master_crash: {probability: 0.01, symptoms: [bus/process/running]}
      slow: {probability: 0.01, takes_down: false, symptoms: [bus/cycle/on_time]}
  unit:
    needs: [bus]
    failure_modes:
      plug: {probability: 0.01, symptoms: [bus/devices/all_there]}
      trips: {probability: 0.01, symptoms: [unit/power/on, unit/process/running]}
""")
POWER = At(2, "unit/power/on", blocked_by=("bus/devices",)).symptom()


@pytest.mark.parametrize(
    ("present", "counts"),
    [
        ((), False),
        (("bus/devices/all_there",), True),
        (("bus/devices/all_there", "bus/cycle/on_time"), True),
        (("bus/process/running",), False),
        (("bus/devices/all_there", "bus/process/running"), False),
        (("hall/lamp/on",), False),
    ],
)
def test_counts_only_while_what_blocks_still_serves(present: tuple[str, ...], counts: bool) -> None:
    assert BlockingRules(KNOWLEDGE.fmea).lets_count(POWER, present) is counts


def test_counts_if_nothing_blocks_it_or_it_stands_for_itself() -> None:
    blocking = BlockingRules(KNOWLEDGE.fmea)
    assert blocking.lets_count(At(1, "unit/power/on").symptom(), ())
    assert blocking.lets_count(At(1, "unit/process/running", blocked_by=("bus",)).symptom(), ())


def test_what_is_not_in_the_analysis_blocks() -> None:
    told = At(1, "unit/power/on", blocked_by=("mains",)).symptom()
    assert not BlockingRules(KNOWLEDGE.fmea).lets_count(told, ("mains/fuse/whole",))


@pytest.mark.parametrize("bus_first", [True, False])
def test_is_judged_again_when_more_is_there(bus_first: bool) -> None:
    presences = SymptomPresences(KNOWLEDGE.fmea)
    told = [At(2, "bus/devices/all_there").symptom(), POWER]
    for one in told if bus_first else reversed(told):
        presences.take(one, seconds(2))
    assert sorted(presences.onsets(seconds(3))) == ["bus/devices/all_there", "unit/power/on"]


def test_is_judged_again_after_a_restart() -> None:
    before, after = SymptomPresences(KNOWLEDGE.fmea), SymptomPresences(KNOWLEDGE.fmea)
    before.take(POWER, seconds(2))
    after.resume(before.snapshot())
    after.take(At(4, "bus/devices/all_there").symptom(), seconds(4))
    assert "unit/power/on" in after.onsets(seconds(4))


@pytest.mark.parametrize(
    ("name", "counts"), [("unit/process/running", "absent"), ("unit/power/on", "")]
)
def test_an_absence_counts_while_blocked_only_by_itself(name: str, counts: str) -> None:
    presences = SymptomPresences(KNOWLEDGE.fmea)
    presences.take(At(2, name, "absent", blocked_by=("bus/devices",)).symptom(), seconds(2))
    assert presences.counting(seconds(3), {})[name] == counts


def test_by_itself_a_symptom_goes_while_its_component_is_blocked() -> None:
    presences, blocked_by = SymptomPresences(KNOWLEDGE.fmea), ("bus/devices",)
    presences.take(At(2, "unit/process/running", blocked_by=blocked_by).symptom(), seconds(2))
    assert "unit/process/running" in presences.onsets(seconds(2))
    gone = At(4, "unit/process/running", "absent", blocked_by=blocked_by).symptom()
    presences.take(gone, seconds(4))
    assert "unit/process/running" not in presences.onsets(seconds(5))
