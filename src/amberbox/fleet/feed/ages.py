"""How old the statuses of robots are: told each second, because one that repeats is no change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from amberbox.core.clock import NS
from amberbox.fleet.state.standing import Moment, Standing

EVERY_S = 1.0
_ALIKE_NS = NS
"""Ages that differ by less are told as one."""


def ages_data(statuses: Mapping[tuple[str, str], Standing], when: Moment) -> Mapping[str, Any]:
    """Return the age of the newest measurements, and those of components and modes that are older.

    A robot says everything each second: most ages are alike, and said once.
    """
    ages = {key: when.age_ns(status) for key, status in statuses.items()}
    newest = min(ages.values())
    older = [
        (*key, round(age / NS, 1)) for key, age in ages.items() if age > newest + _ALIKE_NS
    ]  # fmt: skip
    return {"age_s": round(newest / NS, 2), "older": older}
