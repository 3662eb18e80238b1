"""Needs: read from files, met or not, cycles; wrong ones are reported with their line."""

from __future__ import annotations

import itertools

import pytest

from amberbox.core.errors import Problem
from amberbox.core.needs import NOTHING, Needs, all_of, any_of, at_least, cycles, parse_needs
from amberbox.core.yaml_nodes import Node, parse_yaml


def parse(text: str, *, may_be_empty: bool = False) -> tuple[Needs | None, list[Problem]]:
    problems: list[Problem] = []
    node = parse_yaml(text, "f.yaml", problems)
    assert node is not None and node.mapping is not None
    entry: Node = node.mapping["needs"]
    needs = parse_needs(entry, problems, "needs", may_be_empty=may_be_empty)
    return needs, problems


@pytest.mark.parametrize(
    ("text", "needs", "shown"),
    [
        ("[a, b]", all_of("a", "b"), "a and b"),
        ("{all: [a, b]}", all_of("a", "b"), "a and b"),
        ("{any: [a, b]}", any_of("a", "b"), "a or b"),
        ("{at_least: 2, of: [a, b, c]}", at_least(2, "a", "b", "c"), "at least 2 of a, b, c"),
        ("[a, {any: [b, {all: [c, d]}]}]", all_of("a", any_of("b", all_of("c", "d"))),
         "a and (b or (c and d))"),
        ("[a]", all_of("a"), "a"),
    ],
)  # fmt: skip
def test_needs_are_read_and_written(text: str, needs: Needs, shown: str) -> None:
    assert parse(f"needs: {text}") == (needs, [])
    assert str(needs) == shown


def test_every_combination_of_what_is_up() -> None:
    needs = all_of("a", any_of("b", at_least(2, "c", "d", "e")))
    assert needs.names() == ("a", "b", "c", "d", "e")
    for up in itertools.product((False, True), repeat=5):
        a, b, c, d, e = up
        state = dict(zip("abcde", up, strict=True))
        assert needs.met(state.__getitem__) == (a and (b or c + d + e >= 2))


@pytest.mark.parametrize(
    "needs",
    [
        all_of("a", "x", any_of("b", "y")),
        at_least(2, "a", "b", "x", all_of("c", "y")),
        any_of("a", "x"),
        all_of("x", any_of("x", "y"), all_of("a", at_least(2, "b", "c", "y"))),
    ],
)
def test_names_that_are_not_known_are_taken_to_be_up(needs: Needs) -> None:
    known = ("a", "b", "c")
    rest = needs.restricted(known.__contains__)
    assert set(rest.names()) <= set(known)
    for up in itertools.product((False, True), repeat=3):
        state = {"x": True, "y": True, **dict(zip(known, up, strict=True))}
        assert rest.met(state.__getitem__) == needs.met(state.__getitem__)


def test_nothing_is_always_met_and_must_be_allowed() -> None:
    assert NOTHING.met(lambda name: False) and str(NOTHING) == "nothing"
    assert parse("needs: []", may_be_empty=True) == (NOTHING, [])
    needs, problems = parse("needs: []")
    assert needs is None and "a gate without input" in problems[0].what


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("needs:\n  any: []", 2, "a gate without input"),
        ("needs:\n  - a\n  - at_least: 3\n    of: [b, c]", 3, "3 of 2 can never be up"),
        ("needs:\n  at_least: 0\n  of: [b]", 2, "expected a whole number from 1"),
        ("needs:\n  at_least: true\n  of: [b]", 2, "expected a whole number from 1"),
        ("needs:\n  ayn: [b]", 2, "unknown key 'ayn'; did you mean 'any'?"),
        ("needs:\n  any: [a]\n  all: [b]", 1, "any and all make no needs"),
        ("needs:\n  at_least: 1", 1, "at_least make no needs"),
        ("needs:\n  any: a", 2, "expected a list of names"),
        ("needs: a", 1, "expected what is needed, got text"),
        ("needs:\n  - a\n  - [b]", 3, "expected a name, got a list"),
        ("needs:\n  - a\n  -", 3, "expected a name, got nothing"),
        ("needs:\n  - a\n  - b\n  - a", 4, "'a' comes twice"),
    ],
)
def test_wrong_needs_are_told_with_their_line(text: str, line: int, what: str) -> None:
    needs, problems = parse(text)
    assert needs is None
    assert [(problem.line, what in problem.what) for problem in problems] == [(line, True)]


def test_all_that_is_wrong_is_said_at_once() -> None:
    _, problems = parse("needs:\n  - any: []\n  - at_least: 9\n    of: [a]\n  - b")
    assert len(problems) == 2


def test_circles_are_found_wherever_they_begin() -> None:
    needs = {"a": all_of("b"), "b": any_of("c", "x"), "c": all_of("a"), "d": all_of("a", "e")}
    assert [set(circle) for circle in cycles(needs)] == [{"a", "b", "c"}]
    assert list(cycles({"a": all_of("a")})) == [("a",)]
    assert list(cycles({"a": all_of("b", "c"), "b": all_of("c"), "c": NOTHING})) == []


def test_a_long_chain_needs_no_recursion() -> None:
    chain = {f"n{i}": all_of(f"n{i + 1}") for i in range(20_000)}
    assert list(cycles(chain)) == []
    assert len(next(cycles(chain | {"n20000": all_of("n0")}))) == 20_001
