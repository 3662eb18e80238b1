"""Verify a record: what is as the robot left it, and what is damaged, altered or missing."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict

from amberbox.blackbox.signing.findings import STATES, VerifyFinding, VerifyReport
from amberbox.blackbox.signing.keys import parse_public
from amberbox.blackbox.signing.verify import verify
from amberbox.blackbox.store.store import store_path
from amberbox.cli._output import in_columns, print_json, print_lines, print_notes
from amberbox.core.timestamps import maybe_time
from amberbox.core.units import bytes_text


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("where", metavar="WHERE", help="robot folder or store")
    parser.add_argument(
        "--head", action="append", default=[], metavar="HASH",
        help="a head noted earlier: 16 to 64 hex digits, or a copy of heads.json; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--key", metavar="KEY", help="the robot's public key: a copy of key.pub, or 64 hex digits"
    )
    parser.add_argument(
        "--strict", action="store_true", help="an end that is not signed yet is a fault, too"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print the findings; return 1 if anything is damaged, altered or missing."""
    key = parse_public(args.key) if args.key else ""
    report = verify(store_path(args.where), key=key, noted=args.head)
    good = report.is_good(strict=args.strict)
    if args.json:
        print_json(_as_json(report, good=good))
    else:
        print_lines(_lines(report))
        print_notes(report.notes)
    return 0 if good else 1


def _lines(report: VerifyReport) -> Iterator[str]:
    """Yield findings, worst first, then the count of files and the heads to note down."""
    for finding in sorted(report.findings, key=lambda f: (STATES.index(f.state), f.file)):
        yield f"{finding.state:<8}  {finding.file}: {finding.text}"
        place = _place(finding)
        if place:
            yield f"{'':<8}  {place}"
    counts = Counter(report.files.values())
    states = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
    yield f"{len(report.files)} files, {bytes_text(report.bytes)}: {states or 'nothing to verify'}"
    heads = [("head", h.what, h.hash, _short(h.at_ns), h.file) for h in report.heads]
    yield from in_columns(heads, "")
    for file, reason in report.uncovered.items():
        yield f"not covered  {file}: {reason}"


def _place(finding: VerifyFinding) -> str:
    """Return the position of a finding in its file, and its receive time."""
    parts = []
    if finding.item:
        parts.append(finding.item)
    if finding.chunk is not None:
        parts.append(f"chunk at byte {finding.chunk}")
    if finding.from_byte is not None and finding.to_byte is not None:
        parts.append(f"bytes {finding.from_byte} to {finding.to_byte}")
    if finding.from_ns is not None or finding.to_ns is not None:
        parts.append(f"{_short(finding.from_ns) or '?'} to {_short(finding.to_ns) or '?'}")
    return ", ".join(parts)


def _short(time_ns: int | None) -> str:
    text = maybe_time(time_ns)
    return "" if text is None else text[:23] + "Z"


def _as_json(report: VerifyReport, *, good: bool) -> dict[str, object]:
    return {
        "good": good,
        "signed": report.signed,
        "bytes": report.bytes,
        "files": dict(report.files),
        "uncovered": dict(report.uncovered),
        "findings": [finding.to_json() for finding in report.findings],
        "heads": [{**asdict(head), "at": maybe_time(head.at_ns)} for head in report.heads],
        "notes": list(report.notes),
    }
