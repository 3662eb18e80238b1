"""Programs: files, facts, declarations, notes on likely mistakes, lookups, export."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.core.errors import ConfigurationError
from amberbox.diagnosis.prolog.machine import Virtual
from amberbox.diagnosis.prolog.program import export, read_rules, read_text
from amberbox.diagnosis.prolog.query import ask
from amberbox.diagnosis.prolog.syntax import write
from amberbox.diagnosis.prolog.terms import RuleError, RuleFault, Term


def test_several_files_are_read_as_one(tmp_path: Path) -> None:
    (tmp_path / "a.pl").write_text("p(1).\nq(X) :- p(X).\n")
    (tmp_path / "b.pl").write_text("p(2).\n")
    program = read_rules([tmp_path / "a.pl", tmp_path / "b.pl"])
    found = ask(program, "q(X)", want="why")
    assert [answer["X"] for answer in found.answers] == [1, 2]
    assert str(found.proof[1][0].children[0].place) == f"{tmp_path / 'b.pl'}:1"


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "latin.pl").write_bytes(b"p('\xe4').\n")
    with pytest.raises(ConfigurationError) as caught:
        read_rules([tmp_path / "none.pl", tmp_path / "latin.pl"])
    first, second = caught.value.problems
    assert "cannot be read" in first.what
    assert "is not UTF-8" in second.what


def test_facts_are_added_without_changing_the_program() -> None:
    program = read_text("hot(X) :- status(X, error, _, _).\n")
    facts = [("status", "motor 1", "error", 5, 7.5), ("status", "motor_2", "ok", 5, [1, True])]
    more = program.with_facts(facts, "monitors")
    found = ask(more, "hot(X)", want="why")
    assert [answer["X"] for answer in found.answers] == ["motor 1"]
    assert str(found.proof[0][0].children[0].place) == "monitors:1"
    assert ask(program, "hot(X)").answers == ()
    with pytest.raises(RuleFault, match="a set is no value"):
        program.with_facts([("status", {1})])
    with pytest.raises(RuleFault, match="is/2 is built in"):
        program.with_facts([("is", 1, 2)])


@pytest.mark.parametrize(
    ("rule", "notes"),
    [
        ("p(X) :- q(X, Y).", ["Y occurs only once in this rule"]),
        ("p(X) :- q(X, _Y).", []),
        ("p(X) :- q(X, _).", []),
        ("p(X, Y) :- q(X, X), q(Y, Y).", []),
        ("p(X) :- q(X, Y), r(Y), r(on).", []),
        ("p(X) :- r(X), q(Y, Y).", ["nothing links X of the head to Y: it holds for every X"]),
        ("p(X) :- r(X), q(_Y, _Y).", []),
        ("p(X) :- r(X), q(Y, Z), Z == Y ; r(X).", []),
        ("alarm :- r(Y), q(Y, Z), r(Z).", []),
    ],
)
def test_notes_on_variables(rule: str, notes: list[str]) -> None:
    program = read_text(f":- dynamic q/2, r/1.\n{rule}\n")
    assert [note.what.splitlines()[0] for note in program.notes] == notes


def test_export_declares_what_is_empty_or_tabled() -> None:
    text = (
        ":- table p/2.\n:- dynamic 'odd name'/0.\n"
        "p(X, Y) :- ( q(X), \\+ Y = 1 -> true ; 'odd name' ), Y = \"t\".\nq('A').\n"
    )
    written = export(read_text(text).with_facts([("robot", "r 1")]))
    lines = written.splitlines()
    assert ":- table p/2." in lines
    assert ":- dynamic 'odd name'/0." in lines
    assert ":- dynamic robot/1." in lines
    assert ":- dynamic holds/3." in lines
    assert "robot('r 1')." in lines
    assert '    Y="t".' in lines
    assert [answer["X"] for answer in ask(read_text(written), "robot(X)").answers] == ["r 1"]


INTERVALS = [("battery_low", 10, 20), ("battery_low", 40, 45), ("rain", 0, 100)]
MISSIONS = [("m1", "failed", 12, 30), ("m2", "done", 21, 39), ("m3", "failed", 50, 60)]


def _holds(asked: list[tuple[Term | None, ...]]) -> Virtual:
    def solve(args: tuple[Term | None, ...]) -> Iterator[tuple[object, ...]]:
        asked.append(args)
        yield from (row for row in INTERVALS if row[0] == args[0])

    return Virtual("holds", 3, solve, (frozenset({1}),), "say which condition")


def test_lookups() -> None:
    asked: list[tuple[Term | None, ...]] = []
    missions = Virtual("mission", 4, lambda args: MISSIONS)
    program = read_text(
        "failed_while(C, M) :- holds(C, A, B), mission(M, failed, F, T), F < B, A < T.\n"
    ).with_virtual(_holds(asked), missions)
    found = ask(program, "failed_while(battery_low, M)", want="why")
    assert [write(answer["M"]) for answer in found.answers] == ["m1"]
    assert asked == [("battery_low", None, None)]
    leaves = [write(node.goal) for node in found.proof[0][0].leaves()]
    assert leaves == ["holds(battery_low,10,20)", "mission(m1,failed,12,30)", "12<20", "10<30"]
    not_found = ask(program, "holds(snow, A, B)", want="why_not")
    assert not_found.failed[0].what == "nothing of the kind is found"


def test_lookups_without_bounds_are_refused_with_a_hint() -> None:
    program = read_text("p(C) :- holds(C, _, _).\n", "robot.pl").with_virtual(_holds([]))
    with pytest.raises(RuleError) as caught:
        ask(program, "p(C)")
    assert caught.value.what.startswith("robot.pl:1: holds(_,_,_) would look through everything")
    assert "it needs argument 1" in caught.value.what
    assert caught.value.hint == "say which condition"


def test_a_lookup_with_wrong_rows_is_an_error() -> None:
    program = read_text("p.").with_virtual(Virtual("holds", 3, lambda args: [(1, 2)]))
    with pytest.raises(RuleError, match="a row for holds/3 has 2 values"):
        ask(program, "holds(a, B, C)")
