"""Settings of the archive that admins change."""

from __future__ import annotations

from dataclasses import dataclass

from amberbox.fleet.archive.store import Retention

RETENTION = "retention"
"""Name of the setting."""


@dataclass(frozen=True, slots=True)
class RetentionRules:
    """How long data are kept, by robot and class; without rules everything is kept."""

    rules: tuple[Retention, ...] = ()
