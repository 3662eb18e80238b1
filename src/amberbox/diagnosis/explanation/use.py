"""Can the robot be used: what the leading possibilities leave of it, at worst."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from amberbox.core.sureness import percent
from amberbox.core.types import Hypothesis
from amberbox.diagnosis.explanation.explanation import Group, Lost, Severity, Use
from amberbox.diagnosis.explanation.ways import Ways
from amberbox.diagnosis.fmea.model import SEVERITIES

ANSWERS: dict[Severity, str] = {
    "": "yes, as far as anybody can tell",
    "warning": "yes, it works",
    "urgent": "yes, it works; see to it soon",
    "critical": "no, it cannot go on with what it does",
    "fatal": "no, it must stop and stay stopped",
}
NOBODY_KNOWS = "nobody can tell: what is broken is not known; watch it, and stop it when in doubt"
WORTH_A_WORD = 0.05
"""How probable something graver must be to be warned of."""


def use_of(
    ways: Ways, members: Sequence[Hypothesis], others: Sequence[tuple[Group, Sequence[Hypothesis]]]
) -> Use:
    """Say what the robot can still do: the worst over the members of the leading group."""
    lost = _lost(ways, members)
    severity = worst(_severity(ways, hypothesis) for hypothesis in members)
    faults = {fault for hypothesis in members for fault in hypothesis.faults}
    if not members or faults - ways.names.fmea.modes.keys():
        text = NOBODY_KNOWS if severity in ("", "warning", "urgent") else ANSWERS[severity]
    else:
        text = ANSWERS[severity]
    differ = len({_severity(ways, hypothesis) for hypothesis in members}) > 1
    return Use(
        severity, f"at worst: {text}" if differ else text, lost, _careful(ways, severity, others)
    )


def worst(severities: Iterable[Severity]) -> Severity:
    """Return the gravest of severities, empty if there is none."""
    return max(severities, key=_rank, default="")


def _rank(severity: Severity) -> int:
    return SEVERITIES.index(severity) + 1 if severity else 0


def _severity(ways: Ways, hypothesis: Hypothesis) -> Severity:
    modes = ways.names.fmea.modes
    own = (modes[fault].severity for fault in hypothesis.faults if fault in modes)
    return worst([*own, *(lost.severity for lost in _lost(ways, [hypothesis]))])


def _lost(ways: Ways, members: Sequence[Hypothesis]) -> tuple[Lost, ...]:
    """Return the system functions that are lost with any of the members, the gravest first."""
    fmea = ways.names.fmea
    gone = {name for hypothesis in members for name in _gone(ways, hypothesis)}
    lost = [
        Lost(name, ways.names.function(name), fmea.functions[name].severity)
        for name in fmea.system_functions()
        if name in gone
    ]
    return tuple(sorted(lost, key=lambda function: -_rank(function.severity)))


def _gone(ways: Ways, hypothesis: Hypothesis) -> Iterable[str]:
    """Return what is lost by needs, and what modes cost that take nothing down.

    Of modes that take their component down, effects name all that may suffer, spares or not.
    """
    modes = (ways.names.fmea.modes.get(fault) for fault in sorted(hypothesis.faults))
    said = [name for m in modes if m and not m.takes_down for name in m.effects.system]
    return (*ways.losses(hypothesis.faults).lost, *said)


def _careful(
    ways: Ways, severity: Severity, others: Sequence[tuple[Group, Sequence[Hypothesis]]]
) -> str:
    """Warn of something less probable with which the robot must not go on."""
    graver = [
        (worst(_severity(ways, hypothesis) for hypothesis in members), group)
        for group, members in others
        if group.probability >= WORTH_A_WORD
    ]
    most = max(_rank(severity), _rank("urgent"))
    graver = [found for found in graver if _rank(found[0]) > most]
    if not graver:
        return ""
    of, group = max(graver, key=lambda found: (_rank(found[0]), found[1].probability))
    return (
        f"careful: if it is not that but {group.text} ({percent(group.probability)}): {ANSWERS[of]}"
    )
