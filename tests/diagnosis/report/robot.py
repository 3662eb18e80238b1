"""A small robot whose diagnoses the tests explain: two lasers, two wheels, an emergency stop."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cache

from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.diagnose import DiagnosisId, Effort, ObservedSituation, answer
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import Explanation

START_NS = 1_795_305_600_000_000_000
"""2026-11-22 00:00:00 UTC."""

FMEA = """\
defaults: {leak: 1.0e-4}
other: {probability: 1.0e-4, detects: 0.05}
instances:
  laser:
    laser_front: {side: front}
    laser_rear: {side: rear}
  wheel_unit:
    wheel_left: {side: left}
    wheel_right: {side: right}
types:
  laser:
    description: the <side> laser
    failure_modes:
      silent:
        description: the <side> laser has no power
        cause: fuse, cable
        rate: 2.0e-5
        severity: urgent
        symptoms: [<component>/heartbeat/alive]
        remedy: look at fuse and cable of the <side> laser
      dirty:
        description: the window of the <side> laser is dirty
        cause: dust, fingerprints
        rate: 6.0e-5
        severity: warning
        takes_down: false
        symptoms: [{symptom: <component>/window/clear, detects: 0.8}]
        tests: {window: dirty}
        remedy: clean the window with a soft cloth
      covered:
        description: something covers the window of the <side> laser
        cause: a label, part of the load
        rate: 6.0e-5
        severity: urgent
        takes_down: false
        symptoms: [{symptom: <component>/window/clear, detects: 0.85}]
        tests: {window: covered}
        remedy: take away what sticks to the window
    tests:
      window:
        check: Look at the window of the <side> laser.
        role: operator
        minutes: 1
        outcomes: [clean, dirty, covered]
  wheel_unit:
    description: the <side> wheel unit
    needs: []
    symptoms:
      pulls_harder:
        when: sim_wheels.<side>_current > 5
        description: the <side> wheel unit takes more current than the other
    failure_modes:
      encoder_stuck:
        description: the encoder of drive 1 of the <side> wheel unit stands still
        cause: broken disc or cable
        rate: 1.5e-5
        severity: critical
        symptoms:
          - {symptom: <component>/encoders/encoder_1, detects: 0.98}
          - {symptom: <component>/rolls_smoothly/rolls_smoothly, detects: 0.9}
          - {symptom: pulls_harder, detects: 0.7}
        tests: {disc: loose}
        remedy: replace the encoder of drive 1 of the <side> wheel unit
      hard:
        rate: 1.0e-6
        takes_down: false
        symptoms: [{symptom: <component>/rolls_smoothly/rolls_smoothly, detects: 0.6}]
    tests:
      disc:
        check: Open the cover of drive 1 and look at the disc.
        role: technician
        minutes: 15
        risk: 0.01
        outcomes: [clean, loose]
  safety:
    description: the emergency stop
    failure_modes:
      pressed:
        description: somebody has pressed the emergency stop
        rate: 2.0e-4
        severity: fatal
        symptoms: [safety/button/released]
        tests: {somebody_near: "yes"}
        remedy: turn the button until it is out
      line_loose:
        description: the line of the emergency stop opens now and then
        rate: 3.0e-5
        severity: fatal
        symptoms: [safety/button/released]
        tests: {somebody_near: "no"}
        remedy: fasten the terminals
functions:
  see_people:
    description: notice people on at least one side
    needs: {any: [laser_front, laser_rear]}
    system: true
    severity: critical
    symptoms: [{symptom: log/navigation/has_scans, detects: 0.9}]
  power_drives:
    description: give power to the drives
    needs: [safety]
    severity: critical
    symptoms:
      - {symptom: wheel_left/power/on, detects: 0.95}
      - {symptom: wheel_right/power/on, detects: 0.95}
  move:
    description: drive
    needs: [power_drives, wheel_left, wheel_right]
    system: true
    severity: critical
symptoms:
  log/navigation/has_scans: {leak: 0.2}
tests:
  somebody_near:
    question: Is anybody at the robot?
    role: operator
    minutes: 0.5
"""

ENCODER = ("wheel_left/encoders/encoder_1", "wheel_left/rolls_smoothly/rolls_smoothly")
WINDOW = ("laser_front/window/clear",)
STOPPED = ("safety/button/released", "wheel_left/power/on", "wheel_right/power/on")
BLIND = ("laser_front/heartbeat/alive", "laser_rear/heartbeat/alive", "log/navigation/has_scans")
SCANS = ("log/navigation/has_scans",)
ODD = ("wheel_left/encoders/encoder_1", "laser_rear/window/clear", "safety/button/released")


@cache
def knowledge() -> Knowledge:
    """Return the knowledge of the small robot."""
    fmea, problems = read_fmea(FMEA)
    assert fmea is not None, problems
    return Knowledge("ropod_001", fmea, "c0ffee")


def symptoms(of: Knowledge, present: Collection[str], rest: bool = True) -> tuple[Symptom, ...]:
    """Return symptoms with onsets half a second after each other; the others are absent."""
    there = tuple(
        Symptom(
            name, "present", name, START_NS + place * 500_000_000, START_NS + place * 10**9,
            evidence=((f"sim_{name.split('/')[0].split('.')[0]}.value", START_NS, START_NS + 1),),
        )
        for place, name in enumerate(present)
    )  # fmt: skip
    names = of.fmea.symptoms if rest else ()
    return (*there, *(Symptom(name, "absent", name) for name in names if name not in present))


def diagnosis(
    of: Knowledge,
    seen: tuple[Symptom, ...],
    answers: Mapping[str, str] | None = None,
    effort: Effort | None = None,
) -> Diagnosis:
    """Return the answer a minute after the first symptom."""
    heading = DiagnosisId("ropod_001-20261122000000", 1, START_NS + 60 * 10**9)
    return answer(of, ObservedSituation(seen, answers or {}), heading, effort or Effort())


def explained(*present: str, rest: bool = True) -> Explanation:
    """Return the explanation of symptoms on the small robot."""
    seen = symptoms(knowledge(), present, rest)
    return explain(diagnosis(knowledge(), seen), knowledge(), seen)
