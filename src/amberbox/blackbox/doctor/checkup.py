"""All checks, one after the other: what cannot be looked at is said, and the rest goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from amberbox.blackbox.doctor.clock import clock, rtc
from amberbox.blackbox.doctor.configuration import configuration, passivity
from amberbox.blackbox.doctor.disk import file_system, root, space
from amberbox.blackbox.doctor.finding import Finding, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.keys import keys
from amberbox.blackbox.doctor.latency import latency
from amberbox.blackbox.doctor.linked import link
from amberbox.blackbox.doctor.power import power
from amberbox.blackbox.doctor.service import recorder, service
from amberbox.blackbox.doctor.subject import Subject, subject
from amberbox.blackbox.doctor.supervised import supervisor
from amberbox.blackbox.doctor.versions import versions
from amberbox.blackbox.doctor.wear import wear
from amberbox.core.errors import AmberboxError

Check: TypeAlias = Callable[[Subject, Host], Iterable[Finding]]

CHECKS: Sequence[Check] = (
    *(configuration, passivity, recorder, supervisor, link, service, power),
    *(clock, rtc, space, file_system, root, wear, latency),
    *(keys, versions),
)
"""The order in which findings are shown."""


def checkup(path: str | Path, host: Host | None = None) -> list[Finding]:
    """Examine a robot folder and the computer it is on; changes nothing, opens no device.

    Raises UsageError if there is nothing at ``path``.
    """
    patient, on = subject(path), host or Host()
    return [finding for check in CHECKS for finding in _findings(check, patient, on)]


def _findings(check: Check, patient: Subject, host: Host) -> Iterator[Finding]:
    name = check.__name__.replace("_", " ")
    try:
        yield from check(patient, host)
    except PermissionError as trouble:
        where = trouble.filename or "a file"
        yield warn(name, f"{where} may not be read", "run the doctor as the user who records")
    except (OSError, AmberboxError) as trouble:
        text = trouble.what if isinstance(trouble, AmberboxError) else str(trouble)
        yield warn(name, f"could not be looked at: {text}", "the other checks are not affected")
