"""Is the configuration right, and why does listening not disturb the robot."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from amberbox.blackbox.doctor.finding import Finding, error, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject
from amberbox.blackbox.folder.blocks import SourceBlock
from amberbox.blackbox.folder.folder import SOURCES
from amberbox.core.plugins import get, install_hint, missing_packages


def configuration(subject: Subject, host: Host) -> Iterator[Finding]:
    """Sum up what ``amberbox check`` says."""
    errors = [problem for problem in subject.problems if problem.is_error]
    notes = len(subject.problems) - len(errors)
    if errors:
        more = f" and {len(errors) - 1} more" if len(errors) > 1 else ""
        found = f"{errors[0].file}:{errors[0].line}: {errors[0].what}{more}"
        yield error("configuration", found, f"amberbox check {subject.path} names everything")
        return
    assert subject.folder is not None, "a folder without errors has been read"
    names = ", ".join(block.name for block in subject.folder.blocks)
    if not names:
        yield error("configuration", "black_box.yaml names no source that can be recorded",
                    "amberbox plugins lists the sources")  # fmt: skip
        return
    told = f"; {notes} note{'s' * (notes > 1)}: amberbox check {subject.path}" if notes else ""
    yield ok("configuration", f"listens to {names}{told}")


def passivity(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say for each source why it does not disturb the robot, and whether its library is there."""
    for block in subject.folder.blocks if subject.folder else ():
        yield _passive(block)
        plugin = get(SOURCES, block.plugin)
        missing = missing_packages(plugin)
        if missing:
            hint = install_hint(plugin.name) or f"pip install {' '.join(missing)}"
            yield error(f"source {block.name}", f"lacks {', '.join(missing)}", hint)


def _passive(block: SourceBlock) -> Finding:
    check = f"source {block.name}"
    said: Any = getattr(get(SOURCES, block.plugin).load(), "PASSIVE", "")
    if not said:
        hint = "ask its author; a source of Amberbox says so in PASSIVE"
        return warn(check, "does not say why it would not disturb the robot", hint)
    return ok(check, str(said).format(config=block.config))
