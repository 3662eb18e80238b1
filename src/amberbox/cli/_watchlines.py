"""What a person reads of what is found: one line for each change."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from amberbox.core.timetext import format_time
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.engine.findings import AlarmChange, Finding, Transition
from amberbox.monitoring.watcher.leading import either, in_words, leading


@dataclass(slots=True)
class Lines:
    """Puts findings into lines, and says nothing twice."""

    _reasons: set[tuple[int, str, str]] = field(default_factory=set)
    _alarms: dict[tuple[str, bool], AlarmChange] = field(default_factory=dict)
    _answers: dict[str, str] = field(default_factory=dict)
    _silent: bool = False

    def line(self, finding: Finding) -> str | None:
        """Return the line for a finding; None if there is nothing new in it for a person."""
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
        """Say once that the recorder has fallen silent, and once that it goes on."""
        if status.live_only == self._silent:
            return None
        self._silent = status.live_only
        text = f"everything is unknown: {status.reason}" if self._silent else "the record goes on"
        return f"{shown(status.measured_ns)} {text}"

    def _diagnosis(self, diagnosis: Diagnosis) -> str | None:
        """Say the leading answer when it is another one than before."""
        answer = "" if diagnosis.state == "healed" else either(leading(diagnosis))
        if self._answers.get(diagnosis.id) == answer:
            return None
        self._answers[diagnosis.id] = answer
        return f"{shown(diagnosis.at_ns)} diagnosis {diagnosis.id}: {in_words(diagnosis)}"

    def _alarm(self, alarm: AlarmChange) -> str | None:
        """Say how an alarm stands; what the diagnosis says it says itself."""
        key, plain = (alarm.id, alarm.live_only), replace(alarm, cause="", diagnosis="")
        before = self._alarms.get(key)
        self._alarms[key] = plain
        if before is not None and replace(before, changed_ns=alarm.changed_ns) == plain:
            return None
        text = f"{alarm.component}: alarm {alarm.id} {alarm.state}"
        if alarm.state == "healed":
            return f"{shown(alarm.changed_ns)} {text}"
        times = f", {alarm.count} times" if alarm.count > 1 else ""
        cause = f" because of {alarm.cause}" if alarm.cause else ""
        text += f" ({alarm.severity}{times}){cause}"
        return self._once(alarm.changed_ns, alarm.component, text, alarm.reason)

    def _once(self, at_ns: int, component: str, text: str, reason: str, hint: str = "") -> str:
        """Tell the reason of an instant once, by whom it concerns first."""
        said = (at_ns, component, reason)
        if not reason or said in self._reasons:
            return f"{shown(at_ns)} {text}"
        if not any(entry[0] == at_ns for entry in self._reasons):
            self._reasons.clear()
        self._reasons.add(said)
        return f"{shown(at_ns)} {text}: {reason}{hint}"


def shown(at_ns: int) -> str:
    """Write a time of the record, UTC, to the millisecond."""
    return format_time(at_ns)[:23]
