"""A small analysis that tests share and change."""

from __future__ import annotations

from amberbox.core.needs import all_of
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences

TEXT = """\
exposure_h: 100
scales:
  severity: {warning: 2, urgent: 5, critical: 8, fatal: 10}
  occurrence: {1: 1.0e-6, 5: 1.0e-4, 10: 1}
  detection: {1: 0.001, 3: 0.05, 10: 1}
instances:
  laser:
    laser_front: {side: front}
    laser_rear: {side: rear}
types:
  laser:
    description: the <side> laser
    needs: [host]
    tests:
      look: {question: "Is the window of the <side> laser dirty?", outcomes: [clean, dirty, wet]}
    symptoms:
      hot: {when: sim_scan.temperature > 60, leak: 0.001}
    failure_modes:
      dead:
        description: the <side> laser is dead
        rate: 1.0e-4
        severity: critical
        symptoms: [<component>/heartbeat/alive]
      dirty:
        rate: 2.0e-5
        takes_down: false
        class: [sensor, steinbauer.environment]
        symptoms: [{symptom: <component>/window/clear, detects: 0.9, within_s: 5, hold_s: 2}]
        tests: {look: dirty}
      wet:
        probability: 0.01
        takes_down: false
        symptoms: [{symptom: <component>/window/clear, detects: 0.5}]
        tests: {look: {outcome: wet, detects: 0.8}}
      hot: {probability: 0.02, takes_down: false, symptoms: [hot]}
  host:
    failure_modes:
      off: {probability: 0.001, symptoms: [host/heartbeat/alive]}
  hook:
    failure_modes:
      bent: {probability: 0.03, unobservable: it has no sensor}
functions:
  see: {needs: {any: [laser_front, laser_rear]}, system: true}
  carry:
    needs: [see, hook]
    system: true
    symptoms: [{symptom: tasks/log/none_given_up, detects: 0.4}]
"""
ADDRESSES = (
    *(f"laser_{side}/heartbeat/alive" for side in ("front", "rear")),
    *(f"laser_{side}/window/clear" for side in ("front", "rear")),
    "host/heartbeat/alive",
    "tasks/log/none_given_up",
)
KNOWN = FmeaReferences(
    (*ADDRESSES, "host/heartbeat/rate_hz"),
    ADDRESSES,
    {"hook": all_of("host", "somewhere_else")},
    ("sim_scan.temperature", "sim_scan.speed"),
)


def small(old: str = "", new: str = "") -> Fmea:
    """Return the small analysis with a piece of its text changed; it must be right."""
    assert old in TEXT
    fmea, problems = read_fmea(TEXT.replace(old, new) if old else TEXT, KNOWN)
    assert fmea is not None, problems
    return fmea
