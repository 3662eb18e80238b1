"""What a check found, where, and how it is said."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]


class Finding(NamedTuple):
    """One violation; ``line`` is 0 when the whole file is meant."""

    path: str
    line: int
    what: str


def report(check: str, findings: Iterable[Finding]) -> int:
    """Print the findings in order and return the exit status: 1 if there are any."""
    found = sorted(set(findings))
    for finding in found:
        print(f"{finding.path}:{finding.line}: {finding.what}", file=sys.stderr)
    print(f"{check}: {len(found)} violations" if found else f"{check}: clean")
    return 1 if found else 0
