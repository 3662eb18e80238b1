"""What `verify` finds: a state, a place, a time range and one plain sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from amberbox.core.timetext import format_time

State = Literal["intact", "damaged", "altered", "missing", "unsigned"]
STATES: tuple[State, ...] = ("altered", "missing", "damaged", "unsigned", "intact")
"""Worst first."""
BAD: frozenset[State] = frozenset({"damaged", "altered", "missing"})


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as the robot left it, or that nobody can vouch for.

    ``chunk`` is the offset of the chunk that is hit (of the first one where several may be),
    ``from_byte`` and ``to_byte`` bound what is hit, ``from_ns`` and ``to_ns`` say when it was
    received; None where it is not known. ``item`` is set for segments.
    """

    state: State
    file: str
    text: str
    chunk: int | None = None
    from_byte: int | None = None
    to_byte: int | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    item: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the finding as plain data, times as RFC 3339."""
        return {
            "state": self.state,
            "file": self.file,
            "item": self.item or None,
            "chunk": self.chunk,
            "from_byte": self.from_byte,
            "to_byte": self.to_byte,
            "from": as_text(self.from_ns),
            "to": as_text(self.to_ns),
            "text": self.text,
        }


@dataclass(frozen=True, slots=True)
class HeadLine:
    """A hash to note down: whoever has it can later prove that nothing before it was changed."""

    what: str
    hash: str
    file: str = ""
    at_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that was found in a store; ``files`` says the worst state of each file.

    ``uncovered`` says why nothing vouches for other files that are there, and what that means.
    """

    findings: Sequence[Finding]
    files: Mapping[str, State]
    heads: Sequence[HeadLine] = ()
    notes: Sequence[str] = ()
    bytes: int = 0
    signed: bool = False
    uncovered: Mapping[str, str] = field(default_factory=dict)

    def is_good(self, *, strict: bool = False) -> bool:
        """Tell whether all is as it was; ``strict`` takes an unsigned end for a fault."""
        states = {finding.state for finding in self.findings}
        return not states & BAD and not (strict and "unsigned" in states)


@dataclass(slots=True)
class Collected:
    """Findings and files as they come in."""

    findings: list[Finding] = field(default_factory=list)
    files: dict[str, State] = field(default_factory=dict)

    def take(self, file: str, findings: Sequence[Finding]) -> None:
        """Note a file that was looked at, and what was found in it."""
        states = {finding.state for finding in findings}
        known = self.files.get(file, "intact")
        self.files[file] = worst(states | {known})
        self.findings += findings

    def has_trouble(self, file: str) -> bool:
        """Tell whether something bad was found in a file."""
        return self.files.get(file, "intact") in BAD


def worst(states: set[State]) -> State:
    """Return the worst of some states; intact when there is none."""
    return next((state for state in STATES if state in states), "intact")


def as_text(time_ns: int | None) -> str | None:
    """Write a time as RFC 3339, if it is known."""
    return None if time_ns is None else format_time(time_ns)
