"""Findings of detectors as evidence: how strong they are, what they speak for, what they prove."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.given_answers import ITEM as EVENTS
from amberbox.core.given_findings import KIND, RecordedFinding, finding_event
from amberbox.core.types import Batch, Column, Diagnosis, ItemSchema, Symptom
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.fmea.findings import proven_faults
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import FmeaReferences
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import FaultTracker

FMEA = """\
defaults: {exclusive: true}
other: {share: 0.1, probability: 2.0e-5, detects: 0.02}
types:
  motor:
    failure_modes:
      hot: {probability: 1.0e-3, symptoms: [{symptom: motor/range/cool, detects: 0.6}]}
      dead: {probability: 1.0e-3, symptoms: [motor/heartbeat/alive]}
  fan:
    failure_modes:
      stuck: {probability: 1.0e-3, symptoms: [{symptom: fan/range/turns, within_s: 60}]}
"""
MEASURED = {
    "motor/range/cool": ["motor.temperature"],
    "motor/heartbeat/alive": ["motor"],
    "fan/range/turns": ["fan.speed"],
}
FINDING = (
    "findings:\n  - {{finding: guard.range.motor.temperature, maps_to: ['motor#hot']{more}}}\n"
)


def knowledge(more: str = "", *, detected: bool = True) -> Knowledge:
    known = FmeaReferences(MEASURED, MEASURED, detected=MEASURED if detected else {})
    fmea, problems = read_fmea(FMEA + more, known)
    assert fmea is not None, problems
    return Knowledge("robot", fmea)


def told(at_s: float, finding: RecordedFinding) -> Batch:
    """Return the event that the watcher records."""
    details = finding_event(finding, "watch")["details"]
    columns = {"kind": np.array([KIND], object), "details": np.array([details], object)}
    at_ns = np.array([round(at_s * NS)])
    schema = ItemSchema("event", tuple(Column(name, name, "string") for name in columns))
    return Batch(EVENTS, schema, "watch", 1, np.array([0]), at_ns, at_ns, at_ns, columns)


def seen(at_s: float, *present: str) -> list[Symptom]:
    """Return what the monitors say."""
    at_ns = round(at_s * NS)
    return [
        Symptom(
            name, "present" if name in present else "absent", name,
            at_ns if name in present else None, at_ns,
            evidence=tuple((address, at_ns, at_ns) for address in MEASURED[name])
            if name in present else (),
        )
        for name in MEASURED
    ]  # fmt: skip


def diagnosed(
    of: Knowledge, *findings: RecordedFinding, present: tuple[str, ...] = ()
) -> Diagnosis | None:
    """Return the last diagnosis, long after findings at 10 s and the monitors' symptoms at 20 s."""
    tracker = FaultTracker(of)
    tracker.begin(0)
    tracker.advance(seen(1.0), NS)
    for finding in findings:
        tracker.feed(told(10.0, finding))
    tracker.advance(seen(20.0, *present), 21 * NS)
    tracker.advance([], 200 * NS)
    return tracker.current()


def finding(name: str, **values: Any) -> RecordedFinding:
    return RecordedFinding(name, "present", 10 * NS, **values)


UNUSUAL = finding("combined.values.motor", leak=1e-6, detects=0.5)


def test_a_detector_that_was_not_calibrated_does_not_bend_the_ranking() -> None:
    of = knowledge(FINDING.format(more=""))
    without = diagnosed(of, present=("fan/range/turns",))
    useless = finding("guard.range.motor.temperature", leak=0.5, detects=0.5)
    bent = diagnosed(of, useless, present=("fan/range/turns",))
    assert without is not None and bent is not None
    assert [(h.faults, h.probability) for h in bent.hypotheses] == [
        (h.faults, h.probability) for h in without.hypotheses
    ]
    assert diagnosed(of, useless) is None


@pytest.mark.parametrize(("leak", "least", "most"), [(0.1, 0.0, 0.02), (1e-6, 0.5, 1.0)])
def test_a_finding_is_as_strong_as_its_calibration(leak: float, least: float, most: float) -> None:
    found = finding("guard.range.motor.temperature", leak=leak, detects=0.5)
    made = diagnosed(knowledge(FINDING.format(more="")), found)
    assert made is not None
    hot = sum(h.probability for h in made.hypotheses if "motor#hot" in h.faults)
    assert least <= hot <= most


def test_the_leak_of_the_file_overrides_the_calibration() -> None:
    found = finding("guard.range.motor.temperature", leak=0.5, detects=0.5)
    made = diagnosed(knowledge(FINDING.format(more=", leak: 1.0e-7")), found)
    assert made is not None and made.hypotheses[0].faults == {"motor#hot"}


def test_what_no_failure_mode_explains_is_not_in_the_fmea() -> None:
    """The motor's messages come, so that it is not dead; but they come strangely."""
    strange = finding("combined.timing.motor", leak=1e-6, detects=0.5)
    made = diagnosed(knowledge(), strange)
    assert made is not None and made.hypotheses[0].faults == {UNKNOWN}
    assert strange.id in made.hypotheses[0].explains
    assert diagnosed(knowledge(detected=False), strange) is None
    assert diagnosed(knowledge(), finding(strange.id, leak=0.01, detects=0.5)) is None
    assert diagnosed(knowledge(), finding("combined.values.lamp", leak=1e-6, detects=0.5)) is None


def test_what_a_failure_mode_explains_is_its_evidence_once() -> None:
    hot = diagnosed(knowledge(), present=("motor/range/cool",))
    both = diagnosed(
        knowledge(),
        finding(UNUSUAL.id, leak=1e-6, detects=0.5, measured=("motor.torque",)),
        present=("motor/range/cool",),
    )
    assert hot is not None and both is not None
    assert hot.hypotheses[0].faults == both.hypotheses[0].faults == {"motor#hot"}
    assert both.hypotheses[0].probability == hot.hypotheses[0].probability
    # its messages came in time: that the motor is dead is not said by its values
    made = diagnosed(knowledge(), UNUSUAL)
    assert made is not None and not any("motor#dead" in h.faults for h in made.hypotheses[:1])


@pytest.mark.parametrize(("within_s", "counts"), [(5, True), (15, False)])
def test_what_was_unusual_before_a_fault_can_have_begun_is_another_fault(
    within_s: float, counts: bool
) -> None:
    """The motor has been strange since 10 s, and the fan shows at 20 s that it is stuck.

    What the stuck fan may have done to the motor it has done within the time in which it shows.
    """
    known = FmeaReferences(MEASURED, MEASURED, detected=MEASURED)
    fmea, problems = read_fmea(FMEA.replace("within_s: 60", f"within_s: {within_s}"), known)
    assert fmea is not None, problems
    strange = finding("combined.timing.motor", leak=1e-6, detects=0.5)
    made = diagnosed(Knowledge("robot", fmea), strange, present=("fan/range/turns",))
    assert made is not None
    expected = {"fan#stuck", UNKNOWN} if counts else {"fan#stuck"}
    assert made.hypotheses[0].faults == expected
    assert (strange.id in made.hypotheses[0].explains) is counts


def test_a_finding_that_the_file_maps_takes_the_place_of_the_combined_one() -> None:
    mapped = finding("guard.range.motor.temperature", leak=1e-6, detects=0.5)
    made = diagnosed(knowledge(FINDING.format(more="")), mapped, UNUSUAL)
    assert made is not None and made.hypotheses[0].faults == {"motor#hot"}
    assert "combined.values.motor" not in made.symptoms


def test_where_nothing_is_a_symptom_any_reader_may_have_a_fault_that_is_not_in_the_file() -> None:
    measured = {**MEASURED, "motor/load/low": ["bus.load"], "fan/load/low": ["bus.load"]}
    fmea, problems = read_fmea(FMEA, FmeaReferences(measured, measured, detected=measured))
    assert fmea is not None, problems
    of = Knowledge("robot", fmea)
    causes = {link.cause for link in of.model.links if link.symptom == "combined.timing.bus"}
    assert {cause.partition("#")[0] for cause in causes} == {"motor", "fan"}
    made = diagnosed(of, finding("combined.timing.bus", leak=1e-7, detects=0.5))
    assert made is not None and made.hypotheses[0].faults == {UNKNOWN}
    assert made.hypotheses[0].probability > 0.8


def conflicting(**values: Any) -> RecordedFinding:
    conflict = ("motor.temperature", "fan.speed")
    name = "redundant.odd_one_out.motor.temperature"
    return finding(name, leak=1e-6, detects=0.5, conflict=conflict, **values)


def test_suspects_of_a_group_are_a_conflict() -> None:
    of = knowledge()
    tracker = FaultTracker(of)
    tracker.begin(0)
    tracker.feed(told(10.0, conflicting()))
    out = list(tracker.advance([], 20 * NS))
    made = tracker.current()
    assert made is not None and "one of fan or motor" in made.symptoms
    assert all(h.faults for h in made.hypotheses if h.probability > 0.05)
    named = {fault for h in made.hypotheses for fault in h.faults}
    assert {"motor#hot", "fan#stuck"} <= named
    assert any(isinstance(one, Symptom) and one.id.startswith("one of") for one in out)
    # it ends with the finding, and begins anew with a run of the recorder; also after a restart
    again = FaultTracker(of)
    again.resume(tracker.snapshot())
    for one in (tracker, again):
        one.feed(told(30.0, RecordedFinding(conflicting().id, "absent")))
        states = [s.state for s in one.advance([], 40 * NS) if isinstance(s, Symptom)
                  and s.id.startswith("one of")]  # fmt: skip
        assert states == ["absent"]
    assert not proven_faults(of.fmea)


def test_a_conflict_is_no_more_sure_than_its_finding() -> None:
    weak = RecordedFinding(
        conflicting().id, "present", 10 * NS, leak=0.3, detects=0.5, conflict=conflicting().conflict
    )
    assert diagnosed(knowledge(), weak) is None


def test_without_detectors_the_model_is_as_before() -> None:
    of = knowledge(detected=False)
    assert not of.fmea.unusual and not of.fmea.readers
    assert not any(sign.id.startswith("combined.") for sign in of.model.signs)
