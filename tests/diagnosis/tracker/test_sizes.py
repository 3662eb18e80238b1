"""How large symptoms are, as the record grows: the same live and afterwards."""

from __future__ import annotations

from dataclasses import replace

import pytest

from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.tracker import FaultTracker
from tests.diagnosis.tracker.robot import At, begun, copied, diagnoses, gone, leading, rows, seconds

COOL = "battery/temperature/cool"
TEXT = """\
defaults: {detects: 0.95, within_s: 1, hold_s: 1}
symptoms:
  battery/temperature/cool: {measure: battery.temp - 45, edges: [2, 10, 40], settle_s: 2}
types:
  battery:
    failure_modes:
      hot:
        probability: 0.01
        symptoms: [{symptom: battery/temperature/cool, size: {uniform: [0, 20]}}]
      fahrenheit:
        probability: 0.0001
        symptoms: [{symptom: battery/temperature/cool, size: {normal: [60, 10]}}]
other: {probability: 1.0e-6}
"""


def fed(temperatures: list[float], text: str = TEXT) -> FaultTracker:
    """Return a tracker with four temperatures a second from second 0 on."""
    tracker = begun(text)
    tracker.feed(rows("battery", [i / 4 for i in range(len(temperatures))], temp=temperatures))
    return tracker


def advance(
    tracker: FaultTracker, happens: list[At], until_s: float, step_s: float
) -> list[Symptom | Diagnosis]:
    """Advance in steps; each brings what has happened by then."""
    out: list[Symptom | Diagnosis] = []
    for number in range(1, round(until_s / step_s) + 1):
        end_s = number * step_s
        new = [at for at in happens if end_s - step_s < at.at_s <= end_s]
        out += tracker.advance([at.symptom() for at in new], seconds(end_s))
    return out


@pytest.mark.parametrize(
    ("temperature", "cause"), [(50.0, "battery#hot"), (104.0, "battery#fahrenheit")]
)
def test_the_size_tells_the_causes_apart(temperature: float, cause: str) -> None:
    tracker = fed([20.0] * 8 + [temperature] * 32)
    happens = [gone(1.0, COOL), At(2.1, COOL)]
    out = advance(tracker, happens, 8, 0.5)
    first, last = diagnoses(out)[0], diagnoses(out)[-1]
    assert leading(first) == "battery#hot", "the bit counts at once, and the prior decides"
    assert leading(last) == cause and last.hypotheses[0].probability > 0.8
    assert last.hypotheses[0].explains == (COOL,)


def test_the_largest_size_until_it_settles_counts() -> None:
    tracker = fed(
        [20.0] * 8 + [46.0, 47.0, 49.0, 58.0, 49.0, 46.0, 46.0, 46.0, 46.0] + [104.0] * 20
    )
    out = advance(tracker, [At(2.0, COOL)], 8, 0.25)
    sizes = [one.size for one in out if isinstance(one, Symptom)]
    assert sizes == [1.0, 2.0, 13.0], "reported when they reach another level"
    (shown,) = tracker.situation().present()
    assert shown.size == 13.0 and shown.onset_ns == seconds(2)


@pytest.mark.parametrize("step_s", [0.05, 0.25, 1.0, 8.0])
def test_boundaries_and_a_restart_change_nothing(step_s: float) -> None:
    temperatures = [20.0] * 8 + [46.0, 47.0, 49.0, 58.0, 49.0] + [46.0] * 20
    happens = [At(2.1, COOL), gone(5.2, COOL), At(6.6, COOL)]
    expected = advance(fed(temperatures), happens, 8, 0.1)
    assert advance(fed(temperatures), happens, 8, step_s) == expected
    tracker = fed(temperatures)
    out = advance(tracker, happens, 3, 0.1)
    later = copied(tracker)
    later.feed(rows("battery", [i / 4 for i in range(len(temperatures))], temp=temperatures))
    new = [at.symptom() for at in happens if at.at_s > 3]
    assert [*out, *later.advance(new, seconds(8))] == expected


def test_a_size_that_is_not_known_leaves_the_bit() -> None:
    tracker = fed([20.0] * 8 + [float("nan")] * 24)
    out = advance(tracker, [At(2.1, COOL)], 6, 0.5)
    assert leading(diagnoses(out)[-1]) == "battery#hot"
    assert all(one.size is None for one in out if isinstance(one, Symptom))


def test_a_size_that_no_mode_shows_is_something_else() -> None:
    tracker = fed([20.0] * 8 + [-40.0] * 24)
    last = diagnoses(advance(tracker, [At(2.1, COOL)], 6, 0.5))[-1]
    assert "battery#hot" not in {fault for h in last.hypotheses[:1] for fault in h.faults}
    assert not any(fault == "battery#hot" for h in last.hypotheses for fault in h.faults)


FOLLOWS = """\
defaults: {detects: 0.95, within_s: 1, hold_s: 60}
types:
  battery:
    failure_modes:
      empty:
        probability: 0.001
        symptoms: [battery/voltage/high]
        leads_to: {computer#off: {p: 0.5, after_s: [5, 60]}}
  computer:
    failure_modes:
      off: {probability: 0.0001, symptoms: [computer/process/runs]}
      slow: {probability: 0.0002, takes_down: false, symptoms: [computer/process/runs]}
other: {probability: 1.0e-9}
"""


def test_what_follows_is_no_further_fault() -> None:
    tracker = begun(FOLLOWS)
    happens = [At(2, "battery/voltage/high"), At(12, "computer/process/runs")]
    last = diagnoses(advance(tracker, happens, 16, 0.5))[-1]
    assert leading(last) == "battery#empty + computer#off"
    assert last.hypotheses[0].follows == {"computer#off"}
    alone = FOLLOWS.replace("leads_to: {computer#off: {p: 0.5, after_s: [5, 60]}}", "")
    last = diagnoses(advance(begun(alone), happens, 16, 0.5))[-1]
    assert leading(last) == "battery#empty + computer#slow"


def test_modes_of_a_component_exclude_each_other() -> None:
    text = """\
defaults: {exclusive: EXCLUSIVE, leak: 0.001}
types:
  plug:
    failure_modes:
      off: {probability: 0.01, symptoms: [plug/power/on, plug/light/on]}
      loose: {probability: 0.01, symptoms: [plug/contact/steady, plug/power/on]}
"""
    happens = [At(2, one) for one in ("plug/power/on", "plug/light/on", "plug/contact/steady")]
    both = "plug#loose + plug#off"
    for exclusive, expected in (("false", True), ("true", False)):
        tracker = begun(text.replace("EXCLUSIVE", exclusive))
        last = diagnoses(advance(tracker, happens, 4, 0.5))[-1]
        assert (both in {h.id for h in last.hypotheses}) is expected
    tied = text.replace("EXCLUSIVE", "true").replace("loose: {", "loose: {with: [off], ")
    last = diagnoses(advance(begun(tied), happens, 4, 0.5))[-1]
    assert leading(last) == both


def test_a_symptom_before_its_cause_is_no_evidence_for_it() -> None:
    text = """\
defaults: {leak: 0.001}
types:
  a:
    failure_modes:
      x: {probability: 0.01, symptoms: [a/m/first, {symptom: a/m/later, after_s: [5, 20]}]}
  b: {failure_modes: {y: {probability: 0.005, symptoms: [a/m/first, a/m/later]}}}
"""
    timed = text.replace("[a/m/first, {", "[{symptom: a/m/first, after_s: [0, 1]}, {")
    for later_s, cause in ((12.0, "a#x"), (2.1, "b#y")):
        happens = [At(2, "a/m/first"), At(later_s, "a/m/later")]
        last = diagnoses(advance(begun(timed), happens, 16, 0.5))[-1]
        assert leading(last) == cause


def test_strength_and_blocking_do_not_lose_the_size() -> None:
    tracker = fed([20.0] * 8 + [104.0] * 32)
    advance(tracker, [At(2.1, COOL)], 6, 0.5)
    again = replace(At(6.1, COOL, onset_s=2.1).symptom(), reason="once more")
    tracker.advance([again], seconds(8))
    (shown,) = tracker.situation().present()
    assert shown.size == 59.0
