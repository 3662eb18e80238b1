from __future__ import annotations

from dataclasses import replace

from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import (
    DiagnosisId,
    ObservedSituation,
    answer,
    evidence_of_situation,
)
from tests.diagnosis.tracker.robot import knowledge

KNOWLEDGE = knowledge()
MEASURED = (("motor.temperature", 5, 9),)
HOT = Symptom("motor.hot", "present", "motor.temperature", 5, 9, 1.0, "condition", MEASURED)
FOLLOWS = Symptom("base/drive/follows", "present", "base/drive/follows", 5, 9, evidence=MEASURED)


def test_conditions_and_monitors_count_side_by_side_over_the_same_measurement() -> None:
    found = evidence_of_situation(KNOWLEDGE, ObservedSituation((HOT, FOLLOWS)))
    assert set(found.observations) == {HOT.id, FOLLOWS.id} and found.doubled == ()


def test_a_detector_beside_them_counts_once() -> None:
    detected = replace(FOLLOWS, source="detector", strength=0.9)
    assert evidence_of_situation(KNOWLEDGE, ObservedSituation((HOT, detected))).doubled == (
        FOLLOWS.id,
    )


def test_a_watcher_need_not_be_asked_to_read_what_it_reads() -> None:
    by_hand = answer(KNOWLEDGE, ObservedSituation((FOLLOWS,)), DiagnosisId("d", 1, 0))
    watched = answer(KNOWLEDGE, ObservedSituation((FOLLOWS,), watched=True), DiagnosisId("d", 1, 0))
    assert any(test.id.startswith("read:") for test in by_hand.next_tests)
    assert [test.id for test in watched.next_tests] == ["shaft"]
    assert watched.hypotheses == by_hand.hypotheses
