"""Findings in words, one line each, without repetitions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from amberbox.core.timestamps import format_time
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.alarm_causes import diagnosis_text, hypotheses_text
from amberbox.monitoring.findings import AlarmChange, Finding, Transition, instant_of


@dataclass(slots=True)
class FindingLines:
    """Puts findings into words, without repetitions."""

    _reasons: set[tuple[int, str, str]] = field(default_factory=set)
    _alarms: dict[tuple[str, bool], AlarmChange] = field(default_factory=dict)
    _answers: dict[str, str] = field(default_factory=dict)
    _silent: bool = False

    def line(self, finding: Finding) -> str | None:
        """Return the line for a finding, with its time; None if it contains nothing new."""
        text = self.text(finding)
        return None if text is None else f"{shown(instant_of(finding))} {text}"

    def text(self, finding: Finding) -> str | None:
        """Return a finding in words; None if it contains nothing new."""
        if isinstance(finding, Status):
            return self._silence(finding)
        if isinstance(finding, Diagnosis):
            return self._diagnosis(finding)
        if isinstance(finding, Transition):
            text = finding.text.removesuffix(f": {finding.reason}")
            hint = f" (hint: {finding.hint})" if finding.hint else ""
            return self._once(finding.at_ns, finding.component, text, finding.reason, hint)
        return self._alarm(finding) if isinstance(finding, AlarmChange) else None

    def _silence(self, status: Status) -> str | None:
        """Return a text when the recorder becomes silent, and one when it resumes."""
        if status.live_only == self._silent:
            return None
        self._silent = status.live_only
        return f"everything is unknown: {status.reason}" if self._silent else "the record goes on"

    def _diagnosis(self, diagnosis: Diagnosis) -> str | None:
        """Return a text when the leading hypothesis changed."""
        answer = "" if diagnosis.state == "healed" else hypotheses_text(diagnosis.leading())
        if self._answers.get(diagnosis.id) == answer:
            return None
        self._answers[diagnosis.id] = answer
        return f"diagnosis {diagnosis.id}: {diagnosis_text(diagnosis)}"

    def _alarm(self, alarm: AlarmChange) -> str | None:
        """Return a text when an alarm changed, other than in its cause."""
        key, plain = (alarm.id, alarm.live_only), replace(alarm, cause="", diagnosis="")
        before = self._alarms.get(key)
        self._alarms[key] = plain
        if before is not None and replace(before, changed_ns=alarm.changed_ns) == plain:
            return None
        text = f"{alarm.component}: alarm {alarm.id} {alarm.state}"
        if alarm.state == "healed":
            return text
        times = f", {alarm.count} times" if alarm.count > 1 else ""
        cause = f" because of {alarm.cause}" if alarm.cause else ""
        text += f" ({alarm.severity}{times}){cause}"
        return self._once(alarm.changed_ns, alarm.component, text, alarm.reason)

    def _once(self, at_ns: int, component: str, text: str, reason: str, hint: str = "") -> str:
        """Return a text; the same reason at one instant is printed for the first component only."""
        line = (at_ns, component, reason)
        if not reason or line in self._reasons:
            return text
        if not any(entry[0] == at_ns for entry in self._reasons):
            self._reasons.clear()
        self._reasons.add(line)
        return f"{text}: {reason}{hint}"


def shown(at_ns: int) -> str:
    """Format a time of the record, UTC, to the millisecond."""
    return format_time(at_ns)[:23]
