"""Epochs: stretches of the record with one axis of log time."""

from __future__ import annotations

import re
from typing import NamedTuple

from amberbox.core.clock import NS

_TEXT = re.compile(r"main (\d+)/(-?\d+)")


class Epoch(NamedTuple):
    """One run of the recorder without a step of its clock.

    ``base_ns`` is log time minus the time since the computer's start, the same throughout; in a
    record whose time does not count from there (an import) it counts how often time went back.
    """

    run: int
    base_ns: int

    @property
    def counts_from_boot(self) -> bool:
        """Tell whether log time counts from the computer's start."""
        return self.base_ns >= NS

    def __str__(self) -> str:
        return f"main {self.run}/{self.base_ns}"


def epoch_of(text: str) -> Epoch | None:
    """Read what ``str`` of an epoch gives; None for anything else."""
    found = _TEXT.fullmatch(text)
    return Epoch(int(found[1]), int(found[2])) if found else None
