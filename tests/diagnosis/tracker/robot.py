"""A small robot whose faults tests track, and what happens to it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.types import (
    Batch,
    Column,
    Diagnosis,
    ItemSchema,
    Status,
    Symptom,
    SymptomState,
)
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import FaultTracker

T0_NS = 1_790_000_000 * NS
"""2026-09-21T14:13:20Z."""

TEXT = """\
defaults: {detects: 0.9, leak: 0.001, within_s: 10, hold_s: 2}
types:
  laser:
    failure_modes:
      dead:
        probability: 0.01
        symptoms: [laser/heartbeat/alive, laser/scan/clear, {symptom: laser/power/on, within_s: 4}]
      dirty: {probability: 0.02, takes_down: false, symptoms: [laser/scan/clear]}
  motor:
    symptoms:
      hot: {when: motor.temperature > 60, within_s: 5, hold_s: 1}
    failure_modes:
      stuck:
        probability: 0.01
        symptoms: [motor/encoder/turns, motor.hot, base/drive/follows]
        tests: {shaft: stuck}
      weak: {probability: 0.02, takes_down: false, symptoms: [base/drive/follows]}
functions:
  see:
    needs: [laser]
    system: true
    symptoms: [{symptom: tasks/log/done, within_s: 30, hold_s: 0}]
tests:
  shaft: {check: Turn the shaft by hand., outcomes: [free, stuck]}
other: {probability: 1.0e-4}
"""


def knowledge(text: str = TEXT) -> Knowledge:
    """Read an analysis that must be right."""
    fmea, problems = read_fmea(text)
    assert fmea is not None, problems
    return Knowledge("robot_1", fmea, "c0ffee")


def seconds(at_s: float) -> int:
    """Return an instant by its seconds since the record began."""
    return T0_NS + round(at_s * NS)


@dataclass(frozen=True)
class At:
    """What happens at an instant, in seconds."""

    at_s: float
    what: str
    state: SymptomState = "present"
    blocked_by: tuple[str, ...] = ()
    onset_s: float | None = None

    def symptom(self) -> Symptom:
        """Return what a monitor finds."""
        onset_s = self.at_s if self.onset_s is None else self.onset_s
        onset_ns = seconds(onset_s) if self.state == "present" else None
        return Symptom(
            self.what, self.state, self.what, onset_ns, seconds(self.at_s),
            blocked_by=self.blocked_by,
        )  # fmt: skip


def gone(at_s: float, what: str) -> At:
    """Return that a symptom is seen absent."""
    return At(at_s, what, "absent")


def begun(text: str = TEXT) -> FaultTracker:
    """Return a tracker whose epoch begins at second 0."""
    tracker = FaultTracker(knowledge(text))
    tracker.begin(T0_NS)
    return tracker


def run(tracker: FaultTracker, happens: Iterable[At], until_s: float) -> list[Symptom | Diagnosis]:
    """Track what happens in one go."""
    found = [at.symptom() for at in sorted(happens, key=lambda at: at.at_s)]
    return tracker.advance(found, seconds(until_s))


def diagnoses(out: Sequence[Symptom | Diagnosis]) -> list[Diagnosis]:
    """Return the diagnoses among the findings."""
    return [one for one in out if isinstance(one, Diagnosis)]


def leading(diagnosis: Diagnosis | None) -> str:
    """Return the id of the leading hypothesis."""
    assert diagnosis is not None, "there is no diagnosis"
    return diagnosis.hypotheses[0].id


def rows(item: str, times_s: Sequence[float], **columns: Any) -> Batch:
    """Return rows of an item."""
    times_ns = np.array([seconds(at_s) for at_s in times_s], np.int64)
    schema = ItemSchema(item, tuple(Column(name, name, "float64") for name in columns))
    held = {n: np.array(c) if isinstance(c, list) else c for n, c in columns.items()}
    seq = np.arange(len(times_ns), dtype=np.int64)
    return Batch(item, schema, "main", 1, seq, times_ns, times_ns, times_ns, held)


def status(at_s: float, component: str, mode: str, **outputs: Any) -> Status:
    """Return the status of a monitor's mode."""
    at_ns = seconds(at_s)
    return Status("robot_1", component, mode, "ok", "nominal", outputs, (), at_ns, at_ns, "", "h")


def copied(tracker: FaultTracker) -> FaultTracker:
    """Return a tracker that continues from a snapshot of another, through a file."""
    made = FaultTracker(tracker.knowledge)
    made.resume(json.loads(json.dumps(tracker.snapshot(), allow_nan=False)))
    return made
