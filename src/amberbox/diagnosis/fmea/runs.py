"""Tests that are runs: experiments and unit tests, and the answers that their verdicts are."""

from __future__ import annotations

from collections.abc import Mapping

from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.types import RunKind
from amberbox.core.yaml_nodes import Node
from amberbox.diagnosis.fmea.model import Fmea, FmeaReferences, FmeaTest, RunFacts
from amberbox.diagnosis.fmea.parser import TestFile, child_node

MINUTE_S = 60.0
RUN_WORDS: Mapping[RunKind, str] = {"experiment": "experiment", "unit_test": "unit test"}


class RunCollector:
    """Makes the tests that are experiments or unit tests; reports those that do not exist."""

    def __init__(self, known: FmeaReferences | None, problems: list[Problem]) -> None:
        self._known = known
        self._problems = problems
        self._names: dict[RunKind, Mapping[str, RunFacts] | None] = {}
        self._run_by: dict[tuple[RunKind, str], str] = {}

    def make(self, kind: RunKind, run: str, name: str, entry: TestFile, node: Node) -> FmeaTest:
        """Make a test; its duration and whether it moves are those of the run, if not given."""
        place, where = child_node(node, kind), f"tests.{name}.{kind}"
        first = self._run_by.setdefault((kind, run), name)
        if first != name:
            what = f"'{run}' is run by the test {first} already"
            hint = "one run is evidence once: let all failure modes name one test"
            self._problems.append(place.problem(where, what, hint))
        facts = self._facts(kind, run, place, where)
        words = f"Run the {RUN_WORDS[kind]} {run}"
        cost_s = facts.duration_s if entry.minutes is None else entry.minutes * MINUTE_S
        return FmeaTest(
            name, kind, f"{words}: {entry.text}" if entry.text else f"{words}.", entry.role,
            MINUTE_S if cost_s is None else cost_s, entry.risk, tuple(entry.outcomes), entry.sure,
            run, entry.passed or entry.outcomes[0],
            facts.moves if entry.moves is None else entry.moves,
        )  # fmt: skip

    def _facts(self, kind: RunKind, run: str, node: Node, where: str) -> RunFacts:
        if kind not in self._names:
            self._names[kind] = None if self._known is None else self._known.runs(kind)
        names = self._names[kind]
        if names is None:
            return RunFacts()
        if run in names and not names[run].parametrised:
            return names[run]
        of_values = [n for n, facts in names.items() if facts.parametrised]
        found = next((n for n in of_values if run.startswith(f"{n}-")), None)
        if found is not None:
            return names[found]
        words = RUN_WORDS[kind]
        if run in names:
            what, hint = f"the {words} '{run}' has parameters", f"name one of them: {run}-VALUE"
        else:
            what, hint = f"there is no {words} '{run}'{did_you_mean(run, names)}", ""
        self._problems.append(node.problem(where, what, hint))
        return RunFacts()


def answers_of_run(fmea: Fmea, kind: RunKind, name: str, verdict: str) -> dict[str, str]:
    """Return the answers that a finished run gives, by test.

    ``verdict`` is ``passed`` or ``failed``; a run that ended otherwise answers nothing.
    """
    found = (test for test in fmea.tests.values() if (test.kind, test.run) == (kind, name))
    answers = ((test.id, test.answer(verdict)) for test in found)
    return {test: answer for test, answer in answers if answer is not None}
