"""The rules in the simulated robot's folder."""

from __future__ import annotations

from pathlib import Path

from amberbox import sim
from amberbox.diagnosis.prolog.program import read_rules
from amberbox.diagnosis.prolog.query import ask

FOLDER = Path(sim.__file__).parent / "folder" / "rules"
FACTS = [
    ("now", 9),
    ("component", "bus"), ("component", "imu"), ("component", "wheel"), ("component", "host"),
    ("type", "wheel", "wheel_unit"), ("type", "other", "wheel_unit"),
    ("needs", "wheel", "bus"), ("needs", "imu", "bus"), ("needs", "bus", "host"),
    *(("status", name, "error", 9, 9) for name in ("bus", "imu", "wheel")),
    ("mission", "m1", "failed", 1, 2), ("mission", "m2", "failed", 3, 4),
    ("mission", "m3", "done", 5, 6),
    ("mission_name", "m1", "charging"), ("mission_name", "m2", "charging"),
    ("mission_name", "m3", "charging"),
    ("status", "imu", "error", 3, 4), ("holds", "sim_battery.percentage < 20", 1, 2),
    ("failure_mode", "bus", "slow"), ("severity", "bus", "slow", "fatal"),
    ("failure_mode", "imu", "off"), ("severity", "imu", "off", "critical"),
    ("shows", "imu", "off", "s"),
]  # fmt: skip


def test_what_they_find() -> None:
    program = read_rules(sorted(FOLDER.glob("*.pl")))
    assert program.notes == ()
    assert program.problems() == []
    known = program.with_facts(FACTS)
    for goal, answers in (
        ("charging_fails", [{}]),
        ("common_cause(P)", [{"P": "bus"}]),
        ("odd_one_out(W)", [{"W": "wheel"}]),
        ("failed_on_low_battery(M)", [{"M": "m1"}]),
        ("failed_with(M, C)", [{"M": "m2", "C": "imu"}]),
        ("unseen(C, M)", [{"C": "bus", "M": "slow"}]),
    ):
        assert ask(known, goal).to_json()["answers"] == answers, goal


def test_without_facts_they_find_nothing() -> None:
    program = read_rules(sorted(FOLDER.glob("*.pl")))
    for goal in ("charging_fails", "common_cause(P)", "odd_one_out(W)", "unseen(C, M)"):
        assert ask(program, goal).answers == ()


def test_only_findings_are_heads() -> None:
    program = read_rules(sorted(FOLDER.glob("*.pl")))
    assert set(program.heads) == {("charging_fails", 0), ("common_cause", 1)}
