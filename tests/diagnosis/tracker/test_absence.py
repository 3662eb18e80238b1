from __future__ import annotations

from amberbox.core.clock import NS
from amberbox.diagnosis.symptom_presence import AbsenceTimes
from tests.diagnosis.tracker.robot import knowledge

TEXT = """\
defaults: {within_s: 10}
types:
  bus:
    failure_modes:
      off: {probability: 0.01, symptoms: [bus/frames/back]}
      slow:
        probability: 0.01
        takes_down: false
        symptoms: [{symptom: bus/frames/back, within_s: 3}]
  left: {needs: [bus], failure_modes: {off: {probability: 0.01, symptoms: [left/power/on]}}}
  right: {needs: [bus], failure_modes: {off: {probability: 0.01, symptoms: [right/power/on]}}}
  lamp: {failure_modes: {off: {probability: 0.01, symptoms: [lamp/light/on]}}}
functions:
  drive: {needs: {any: [left, right]}, symptoms: [{symptom: base/drive/follows, within_s: 20}]}
  carry: {needs: [drive], symptoms: [{symptom: tasks/log/done, within_s: 90}]}
"""


SHARED = TEXT.replace(
    "  lamp: {failure_modes:",
    """\
  lamp:
    symptoms:
      odd: {when: lamp.current > 1, within_s: 4}
    failure_modes:
      dim: {probability: 0.01, symptoms: [{symptom: lamp/light/bright, within_s: 30}]}
      off: {probability: 0.01, symptoms: [lamp/light/on]}
  torch: {failure_modes:""",
)
"""With a share of faults that are not in the file, which alone show that the lamp is odd."""


def waits(text: str = TEXT, **onsets_s: float) -> dict[str, float]:
    """Return until when is waited, in seconds; names with ``_`` for ``/``."""
    onsets_ns = {name.replace("_", "/"): round(at * NS) for name, at in onsets_s.items()}
    found = AbsenceTimes(knowledge(text).fmea).until_ns(onsets_ns)
    return {name: at_ns / NS for name, at_ns in found.items()}


def test_nothing_is_waited_for_when_nothing_is_present() -> None:
    assert waits() == {}


def test_each_link_has_its_own_time() -> None:
    assert waits(lamp_light_on=100) == {"lamp/light/on": 110}
    assert waits(bus_frames_back=100)["bus/frames/back"] == 110, "the slowest of its causes"


def test_a_mode_shows_what_its_component_can_take_with_it() -> None:
    expected = {"left/power/on": 110, "base/drive/follows": 120, "tasks/log/done": 190}
    assert waits(left_power_on=100) == expected
    both = {"bus/frames/back": 110, "base/drive/follows": 120, "tasks/log/done": 190}
    assert waits(bus_frames_back=100) == both


def test_a_lost_function_is_a_cause() -> None:
    assert waits(base_drive_follows=50)["tasks/log/done"] == 140
    assert "lamp/light/on" not in waits(base_drive_follows=50)


def test_the_newest_symptom_of_a_cause_counts() -> None:
    assert waits(left_power_on=100, base_drive_follows=130)["tasks/log/done"] == 220
    assert waits(left_power_on=100, lamp_light_on=130)["tasks/log/done"] == 190


def test_symptoms_that_nothing_causes_make_nobody_wait() -> None:
    assert waits(nobody_knows_this=7) == {}


def test_a_fault_that_is_not_in_the_file_has_its_time_too() -> None:
    assert waits(SHARED, lamp_light_on=100) == {"lamp/light/on": 110}, "the file has no share"
    shared = f"other: {{share: 0.2}}\n{SHARED}"
    expected = {"lamp/light/on": 110, "lamp/light/bright": 130, "lamp.odd": 104}
    assert waits(shared, lamp_light_on=100) == expected
    assert "lamp/light/bright" not in waits(shared, bus_frames_back=100)
    assert set(AbsenceTimes(knowledge(shared).fmea).shows) == set(
        AbsenceTimes(knowledge(SHARED).fmea).shows
    )
