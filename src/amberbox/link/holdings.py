"""Which journals a server holds of a store: a digest per stretch, a list where digests differ.

After a server was restored from a backup it lacks journals that its robots take for confirmed. With
each connection a robot states what it counts on, as stretches of files with consecutive numbers;
the server lists what it holds in those stretches whose digest is another one.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, NamedTuple

from msgspec import Meta, Struct

from amberbox.link.limits import PATH

STRETCH = 128
"""Most files in a stretch: so long is the list when one of them is missing."""
STRETCHES = 500
"""Most stretches in one question."""
QUESTION_BYTES = 256 << 10

_NAME = re.compile(r"([a-z]+/[0-9]{1,12}-[0-9a-z]{1,16})-([0-9]{1,12})\.mcap")
_Number = Annotated[int, Meta(ge=0, lt=10**12)]


class Copy(NamedTuple):
    """A journal as both ends know it: its name and bytes, and whether it was found to hold."""

    name: str
    bytes: int
    holds: bool = True


class Stretch(Struct, frozen=True, array_like=True):
    """Files of one run of a writer, by ``folder/run-boot`` and number, both ends inclusive."""

    run: Annotated[str, Meta(max_length=64)]
    first: _Number
    last: _Number
    count: _Number
    digest: Annotated[bytes, Meta(max_length=16)]


class Question(Struct, frozen=True):
    """What a robot counts on the server to hold of one store."""

    stretches: Annotated[list[Stretch], Meta(max_length=STRETCHES)]


Listed = tuple[int, int, bool]
"""A copy within a stretch: its number, bytes, and whether it was found to hold."""


class Answer(Struct, frozen=True):
    """What is held in the stretches (by their place in the question) that differ."""

    differing: dict[int, list[Listed]]


def address(store_id: str) -> str:
    """Return the path of this question about a store on the server."""
    return f"{PATH}/held/{store_id}"


def stretches_of(counted_on: Iterable[Copy]) -> list[tuple[Stretch, list[Copy]]]:
    """Divide copies into stretches, each with its copies; names of no journal are left out."""
    found = []
    for run, copies in sorted(_by_run(counted_on).items()):
        for part in _consecutive(sorted(copies.items())):
            listed = [copy for _, copy in part]
            first, last = part[0][0], part[-1][0]
            found.append((Stretch(run, first, last, len(listed), digest(listed)), listed))
    return found


def questions(
    stretches: Sequence[tuple[Stretch, list[Copy]]],
) -> Iterator[Sequence[tuple[Stretch, list[Copy]]]]:
    """Divide stretches so that each part fits in one question."""
    for start in range(0, len(stretches), STRETCHES):
        yield stretches[start : start + STRETCHES]


def compared(question: Question, held: Iterable[Copy]) -> Answer:
    """Answer with the copies that are held in each stretch whose digest differs."""
    runs: dict[str, list[tuple[int, Copy]]] = {}
    for copy in held:
        run, number = _place(copy.name)
        runs.setdefault(run, []).append((number, copy))
    differing = {}
    for place, stretch in enumerate(question.stretches):
        inside = [
            one for one in runs.get(stretch.run, ()) if stretch.first <= one[0] <= stretch.last
        ]
        if (len(inside), digest(copy for _, copy in inside)) != (stretch.count, stretch.digest):
            differing[place] = [(number, copy.bytes, copy.holds) for number, copy in inside]
    return Answer(differing)


def lacking(asked: Sequence[tuple[Stretch, Collection[Copy]]], answer: Answer) -> list[str]:
    """Return which of the copies that were counted on are not among those held, by name."""
    found = []
    for place, held in answer.differing.items():
        if place < len(asked):
            there = set(held)
            copies = ((_place(copy.name)[1], copy) for copy in asked[place][1])
            found += [copy.name for n, copy in copies if (n, copy.bytes, copy.holds) not in there]
    return found


def digest(copies: Iterable[Copy]) -> bytes:
    """Return a digest of copies, whatever their order."""
    lines = sorted(f"{copy.name} {copy.bytes} {int(copy.holds)}" for copy in copies)
    return hashlib.sha256("\n".join(lines).encode()).digest()[:16]


def _by_run(copies: Iterable[Copy]) -> Mapping[str, dict[int, Copy]]:
    runs: dict[str, dict[int, Copy]] = {}
    for copy in copies:
        run, number = _place(copy.name)
        if run:
            runs.setdefault(run, {})[number] = copy
    return runs


def _consecutive(copies: Sequence[tuple[int, Copy]]) -> Iterator[list[tuple[int, Copy]]]:
    part: list[tuple[int, Copy]] = []
    for number, copy in copies:
        if part and (number != part[-1][0] + 1 or len(part) == STRETCH):
            yield part
            part = []
        part.append((number, copy))
    if part:
        yield part


def _place(name: str) -> tuple[str, int]:
    """Return ``folder/run-boot`` and number of a journal file; an empty run for no journal."""
    found = _NAME.fullmatch(name)
    return (found[1], int(found[2])) if found else ("", 0)
