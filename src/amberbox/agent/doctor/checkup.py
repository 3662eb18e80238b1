"""Run all checks one after the other; a check that raises an error is reported, and the
others run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from amberbox.agent.doctor.disk import file_system, latency, root, space, wear
from amberbox.agent.doctor.processes import link, recorder, service, supervisor
from amberbox.agent.doctor.subject import DoctorFinding, ExaminedRobot, HostSystem, subject, warn
from amberbox.agent.doctor.system import clock, configuration, keys, passivity, power, rtc, versions
from amberbox.core.errors import AmberboxError

Check: TypeAlias = Callable[[ExaminedRobot, HostSystem], Iterable[DoctorFinding]]

# in the order of the report
CHECKS: Sequence[Check] = (
    *(configuration, passivity, recorder, supervisor, link, service, power),
    *(clock, rtc, space, file_system, root, wear, latency),
    *(keys, versions),
)


def checkup(path: str | Path, host: HostSystem | None = None) -> list[DoctorFinding]:
    """Return the findings about a robot folder and its computer; changes nothing, opens no device.

    Raises UsageError if there is nothing at ``path``.
    """
    patient, on = subject(path), host or HostSystem()
    return [finding for check in CHECKS for finding in _findings(check, patient, on)]


def _findings(check: Check, patient: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    name = check.__name__.replace("_", " ")
    try:
        yield from check(patient, host)
    except PermissionError as trouble:
        where = trouble.filename or "a file"
        yield warn(name, f"{where} may not be read", "run the doctor as the user who records")
    except (OSError, AmberboxError) as trouble:
        text = trouble.what if isinstance(trouble, AmberboxError) else str(trouble)
        yield warn(name, f"could not be looked at: {text}", "the other checks are not affected")
