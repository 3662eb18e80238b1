"""Lines for people: nothing twice, and a diagnosis only when its answer is another one."""

from __future__ import annotations

from dataclasses import replace

from amberbox.core.clock import NS
from amberbox.core.types import Status, Symptom
from amberbox.monitoring.finding_lines import FindingLines
from tests.monitoring.watcher.diagnoser import answer
from tests.monitoring.watcher.test_alarm_causes import DEAD, WORDS, alarm

ANSWER = "1970-01-01T00:00:02.000 diagnosis robot-1: laser#dead (90 %); next: Look at the lamp"


def test_a_diagnosis_is_a_line_when_its_leading_answer_is_another_one() -> None:
    lines = FindingLines()
    other = answer(["laser#dirty"], [], 3, 3 * NS)
    said = [DEAD, replace(DEAD, revision=2), other, replace(other, state="healed")]
    found = [lines.line(finding) for finding in said]
    assert found[0] == ANSWER
    assert found[1] is None
    assert found[2] is not None and "robot-1: laser#dirty (90 %)" in found[2]
    assert found[3] == "1970-01-01T00:00:03.000 diagnosis robot-1: healed"


def test_an_alarm_that_only_gets_a_cause_is_no_line() -> None:
    lines = FindingLines()
    opened = "1970-01-01T00:00:01.000 laser: alarm laser-1 open (urgent): it is dead"
    assert lines.line(alarm()) == opened
    assert lines.line(alarm(cause=WORDS, diagnosis="robot-1", changed_ns=2 * NS)) is None
    worse = alarm(severity="fatal", cause=WORDS, diagnosis="robot-1", changed_ns=3 * NS)
    assert lines.line(worse) == (
        f"1970-01-01T00:00:03.000 laser: alarm laser-1 open (fatal) because of {WORDS}: it is dead"
    )


def test_symptoms_and_statuses_are_no_lines_but_silence_is() -> None:
    lines = FindingLines()
    status = Status("r", "c", "", "ok", "nominal", {}, (), NS, NS, "", "h")
    assert lines.line(Symptom("c/m/o", "present")) is None
    assert lines.line(status) is None
    silent = replace(status, live_only=True, reason="nobody is there")
    assert lines.line(silent) == "1970-01-01T00:00:01.000 everything is unknown: nobody is there"
    assert lines.line(silent) is None
    assert lines.line(status) == "1970-01-01T00:00:01.000 the record goes on"
