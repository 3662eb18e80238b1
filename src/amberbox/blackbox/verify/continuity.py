"""Check a writer's files against each other: none is missing between the first and the last."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

from amberbox.blackbox.journal.buffer import open_buffer
from amberbox.blackbox.segments.entries import Sealed, Tombstone
from amberbox.blackbox.store import FOLDERS, run_and_number
from amberbox.blackbox.verify.findings import BAD, Finding
from amberbox.blackbox.verify.journal import Checked
from amberbox.blackbox.verify.links import links
from amberbox.blackbox.verify.targets import FIRST_CHAIN

Place = tuple[int, int]
"""Run and number of a file."""


def place_of(name: str) -> Place:
    """Read run and number from a journal's name."""
    return run_and_number(Path(PurePosixPath(name).name))


class Graves:
    """What was deleted on purpose: which places of a writer's runs, and the links they ended at."""

    def __init__(self, tombstones: Iterable[Tombstone]) -> None:
        self._raw = [t for t in tombstones if t.what != "columns" and t.journals]

    def holds(self, writer: str, place: Place) -> bool:
        """Tell whether the file at a place was deleted on purpose."""
        return any(
            stone.writer == writer
            and place_of(stone.journals[0]) <= place <= place_of(stone.journals[-1])
            for stone in self._raw
        )

    def chains(self, writer: str) -> Iterator[str]:
        """Give the links that deleted files ended at."""
        return (stone.chain for stone in self._raw if stone.writer == writer)


def check_continuity(
    writer: str,
    files: Sequence[Checked],
    sealed: Mapping[str, Sealed],
    graves: Graves,
) -> Iterator[Finding]:
    """Name the files of a writer that are missing: sealed ones, numbers, and breaks of the chain.

    ``files`` are those on the disk in the order in which they were written.
    """
    on_disk = {place_of(checked.target.name) for checked in files}
    lost = list(_lost(writer, on_disk, sealed, graves))
    yield from (_sealed_gone(entry) for entry in lost)
    known = {place_of(entry.journal) for entry in lost} | on_disk
    holes = [p for p in _holes(known) if not graves.holds(writer, p)]
    yield from (_never_sealed(writer, place) for place in holes)
    of_writer = [entry for entry in sealed.values() if entry.writer == writer]
    ends = {FIRST_CHAIN, *graves.chains(writer), *(entry.chain for entry in of_writer)}
    before: Checked | None = None
    for checked in files:
        if not _goes_on(checked, before, ends, holes) and not _in_trouble(checked, before):
            yield _broken(checked, before)
        ends |= {checked.chain, checked.start_chain}
        before = checked


def _lost(
    writer: str, on_disk: set[Place], sealed: Mapping[str, Sealed], graves: Graves
) -> Iterator[Sealed]:
    for entry in sealed.values():
        place = place_of(entry.journal)
        if entry.writer == writer and place not in on_disk and not graves.holds(writer, place):
            yield entry


def _sealed_gone(entry: Sealed) -> Finding:
    text = f"is gone: {entry.bytes} bytes, {entry.end_seq - entry.first_seq} messages"
    return Finding("missing", entry.journal, text, None, 0, entry.bytes, entry.start_ns,
                   entry.end_ns)  # fmt: skip


def _holes(known: set[Place]) -> Iterator[Place]:
    """Give the numbers that a run has skipped; it counts its files from 0 on."""
    for run in {run for run, _ in known}:
        numbers = {number for of_run, number in known if of_run == run}
        yield from ((run, number) for number in range(max(numbers)) if number not in numbers)


def _never_sealed(writer: str, place: Place) -> Finding:
    run, number = place
    name = f"{FOLDERS[writer]}/{run:06d}-*-{number:04d}.mcap"
    return Finding("missing", name, f"file {number} of run {run} is gone")


def _goes_on(
    checked: Checked, before: Checked | None, ends: set[str], holes: Sequence[Place]
) -> bool:
    """Tell whether a file takes up the chain where another one left it."""
    start, place = checked.start_chain, place_of(checked.target.name)
    if start in ends or not start:
        return True
    if any(hole[0] == place[0] and hole < place for hole in holes):
        return True  # what is missing in between has been named
    return before is not None and start in _all_links(before)


def _all_links(checked: Checked) -> set[str]:
    """Return every link of a file: an import may have begun while it was being written."""
    try:
        with open_buffer(checked.target.path) as data:
            return {link.chain for link in links(data)}
    except OSError:
        return set()


def _in_trouble(checked: Checked, before: Checked | None) -> bool:
    """Tell whether something was found already that explains why the chain breaks here."""
    both = [*checked.findings, *(before.findings if before is not None else ())]
    return any(finding.state in BAD for finding in both)


def _broken(checked: Checked, before: Checked | None) -> Finding:
    start_ns = checked.places.start_ns()
    if before is None:
        text = "is not the first file: what was written before it is gone"
        return Finding("missing", checked.target.name, text, to_ns=start_ns)
    text = f"does not go on from the end of {before.target.name}: files between them are gone,"
    text += " or the end of that one"
    end_ns = before.places.end_ns()
    return Finding("missing", checked.target.name, text, None, None, None, end_ns, start_ns)
