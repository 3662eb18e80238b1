"""Messages between the process of a robot's unit tests and the one that supervises it.

One line of JSON each, on a socket pair. The supervised process reports, and waits for the answer
to each question; what it writes is checked like foreign data.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from msgspec import Meta, Struct

from amberbox.experiments.unit_tests import (
    DETAILS,
    MOST_MEASUREMENTS,
    MOST_TESTS,
    TEXT,
    CollectionProblem,
    Measurement,
    UnitTest,
)

SOCKET_VARIABLE = "AMBERBOX_UNIT_TEST_SOCKET"
"""Variable of the environment with the number of the socket."""
LINE_BYTES = 1 << 20

_Text: TypeAlias = Annotated[str, Meta(max_length=TEXT)]


class Setup(Struct, frozen=True):
    """What the process shall do, its first line: collect, leaving out files that end it."""

    ignored: tuple[str, ...] = ()
    simulated: bool = False


class Collecting(Struct, frozen=True, tag="collecting"):
    """A file is imported now."""

    file: _Text


class Collected(Struct, frozen=True, tag="collected"):
    """Everything is collected; the answer's ``data`` are the nodes to run, in order."""

    tests: Annotated[list[UnitTest], Meta(max_length=MOST_TESTS)]
    problems: Annotated[list[CollectionProblem], Meta(max_length=MOST_TESTS)]


class Begins(Struct, frozen=True, tag="begins"):
    """A test begins; the answer says that what was printed before has been read."""

    node: _Text


class Phase(Struct, frozen=True, tag="phase"):
    """A test goes on to its body, or to what its fixtures do at the end."""

    phase: Literal["call", "teardown"]


class Ends(Struct, frozen=True, tag="ends"):
    """A test has ended; the answer says that what it printed has been read."""

    outcome: Literal["passed", "failed", "error", "skipped"]
    message: _Text
    details: Annotated[str, Meta(max_length=DETAILS)]
    measurements: Annotated[list[Measurement], Meta(max_length=MOST_MEASUREMENTS)]


class Finished(Struct, frozen=True, tag="finished"):
    """pytest has come to its end."""


class AsksAction(Struct, frozen=True, tag="action"):
    """An action shall be carried out; ``parameters`` is the JSON text of an object."""

    action: _Text
    parameters: Annotated[str, Meta(max_length=32 << 10)]


class AsksStatus(Struct, frozen=True, tag="status"):
    """The present status of a component is asked for."""

    component: _Text


class BeginsRecording(Struct, frozen=True, tag="recording"):
    """A window of the record begins that is to be kept."""

    reason: _Text


class EndsRecording(Struct, frozen=True, tag="recorded"):
    """It ends; the answer's ``data`` is the ``Recording``."""


FromTests: TypeAlias = (
    Collecting | Collected | Begins | Phase | Ends | Finished
    | AsksAction | AsksStatus | BeginsRecording | EndsRecording
)  # fmt: skip


class Answer(Struct, frozen=True):
    """The answer to a question: ``error`` is empty if it was granted."""

    error: str = ""
    hint: str = ""
    data: Any = None
