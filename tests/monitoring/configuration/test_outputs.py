"""Outputs of a mode file bound to what its monitor finds out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from amberbox.core.errors import Problem
from amberbox.core.mode import Result
from amberbox.core.yaml_nodes import Node
from amberbox.monitoring.component_files import OutputOptions, OutputType
from amberbox.monitoring.mode_bindings import bind_outputs
from amberbox.monitoring.plan import OutputPlan
from tests.monitoring.configuration.folders import errors, mapping_of, mode_of

RESULTS = (
    Result("alive", "bool", "it lives"),
    Result("quick", "bool", "it is quick"),
    Result("count", "int", "how many"),
    Result("rate", "float", "how often"),
    Result("state", "string", "how it is"),
)
Asked = tuple[str, OutputType, str]


def bind(
    asked: Sequence[Asked], inputs: int = 1, per_input: bool = False
) -> tuple[list[OutputPlan], list[Problem]]:
    """Bind outputs, each a name, a type and a ``result:``."""
    options = [OutputOptions(name, kind, result=result) for name, kind, result in asked]
    nodes = [Node("mode.yaml", line, {}) for line, _ in enumerate(asked, 1)]
    problems: list[Problem] = []
    plans = bind_outputs(options, nodes, RESULTS, inputs, per_input, "mappings[0]", problems)
    return plans, problems


@pytest.mark.parametrize(
    ("asked", "results"),
    [
        ([("a", "bool", "quick"), ("b", "bool", "alive")], ["quick", "alive"]),
        ([("quick", "bool", ""), ("a", "bool", "")], ["quick", "alive"]),
        ([("a", "bool", ""), ("b", "bool", ""), ("c", "double", "")], ["alive", "quick", "rate"]),
        ([("a", "float", ""), ("b", "float", "")], ["rate", "count"]),
        ([("a", "int", ""), ("b", "int", "")], ["count", "rate"]),
        ([("a", "string", ""), ("count", "float", "")], ["state", "count"]),
        ([("a", "int", "rate")], ["rate"]),
    ],
)
def test_bound_by_key_then_by_name_then_by_type(asked: list[Asked], results: list[str]) -> None:
    plans, problems = bind(asked)
    assert problems == []
    assert [plan.result.name for plan in plans] == results
    assert {plan.place for plan in plans} == {None}


@pytest.mark.parametrize(
    ("asked", "what"),
    [
        ([("a", "bool", "alife")], "the monitor has no result 'alife'; did you mean 'alive'?"),
        ([("alive", "float", "")], "'alive' is of type float, the result 'alive' is bool"),
        ([("a", "string", "rate")], "'a' is of type string, the result 'rate' is float"),
        ([("a", "bool", "alive"), ("b", "bool", "alive")],
         "shows 'alive', as another output does"),
        ([("a", "string", ""), ("b", "string", "")],
         "nothing produces the output 'b': the monitor gives alive (bool), quick (bool), "
         "count (int), rate (float), state (string)"),
    ],
)  # fmt: skip
def test_what_nothing_produces(asked: list[Asked], what: str) -> None:
    plans, problems = bind(asked)
    assert [problem.what for problem in problems] == [what]
    assert len(plans) == len(asked) - 1
    assert problems[0].line == len(asked)


def test_one_output_for_each_input() -> None:
    plans, problems = bind([("a", "bool", ""), ("b", "bool", ""), ("c", "bool", "")], 3, True)
    assert problems == []
    assert [(plan.result.name, plan.place) for plan in plans] == [
        ("alive", 0),
        ("alive", 1),
        ("alive", 2),
    ]


def test_one_output_for_all_inputs() -> None:
    plans, problems = bind([("a", "bool", ""), ("b", "bool", "")], 3, True)
    assert problems == []
    assert [(plan.result.name, plan.place) for plan in plans] == [("alive", None), ("quick", None)]


def test_numbers_of_several_inputs_need_an_output_each() -> None:
    plans, problems = bind([("a", "bool", ""), ("b", "float", "")], 2, True)
    assert [plan.name for plan in plans] == ["a"]
    assert [problem.what for problem in problems] == [
        "there are 2 inputs: give one output of type float for each"
    ]
    plans, problems = bind([("a", "float", "rate"), ("b", "float", "rate")], 2, True)
    assert (problems, [plan.place for plan in plans]) == ([], [0, 1])


def test_too_many_of_one_result() -> None:
    asked: list[Asked] = [(name, "bool", "alive") for name in "abc"]
    _, problems = bind(asked, 2, True)
    assert {problem.what for problem in problems} == {
        "shows 'alive', as another output does; one for each of the 2 inputs would be right"
    }


def test_all_that_an_output_says(tmp_path: Path) -> None:
    text = """\
name: x
monitor: heartbeat
mappings:
    - mapping:
        inputs: [/odom]
        outputs:
            - output:
                name: alive
                type: bool
                expected: false
                severity: critical
                for: 500 ms
                heal: 2 min
                flapping: {changes: 3, within: 10}
                description: it lives
                hint: look at it
"""
    (output,) = mapping_of(tmp_path, text).outputs
    assert (output.expectation.value, output.severity) == (False, "critical")
    assert (output.for_s, output.heal_s, output.flaps, output.flap_s) == (0.5, 120.0, 3, 10.0)
    assert (output.description, output.hint) == ("it lives", "look at it")
    wrongs = {
        "for: 500 ms": "for: -1",
        "name: alive": "name: a/b",
        "expected: false": "expected: 0",
    }
    for right, wrong in wrongs.items():
        _, problems = mode_of(tmp_path, text.replace(right, wrong))
        (error,) = errors(problems)
        assert f": mappings[0].outputs[0].{right.partition(':')[0]}" in error
