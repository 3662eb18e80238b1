"""Predicates about intervals: what given times mean, and the same answers in SWI-Prolog."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.core.contracts import Span
from amberbox.core.errors import UsageError
from amberbox.diagnosis.prolog.machine import LookupSource
from amberbox.diagnosis.prolog.program import (
    VOCABULARY,
    Interval,
    Intervals,
    Keys,
    Program,
    export,
    read_text,
)
from amberbox.diagnosis.prolog.query import ask
from amberbox.diagnosis.prolog.terms import RuleError
from tests.diagnosis.prolog.swi import ask_swi, ask_us, difference

LOW = {"low": [(10, 20), (30, 50)], "high": [(20, 30)]}
FIRST = (frozenset({1}),)


def read_time(text: str) -> int:
    if not text.startswith("t"):
        raise UsageError(f"not a time: {text!r}")
    return int(text[1:])


def program_of(spans: dict[str, list[Span]], rules: str = "") -> Program:
    def find(keys: Keys, span: Span | None) -> Iterator[Interval]:
        for name, known in spans.items():
            if keys[0] in (None, name):
                yield from (
                    Interval((name,), *times, LookupSource(f"list, {times[0]}", ((name, *times),)))
                    for times in known
                )

    return read_text(rules).with_virtual(
        Intervals("sometime", 1, find, read_time).virtual(),
        Intervals("always", 1, find, read_time, throughout=True, needs=FIRST).virtual(),
    )


PROGRAM = program_of(LOW)


@pytest.mark.parametrize(
    ("goal", "answers"),
    [
        ("sometime(low, F, T)", [{"F": 10, "T": 20}, {"F": 30, "T": 50}]),
        ("sometime(X, 19, 21)", [{"X": "low"}, {"X": "high"}]),
        ("sometime(low, 20, 30)", []),
        ("sometime(low, 15, T)", [{"T": 20}]),
        ("sometime(low, F, 20)", [{"F": 10}]),
        ("sometime(low, 20, T)", []),
        ("sometime(X, 20, 20)", [{"X": "high"}]),
        ("sometime(low, 12, 11)", []),
        ("sometime(low, t12, t60)", [{}]),
        ("always(low, 12, 20)", [{}]),
        ("always(low, 12, 21)", []),
        ("always(low, F, T)", [{"F": 10, "T": 20}, {"F": 30, "T": 50}]),
    ],
)
def test_what_given_times_mean(goal: str, answers: list[dict[str, object]]) -> None:
    assert ask(PROGRAM, goal).to_json()["answers"] == answers


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ("always(X, 1, 2)", "would look through everything: it needs argument 1"),
        ("sometime(low, noon, T)", "sometime: not a time: 'noon'"),
        ("sometime(low, 1.5, T)", "sometime: 1.5 is no time"),
    ],
)
def test_what_is_refused(goal: str, message: str) -> None:
    with pytest.raises(RuleError, match=message):
        ask(PROGRAM, goal)


def test_proofs_say_where_it_was_found() -> None:
    program = program_of(LOW, "p :- sometime(low, 12, 13).\n:- table q/0.\nq :- p.")
    node = ask(program, "p", want="why").proof[0][0]
    assert node.text().splitlines()[1] == "  sometime(low,12,13)   list, 10"
    (leaf,) = node.leaves()
    assert leaf.source == LookupSource("list, 10", (("low", 10, 20),))
    assert leaf.kind == "lookup"
    shown = ask(program, "q", want="why").to_json()["proof"][0][0]
    because = shown["because"][0]["because"][0]
    assert because == {"goal": "sometime(low,12,13)", "by": "lookup", "at": "list, 10"}


def test_swi_prolog_answers_the_same_of_the_export(tmp_path: Path) -> None:
    chance = random.Random(4)
    spans = {name: _spans(chance) for name in ("a", "b", "low")}
    rules = "both(X, F, T) :- sometime(X, F, T), always(low, F, T)."
    program = program_of(spans, rules)
    goals = ["sometime(X, F, T)", "both(X, F, T)", "always(low, F, T)"]
    for _ in range(60):
        times = [chance.choice(("F", str(chance.randrange(30)))), str(chance.randrange(30))]
        chance.shuffle(times)
        name = chance.choice(("sometime(X", "sometime(a", "always(low"))
        goals.append(f"{name}, {times[0]}, {times[1]})")
    found = difference(goals, ask_swi(tmp_path, export(program), goals), [*ask_us(program, goals)])
    assert found == []


def _spans(chance: random.Random) -> list[Span]:
    edges = sorted(chance.sample(range(30), 8))
    return list(zip(edges[::2], edges[1::2], strict=True))


def test_conditions_of_rules_and_goal_are_exported() -> None:
    text = export(program_of(LOW, "p(F) :- \\+ always(high, F, 2)."), "always(low, _, _)")
    assert [line for line in text.splitlines() if line.startswith("always_span")] == [
        "always_span(high,20,30).", "always_span(low,10,20).", "always_span(low,30,50).",
    ]  # fmt: skip


def test_lookups_of_a_record_are_in_the_vocabulary() -> None:
    assert {("holds", 3), ("holds_throughout", 3), ("mission", 4), ("now", 1)} <= VOCABULARY.keys()
