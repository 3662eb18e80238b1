"""Tests of the file, and what they give when a failure mode is there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node
from amberbox.diagnosis.fmea.file import ResultFile, TestFile
from amberbox.diagnosis.fmea.model import FmeaTest, Kind, Outcome
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.reading import Part, child_keys
from amberbox.diagnosis.fmea.symptoms import Symptoms

MINUTE_S = 60.0


def made_test(name: str, entry: TestFile, node: Node, symptoms: Symptoms) -> FmeaTest:
    """Make a test; one that reads an output reads one that there is."""
    kind: Kind = "question" if entry.question else "check" if entry.look else "read"
    text = entry.question or entry.look or entry.text or f"Read off {entry.read}."
    if entry.read:
        symptoms.address(entry.read, child(node, "read"), f"tests.{name}.read")
    return FmeaTest(
        name, kind, text, entry.role, entry.minutes * MINUTE_S, entry.risk,
        tuple(entry.outcomes), entry.sure,
    )  # fmt: skip


def results_of(
    given: Mapping[str, str | ResultFile],
    part: Part,
    tests: Mapping[str, FmeaTest],
    node: Node,
    problems: list[Problem],
) -> Iterator[Outcome]:
    """Yield what tests give when a mode is there; ``node`` is the mapping in the file."""
    for name, entry in given.items():
        place = child(node, name)
        test_id = next((key for key in (f"{part.component}.{name}", name) if key in tests), None)
        result = ResultFile(entry) if isinstance(entry, str) else entry
        if test_id is None and name in child_keys(part.node, "tests"):
            continue  # it is wrong, which has been told
        if test_id is None:
            short = [key.removeprefix(f"{part.component}.") for key in tests]
            what = f"there is no test '{name}'{did_you_mean(name, short)}"
            problems.append(place.problem("tests", what))
        elif result.outcome not in tests[test_id].outcomes:
            known = tests[test_id].outcomes
            near = did_you_mean(result.outcome, known)
            what = f"the test gives no '{result.outcome}'{near}"
            problems.append(place.problem(f"tests.{name}", what, f"it gives {', '.join(known)}"))
        else:
            yield Outcome(test_id, result.outcome, result.detects)
