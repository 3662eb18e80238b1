"""Does the clock tell the time: who disciplines it, and what it does before anybody can."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.blackbox.doctor.finding import Finding, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject

DAEMONS = {
    "chronyd": "chrony",
    "ntpd": "ntpd",
    "systemd-timesyn": "systemd-timesyncd",
    "ptp4l": "PTP",
    "phc2sys": "PTP",
}
"""Programs that set the clock, by the name that the kernel has for them."""


def clock(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say whether wall time is right; order and durations in the record always are."""
    daemon = next((DAEMONS[name] for name in host.processes() if name in DAEMONS), "")
    yield judged_clock(host.clock.synchronised(), daemon)


def judged_clock(synchronised: bool | None, daemon: str) -> Finding:
    """Judge what the kernel and the list of processes say."""
    if synchronised:
        return ok("clock", f"synchronised ({daemon or 'by a program that is not known here'})")
    hint = "the record can be compared with other clocks only once this one is set"
    if not daemon:
        hint = f"install chrony or switch on systemd-timesyncd; {hint}"
        return warn("clock", "nobody sets it: no chrony, ntpd, timesyncd or PTP runs", hint)
    if synchronised is None:
        return warn("clock", f"{daemon} runs; the kernel does not say whether it is in step", hint)
    return warn("clock", f"{daemon} runs, but the clock is not synchronised (yet)", hint)


def rtc(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say what the clock shows after a start without a network."""
    if host.has("/sys/class/rtc/rtc0"):
        yield ok("real-time clock", "there is one (/dev/rtc0)")
        return
    hint = "order and durations stay right; for right dates from the first second add an RTC"
    yield warn("real-time clock", "none: each start begins in the past until the net is up", hint)
