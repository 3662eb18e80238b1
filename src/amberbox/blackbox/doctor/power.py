"""Does the box notice when it loses power."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.blackbox.doctor.finding import Finding, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject

_SUPPLIES = "/sys/class/power_supply"


def power(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say whether a source watches the supply of the box."""
    blocks = subject.folder.blocks if subject.folder else ()
    watching = [block.name for block in blocks if block.plugin == "power"]
    known = sorted(path.name for path in host.path(_SUPPLIES).glob("*"))
    yield judged_power(watching, known)


def judged_power(watching: list[str], known: list[str]) -> Finding:
    """Judge the blocks that watch, and the supplies that the kernel knows."""
    if watching:
        return ok("power", f"watched by {', '.join(watching)}")
    if known:
        hint = "add '- power:' to black_box.yaml: the kernel knows " + ", ".join(known)
    else:
        hint = "with a supply of its own and '- power:' the box sees and survives a power cut"
    return warn("power", "not watched: power is lost without a word", f"{hint} (docs/appliance.md)")
