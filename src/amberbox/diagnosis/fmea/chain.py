"""Why something is lost, in words: the way from a component or function down to the faults."""

from __future__ import annotations

from collections.abc import Collection

from amberbox.diagnosis.fmea.model import Fmea


def chain(fmea: Fmea, cause: str, faults: Collection[str], gone: Collection[str]) -> str:
    """Say why a cause is there: ``carry lost because see lost because laser_front#dead and ...``.

    ``gone`` is what no longer serves while the faults are there (``propagation.lost``). A failure
    mode is a reason by itself.
    """
    if cause in fmea.modes:
        return cause
    own = _own_faults(fmea, cause, faults)
    if own:
        return own[0]
    needed = [name for name in fmea.needs()[cause].names() if name in gone]
    reasons = [chain(fmea, name, faults, gone) for name in needed]
    return f"{cause} lost because {_joined(reasons)}"


def _own_faults(fmea: Fmea, name: str, faults: Collection[str]) -> list[str]:
    component = fmea.components.get(name)
    modes = component.modes if component else ()
    return [mode for mode in modes if mode in faults and fmea.modes[mode].takes_down]


def _joined(reasons: list[str]) -> str:
    """Join reasons; those that have reasons of their own in brackets."""
    distinct = list(dict.fromkeys(reasons))
    if len(distinct) == 1:
        return distinct[0]
    return " and ".join(f"({text})" if " " in text else text for text in distinct)
