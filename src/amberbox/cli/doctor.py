"""Examine whether a robot folder and its computer are fit to record; listen to its sources."""

from __future__ import annotations

import argparse
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli._output import in_columns, print_json, print_lines
from amberbox.core.interrupt import called_by_signals
from amberbox.core.safe_text import one_line
from amberbox.core.units import bytes_text, in_unit

if TYPE_CHECKING:
    from amberbox.agent.doctor.listening import HeardTopic, SourceReport
    from amberbox.agent.doctor.subject import DoctorFinding

_LISTEN_S = 10.0
_MOST_S = 3600.0
_MOST_SHOWN = 20  # topics that are not recorded, and events
_HEADINGS = ("topic", "type", "messages", "rate Hz", "mean", "stamp age", "lost", "from")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder, or its black_box.yaml")
    parser.add_argument(
        "--listen", nargs="?", const=_LISTEN_S, type=_seconds, metavar="SECONDS",
        help="instead of the checks, connect all sources for so long [10] and show what is there; "
             "nothing is recorded",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print findings with hints, or what the sources hear; return 1 if anything is wrong."""
    if args.listen is not None:
        return _listen(args)
    from amberbox.agent.doctor.checkup import checkup

    findings = checkup(args.folder)
    if args.json:
        print_json([asdict(finding) for finding in findings])
    else:
        print_lines(report(findings))
    return 1 if any(finding.level == "error" for finding in findings) else 0


def report(findings: Iterable[DoctorFinding]) -> Iterator[str]:
    """Yield the findings as lines, hints below, then the counts by level."""
    found = list(findings)
    width = max((len(finding.check) for finding in found), default=0)
    for finding in found:
        yield f"{finding.level:<5}  {finding.check:<{width}}  {finding.found}"
        if finding.hint:
            yield f"{'':<7}{'':<{width}}  hint: {finding.hint}"
    levels = Counter(finding.level for finding in found)
    yield ", ".join(f"{levels[level]} {level}" for level in ("ok", "warn", "error"))


def _seconds(text: str) -> float:
    try:
        seconds = float(in_unit(text, "s"))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{text}' {error}; write FOLDER before it") from None
    if not 0 < seconds <= _MOST_S:
        raise argparse.ArgumentTypeError(f"'{text}' is not between 0 and {_MOST_S:.0f} s")
    return seconds


def _listen(args: argparse.Namespace) -> int:
    from amberbox.agent.doctor.listening import listen

    folder, stop = load_folder(args.folder), threading.Event()
    with called_by_signals(stop.set):
        reports = listen(folder, args.listen, stop)
    if args.json:
        print_json([asdict(found) for found in reports])
    else:
        print_lines(line for found in reports for line in listened(found))
    return 0 if all(found.is_fine for found in reports) else 1


def listened(found: SourceReport) -> Iterator[str]:
    """Yield what a source heard as lines; names from the bus are escaped."""
    name = found.name if found.name == found.plugin else f"{found.name} ({found.plugin})"
    state = "connected" if found.connected else "not connected"
    yield f"{name}: {state}{f': {one_line(found.trouble)}' if found.trouble else ''}"
    yield f"  sends: {one_line(found.passive) or 'its author does not say'}"
    yield from (f"  sent: {one_line(text)}" for text in found.sent)
    if found.topics:
        yield from in_columns([_HEADINGS, *map(_row, found.topics)])
    yield from _some("not recorded", [f"{topic.name} ({topic.type or 'of unknown type'})"
                                      for topic in found.not_recorded])  # fmt: skip
    for missing in found.not_published:
        near = f"; did you mean '{one_line(missing.near)}'?" if missing.near else ""
        yield f"  nobody publishes {one_line(missing.name)}{near}"
    yield from _some("event", [f"{kind}: {text}" for kind, text in found.events],
                     found.more_events)  # fmt: skip
    yield ""


def _row(topic: HeardTopic) -> tuple[str, ...]:
    age_s = topic.stamp_age_s
    return (
        one_line(topic.name),
        one_line(topic.type),
        str(topic.messages),
        "-" if topic.rate_hz is None else f"{topic.rate_hz:.1f}",
        bytes_text(topic.mean_bytes) if topic.messages else "-",
        "-" if age_s is None else f"{age_s * 1000:.1f} ms" if abs(age_s) < 1 else f"{age_s:.1f} s",
        str(topic.lost),
        one_line(", ".join([*topic.peers, *topic.down])),
    )


def _some(what: str, texts: Sequence[str], more: int = 0) -> Iterator[str]:
    """Yield the first texts, each in a line, and how many there are beside these."""
    for text in texts[:_MOST_SHOWN]:
        yield f"  {what}: {one_line(text)}"
    rest = len(texts) - _MOST_SHOWN
    if max(0, rest) + more:
        yield f"  {what}: {max(0, rest) + more} more"
