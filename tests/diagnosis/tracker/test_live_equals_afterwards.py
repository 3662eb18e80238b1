"""All kinds of evidence, live in pieces with restarts, and afterwards in one go: one answer."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.contracts import NOTHING_GIVEN, Conflict, EvidenceNeeds, GivenEvidence
from amberbox.core.given_answers import RecordedAnswer, answer_event
from amberbox.core.given_findings import RecordedFinding, finding_event
from amberbox.core.types import Batch, Column, Diagnosis, ItemSchema, Symptom, SymptomState
from amberbox.diagnosis import diagnose
from amberbox.diagnosis.diagnose import DiagnosisContext
from amberbox.diagnosis.evidence import rules
from amberbox.diagnosis.tracker import FaultTracker
from tests.diagnosis.tracker.robot import (
    T0_NS,
    TEXT,
    At,
    diagnoses,
    gone,
    knowledge,
    leading,
    rows,
    seconds,
)

FINDINGS = """\
findings:
  - {rule: jammed(X), maps_to: [<X>#stuck], detects: 0.8, leak: 0.001}
  - {rule: quiet(X), maps_to: [<X>#dirty], detects: 0.5, leak: 0.01}
  - {rule: broken(X), maps_to: [<X>#dead], proves: true}
  - {rule: idle(X), description: does nothing}
  - {finding: state_flow.unlikely.tasks, maps_to: [laser#dead], detects: 0.7}
  - {finding: groups.odd_one_out.wheels, maps_to: [motor#stuck, motor#weak], proves: true}
"""
RULES = """\
jammed(motor) :- present('motor/encoder/turns'), absent('laser/heartbeat/alive').
quiet(laser) :- absent('base/drive/follows').
broken(laser) :- present('laser/heartbeat/alive'), present('laser/scan/clear').
idle(motor) :- unknown('motor/encoder/turns').
"""
KNOWLEDGE = knowledge(
    TEXT.replace("hold_s: 2", "hold_s: 1").replace("within_s: 10", "within_s: 3") + FINDINGS
)
FLOW, ODD = "state_flow.unlikely.tasks", "groups.odd_one_out.wheels"
TURNS, ALIVE, CLEAR = "motor/encoder/turns", "laser/heartbeat/alive", "laser/scan/clear"
JAMMED, BROKEN, QUIET = "rule:jammed(motor)", "rule:broken(laser)", "rule:quiet(laser)"


@dataclass(frozen=True)
class Window:
    """The folder with the rules, without a record."""

    context: DiagnosisContext
    folder: Path
    given: GivenEvidence = NOTHING_GIVEN

    @property
    def at_ns(self) -> int:
        return self.context.at_ns

    @property
    def symptoms(self) -> Sequence[Symptom]:
        return self.context.situation.symptoms

    def past(self, needs: EvidenceNeeds) -> None:
        return None

    def lookups(self, needs: EvidenceNeeds) -> tuple[()]:
        return ()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("robot")
    (place / "rules").mkdir()
    (place / "rules" / "all.pl").write_text(RULES)
    return place


def tracker_of(folder: Path) -> FaultTracker:
    """Return a tracker whose epoch begins at second 0."""
    made = FaultTracker(KNOWLEDGE, lambda case: Window(case, folder))
    made.begin(T0_NS)
    return made


def events(*told: tuple[float, RecordedAnswer | RecordedFinding]) -> Batch:
    """Return what the watcher has written of people and detectors."""
    named = ("kind", "text", "source", "details")
    values = [
        answer_event(what, "watch")
        if isinstance(what, RecordedAnswer)
        else finding_event(what, "watch")
        for _, what in told
    ]
    times = np.array([seconds(at_s) for at_s, _ in told], np.int64)
    held = {name: np.array([one[name] for one in values], object) for name in named}
    schema = ItemSchema("amberbox_event", tuple(Column(n, n, "string") for n in named))
    seq = np.arange(len(told), dtype=np.int64)
    return Batch("amberbox_event", schema, "watch", 1, seq, times, times, times, held)


def logged(at_s: float, **values: Any) -> Batch:
    """Return a finding as a program logs it: one row."""
    made = rows("event_finding", [at_s], **{name: [0.0] for name in values})
    held = {name: np.array([value], object) for name, value in values.items()}
    return replace(made, columns=held)


def ids(made: Diagnosis) -> set[str]:
    return set(made.symptoms)


def test_a_rule_is_asked_when_the_evidence_changes(folder: Path) -> None:
    tracker = tracker_of(folder)
    out = tracker.advance([gone(0.5, ALIVE).symptom(), At(2, TURNS).symptom()], seconds(4))
    first = diagnoses(out)[0]
    assert first.asked == ("rules",) and first.at_ns == seconds(2)
    assert JAMMED in first.symptoms and JAMMED not in first.hypotheses[0].explains, "counted once"
    (found,) = (one for one in out if isinstance(one, Symptom) and one.source == "rules")
    assert (found.id, found.state, found.confirmed_ns) == (JAMMED, "present", seconds(2))
    assert found.onset_ns == seconds(2) and found.evidence[0][0] == TURNS
    later = tracker.advance([At(5, ALIVE).symptom()], seconds(6))
    states = {one.id: one.state for one in later if isinstance(one, Symptom)}
    assert states == {JAMMED: "absent"}
    assert ids(diagnoses(later)[-1]) == {TURNS, ALIVE}


def test_what_a_rule_finds_opens_a_diagnosis_and_heals_it(folder: Path) -> None:
    tracker = tracker_of(folder)
    follows = "base/drive/follows"
    out = tracker.advance([gone(1.2, follows).symptom()], seconds(5))
    (made,) = diagnoses(out)
    assert (made.at_ns, leading(made)) == (seconds(1.5), "laser#dirty")
    assert made.hypotheses[0].explains == (QUIET,)
    out = tracker.advance([At(6, follows, "unknown").symptom()], seconds(8))
    assert [(one.state, one.at_ns) for one in diagnoses(out)] == [("healed", seconds(6))]


def test_a_proof_leaves_no_other_answer(folder: Path) -> None:
    tracker = tracker_of(folder)
    before = diagnoses(tracker.advance([At(2, CLEAR).symptom()], seconds(4)))[-1]
    assert leading(before) == "laser#dirty"
    after = diagnoses(tracker.advance([At(5, ALIVE).symptom()], seconds(6)))[-1]
    assert BROKEN in after.symptoms and BROKEN not in after.findings
    assert all("laser#dead" in one.faults for one in after.hypotheses)
    assert all(BROKEN in one.explains for one in after.hypotheses)


def test_texts_of_rules_are_findings(folder: Path) -> None:
    tracker = tracker_of(folder)
    made = diagnoses(tracker.advance([At(2, CLEAR).symptom()], seconds(4)))
    assert made[-1].findings == ("rule:idle(motor): does nothing",)
    made = diagnoses(tracker.advance([gone(5, TURNS).symptom()], seconds(6)))
    assert made[-1].findings == () and made[-1].hypotheses


@pytest.mark.parametrize("as_row", [True, False])
def test_a_detector_opens_and_heals_a_diagnosis(folder: Path, as_row: bool) -> None:
    tracker = tracker_of(folder)
    assert {"event_finding", "amberbox_event"} <= tracker.items
    happens: list[tuple[float, SymptomState]] = [(2.0, "present"), (5.0, "absent")]
    for at_s, state in happens:
        told = {"id": FLOW, "state": state, "measured": "tasks.state tasks.step"}
        said = RecordedFinding(FLOW, state, measured=("tasks.state", "tasks.step"))
        tracker.feed(logged(at_s, **told) if as_row else events((at_s, said)))
    made = diagnoses(tracker.advance([], seconds(8)))
    assert [one.state for one in made] == ["open", "healed"]
    assert made[0].at_ns == seconds(2) and leading(made[0]) == "laser#dead"
    assert made[1].at_ns == seconds(6), "remembered as long as the file says"


def test_a_detector_may_prove(folder: Path) -> None:
    tracker = tracker_of(folder)
    tracker.feed(events((2.0, RecordedFinding(ODD))))
    (made,) = diagnoses(tracker.advance([], seconds(4)))
    assert all(one.faults & {"motor#stuck", "motor#weak"} for one in made.hypotheses)
    assert made.symptoms == (ODD,)


def test_one_measurement_counts_once(folder: Path) -> None:
    def probability(measured: tuple[str, ...]) -> float:
        tracker = tracker_of(folder)
        tracker.feed(events((2.0, RecordedFinding(FLOW, measured=measured))))
        made = diagnoses(tracker.advance([At(1, ALIVE).symptom()], seconds(4)))[-1]
        return made.hypotheses[0].probability

    alone = tracker_of(folder).advance([At(1, ALIVE).symptom()], seconds(4))
    expected = diagnoses(alone)[-1].hypotheses[0].probability
    tracker = tracker_of(folder)
    happens = [At(1, ALIVE).symptom()]
    tracker.feed(events((1.0, RecordedFinding(FLOW, measured=(ALIVE,)))))
    doubled = diagnoses(tracker.advance(happens, seconds(4)))[-1]
    assert doubled.hypotheses[0].probability == pytest.approx(expected, abs=1e-12)
    assert probability(("other.data",)) != pytest.approx(expected, abs=1e-6)


def test_what_is_no_finding_is_counted_and_left_out(folder: Path) -> None:
    tracker = tracker_of(folder)
    tracker.feed(logged(1.0, id=FLOW, state="maybe"))
    tracker.feed(logged(1.5, state="present"))
    tracker.feed(logged(2.0, id="x" * 301))
    tracker.feed(logged(2.5, id=FLOW, strength=float("nan")))
    assert tracker.advance([], seconds(4)) == []
    assert tracker.troubles == {"detectors": "4 findings were left out"}


def test_findings_that_nobody_named_are_bounded(folder: Path) -> None:
    tracker = tracker_of(folder)
    for number in range(300):
        tracker.feed(logged(1.0 + number / 1000, id=f"noise.{number}"))
    assert len(tracker.advance([], seconds(4))) == 200
    assert tracker.troubles == {"detectors": "100 findings were left out"}


def test_a_provider_that_fails_is_left_out_and_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> Iterable[Conflict]:
        raise ValueError("a bug in it")

    tracker = tracker_of(folder)
    tracker.advance([gone(0.5, ALIVE).symptom(), At(2, TURNS).symptom()], seconds(4))
    monkeypatch.setattr(rules, "provide", fails)
    out = tracker.advance([At(5, CLEAR).symptom()], seconds(7))
    assert dict(tracker.left_out) == {"rules": "ValueError: a bug in it"}
    last = diagnoses(out)[-1]
    assert last.asked == () and ids(last) == {TURNS, CLEAR}
    assert last.findings == ("its rules were left out: ValueError: a bug in it",)
    monkeypatch.undo()
    tracker.advance([], seconds(304))
    assert tracker.left_out
    last = diagnoses(tracker.advance([], seconds(306)))[-1]
    assert not tracker.left_out and last.asked == ("rules",) and not last.findings
    assert JAMMED in last.symptoms, "it is tried again"


def test_what_another_provider_proves_and_what_is_no_proof(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Conflict | Symptom] = [
        Conflict(frozenset({"motor#stuck", "motor#weak"}), "rules"),
        Symptom(CLEAR, "present", CLEAR, seconds(2), seconds(2), source="rules"),
    ]
    monkeypatch.setattr(rules, "provide", lambda *_: iter(told))
    tracker = tracker_of(folder)
    out = tracker.advance([gone(1, CLEAR).symptom(), At(2, ALIVE).symptom()], seconds(4))
    last = diagnoses(out)[-1]
    assert set(last.symptoms) == {ALIVE, "one of motor#stuck or motor#weak"}, "monitors go first"
    assert all(one.faults & {"motor#stuck", "motor#weak"} for one in last.hypotheses)
    told[0] = Conflict(frozenset({"motor#gone"}), "rules")
    last = diagnoses(tracker.advance([At(5, TURNS).symptom()], seconds(7)))[-1]
    assert set(last.symptoms) == {ALIVE, TURNS}
    assert dict(tracker.left_out) == {
        "rules": "'motor#gone' is no failure mode, but it is said to be proven"
    }


def test_providers_are_guarded_against_hanging(folder: Path) -> None:
    assert tracker_of(folder).guarded == {rules.provide.__code__}
    assert not FaultTracker(KNOWLEDGE).guarded


def test_goes_on_from_a_snapshot_of_an_earlier_version(folder: Path) -> None:
    tracker = FaultTracker(KNOWLEDGE)
    tracker.begin(T0_NS)
    tracker.advance([gone(0.5, ALIVE).symptom(), At(2, TURNS).symptom()], seconds(4))
    state = tracker.snapshot()
    del state["asked"], state["detectors"]
    made = FaultTracker(KNOWLEDGE, lambda case: Window(case, folder))
    made.resume(state)
    assert JAMMED in diagnoses(made.advance([], seconds(5)))[-1].symptoms, "asked at once"


def test_a_provider_whose_evidence_was_counted_is_not_asked_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracker = tracker_of(folder)
    happens = [gone(0.5, ALIVE).symptom(), At(2, TURNS).symptom()]
    last = diagnoses(tracker.advance(happens, seconds(4)))[-1]
    case = DiagnosisContext(seconds(4), tracker.situation(), last)
    window = lambda case: Window(case, folder)  # noqa: E731 - no name would say more
    case, again = diagnose.diagnose_with_evidence(KNOWLEDGE, case, window)
    assert again == last
    monkeypatch.setattr(rules, "provide", lambda *_: iter(()))
    more = DiagnosisContext(seconds(4), tracker.situation(), last, has_more=True)
    made = diagnose.diagnose_with_evidence(KNOWLEDGE, more, window)[1]
    assert made is not None and JAMMED not in made.symptoms, "what it found before is replaced"


SECONDS = 16
ticks = st.integers(1, SECONDS * 20)
NAMES = [TURNS, ALIVE, CLEAR, "laser/power/on", "base/drive/follows"]
STATES: list[SymptomState] = ["present", "present", "absent", "absent", "unknown"]
told = st.tuples(ticks, st.sampled_from(NAMES), st.sampled_from(STATES))
detected = st.tuples(ticks, st.sampled_from([FLOW, ODD]), st.sampled_from(STATES), st.booleans())
answered = st.tuples(ticks, st.sampled_from(["stuck", "free"]))


@dataclass
class Life:
    """What monitors, detectors and people say, by ticks."""

    told: list[tuple[int, str, SymptomState]]
    detected: list[tuple[int, str, SymptomState, bool]]
    answered: list[tuple[int, str]]
    epoch: int
    opened: str = field(default="", init=False)

    def feed(self, tracker: FaultTracker, after: int, until: int) -> None:
        """Feed the rows of some ticks, in order of time."""
        found = [
            (at, logged(at / 20, id=name, state=state) if as_row else
             events((at / 20, RecordedFinding(name, state))))
            for at, name, state, as_row in self.detected if after < at <= until
        ]  # fmt: skip
        found += [
            (at, events((at / 20, RecordedAnswer(self.opened, "motor.shaft", answer))))
            for at, answer in self.answered if after < at <= until
        ]  # fmt: skip
        for _, batch in sorted(found, key=lambda one: one[0]):
            tracker.feed(batch)

    def found(self, after: int, until: int) -> list[Symptom]:
        """Return what monitors find in some ticks."""
        return [
            At(at / 20, name, state).symptom()
            for at, name, state in sorted(self.told) if after < at <= until
        ]  # fmt: skip


lives = st.builds(
    Life,
    st.lists(told, max_size=20),
    st.lists(detected, max_size=10),
    st.lists(answered, max_size=2),
    st.integers(SECONDS * 10, SECONDS * 20),
)


def live(
    life: Life, folder: Path, cuts: Iterable[int], restarts: frozenset[int]
) -> list[Symptom | Diagnosis]:
    """Live through a life in pieces, with restarts by way of a snapshot at some of the cuts."""
    tracker, out = tracker_of(folder), list[Symptom | Diagnosis]()
    for after, until in itertools.pairwise(sorted({0, *cuts, life.epoch, SECONDS * 20})):
        life.feed(tracker, after, until)
        out += tracker.advance(life.found(after, until), seconds(until / 20))
        if until == life.epoch:
            tracker.begin(seconds(until / 20))
        if until in restarts:
            state = json.loads(json.dumps(tracker.snapshot(), allow_nan=False))
            tracker = FaultTracker(KNOWLEDGE, lambda case: Window(case, folder))
            tracker.resume(state)
            life.feed(tracker, 0, until)  # rows that have been taken come again
    return out


@settings(max_examples=40)
@given(lives, st.lists(ticks, max_size=10), st.data())
def test_pieces_and_restarts_change_nothing(
    folder: Path, life: Life, cuts: list[int], data: st.DataObject
) -> None:
    first = next(iter(diagnoses(live(life, folder, (), frozenset()))), None)
    life.opened = "" if first is None else first.id
    afterwards = live(life, folder, (), frozenset())
    restarts = frozenset(data.draw(st.lists(st.sampled_from([*cuts, life.epoch]), max_size=5)))
    assert live(life, folder, cuts, restarts) == afterwards
