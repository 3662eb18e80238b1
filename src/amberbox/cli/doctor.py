"""Examine the box: clock, disk, wear, power, service, keys, versions; say what to improve."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict

from amberbox.blackbox.doctor.checkup import checkup
from amberbox.blackbox.doctor.finding import Finding
from amberbox.cli._output import print_json
from amberbox.cli._text import print_lines


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder, or its black_box.yaml")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print what was found with hints; 1 if there is any error."""
    findings = checkup(args.folder)
    if args.json:
        print_json([asdict(finding) for finding in findings])
    else:
        print_lines(report(findings))
    return 1 if any(finding.level == "error" for finding in findings) else 0


def report(findings: Iterable[Finding]) -> Iterator[str]:
    """Write the findings for a person, worst news marked, hints below."""
    found = list(findings)
    width = max((len(finding.check) for finding in found), default=0)
    for finding in found:
        yield f"{finding.level:<5}  {finding.check:<{width}}  {finding.found}"
        if finding.hint:
            yield f"{'':<7}{'':<{width}}  hint: {finding.hint}"
    levels = Counter(finding.level for finding in found)
    yield ", ".join(f"{levels[level]} {level}" for level in ("ok", "warn", "error"))
