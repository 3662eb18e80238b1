"""Check every committed file: no package index address, no path of one machine, no leftovers."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from tools.findings import ROOT, Finding, report

LARGEST_BYTES = 500_000
FORBIDDEN: Mapping[str, re.Pattern[str]] = {
    "the address of a package index": re.compile(
        r"p[y]pi\.(?:python\.)?org|python[h]osted\.org|--(?:extra-)?index-url|--find-links|"
        r"--trusted-host"
    ),
    "a path of one machine": re.compile(r"(?<![\w.~/-])/(?:work|root|home/[a-z]\w*|Users)/"),
    "a path beside the project that nobody else has": re.compile(r"shared/(?:facts|design|style)"),
    "a mark of unfinished work": re.compile(r"\b(?:TO" r"DO|FIX" r"ME|XX" r"X)\b"),
    "a left-over merge mark": re.compile(r"^(?:<{7}|>{7}) ", re.MULTILINE),
}
SELF = ("tools/check_files.py", "tools/pin.sh", "tests/house/")
"""These name what is forbidden, to look for it or to switch it off."""


def check(root: Path) -> list[Finding]:
    """Return what committed files below ``root`` hold that they must not."""
    return [finding for path in committed(root) for finding in _in_file(root, path)]


def committed(root: Path) -> list[str]:
    """Return the paths that are committed or about to be, relative to ``root``."""
    # In a container the checkout often belongs to another user, which git refuses by default.
    git = ["git", "-c", "safe.directory=*"]
    listed = [*git, "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    output = subprocess.run(listed, cwd=root, check=True, capture_output=True, text=True).stdout
    return sorted(path for path in output.split("\0") if path and (root / path).is_file())


def _in_file(root: Path, path: str) -> Iterator[Finding]:
    data = (root / path).read_bytes()
    if len(data) > LARGEST_BYTES:
        yield Finding(path, 0, f"{len(data):,} bytes: recordings and builds are not committed")
    text = data.decode("utf-8", errors="replace")
    if "\0" in text or path.startswith(SELF):
        return
    for what, pattern in FORBIDDEN.items():
        for match in pattern.finditer(text):
            line = text.count("\n", 0, match.start()) + 1
            yield Finding(path, line, f"{what}: {match[0].strip()}")


if __name__ == "__main__":
    sys.exit(report("files", check(ROOT)))
