"""Asking rules: answers, reasons, what failed, and searches that have no end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.core.contracts import Budget
from amberbox.core.errors import ConfigurationError
from amberbox.diagnosis.prolog.program import read_rules, read_text
from amberbox.diagnosis.prolog.query import Answers, answer_text, ask
from amberbox.diagnosis.prolog.syntax import write
from amberbox.diagnosis.prolog.terms import RuleError, StoppedError

TWIN = """
% Our own words for the same mistake, and the rule as it should be.
base(rex). base(max). start_failed(rex).
turns_freely(left). turns_freely(spare).
on(rex, left). on(rex, right). on(max, front).
drive(d1). drive(d2). drive(d3).
turns(d1, left). turns(d2, right). turns(d3, front).
suspect(D) :- base(B), start_failed(B), turns_freely(W), on(_, W), drive(D).
broken_drive(D) :- base(B), start_failed(B), on(B, W), turns_freely(W), turns(D, W), drive(D).
"""


def values(found: Answers, name: str = "X") -> list[str]:
    return [write(answer[name]) for answer in found.answers]


@pytest.mark.needs_data
def test_the_papers_rules(shared_data: Path) -> None:
    folder = shared_data / "diagnosis" / "rules"
    expected = json.loads((folder / "expected.json").read_text())
    program = read_rules([folder / "facts.pl", folder / "paper_rules.pl"])
    for goal, answers in expected["answers"].items():
        assert values(ask(program, goal)) == answers
    (proof,) = ask(program, "broken(m1)", want="why").proof[0]
    assert [write(leaf.goal) for leaf in proof.leaves()] == expected["proof broken(m1)"]
    (note,) = program.notes
    assert (Path(note.file).name, note.line, note.is_error) == ("paper_rules.pl", 2, False)
    assert "nothing links X of the head to Y or Z" in note.what


def test_a_rule_that_blames_everything_and_the_linked_one() -> None:
    program = read_text(TWIN, "twin.pl")
    assert values(ask(program, "suspect(X)")) == ["d1", "d2", "d3"]
    assert values(ask(program, "broken_drive(X)")) == ["d1"]
    assert [(note.line, note.what.splitlines()[0]) for note in program.notes] == [
        (8, "nothing links D of the head to B or W: it holds for every D")
    ]


@pytest.mark.parametrize("rule_is_general", [False, True])
def test_why(rule_is_general: bool) -> None:
    """The two solvers give the same proof."""
    text = TWIN + ("general :- member(_, [1]).\n" if rule_is_general else "")
    goal = "broken_drive(X)" + (", general" if rule_is_general else "")
    found = ask(read_text(text, "twin.pl"), goal, want="why")
    assert found.proof[0][0].text() == (
        "broken_drive(d1)   rule, twin.pl:9\n"
        "  base(rex)   fact, twin.pl:3\n"
        "  start_failed(rex)   fact, twin.pl:3\n"
        "  on(rex,left)   fact, twin.pl:5\n"
        "  turns_freely(left)   fact, twin.pl:4\n"
        "  turns(d1,left)   fact, twin.pl:7\n"
        "  drive(d1)   fact, twin.pl:6"
    )


def test_builtin_goals_in_a_proof_are_short() -> None:
    program = read_text(
        "low(X) :- level(X, L), L < 20, \\+ charging(X), member(X, [a, b]),"
        " findall(Y, level(Y, _), Ys), length(Ys, _N).\n"
        "level(a, 5). level(b, 90). :- dynamic charging/1."
    )
    (proof,) = ask(program, "low(X)", want="why").proof[0]
    assert [write(node.goal) for node in proof.children] == [
        "level(a,5)", "5<20", "\\+charging(a)", "member(a,[a,b])",
        "findall(_,level(_,_),[a,b])", "length([a,b],2)",
    ]  # fmt: skip
    assert [node.kind for node in proof.children] == ["fact", *["builtin"] * 5]


@pytest.mark.parametrize("goal", ["leads(a, X)", "leads(X, Y)"])
def test_why_through_tables_and_joins(goal: str) -> None:
    program = read_text(
        ":- table leads/2.\n"
        "leads(X, Y) :- leads(X, Z), edge(Z, Y).\n"
        "leads(X, Y) :- edge(X, Y).\n"
        "edge(a, b). edge(b, c). edge(c, a).\n"
    )
    found = ask(program, goal, want="why")
    assert len(found.answers) == (3 if goal == "leads(a, X)" else 9)
    for answer, (proof,) in zip(found.answers, found.proof, strict=True):
        assert write(proof.goal).endswith(f",{write(list(answer.values())[-1])})")
        assert {node.kind for node in proof.leaves()} == {"fact"}
    text = json.dumps(found.to_json())
    assert '"goal": "edge(a,b)", "by": "fact", "at": "rules.pl:4"' in text


def test_why_not() -> None:
    program = read_text(TWIN + "broken_drive(d9) :- base(zoe).\n", "twin.pl")
    found = ask(program, "broken_drive(d2)", want="why_not")
    assert found.answers == ()
    assert list(found.failed[0].lines()) == [
        "fails: broken_drive(d2)",
        "  broken_drive(d2)   twin.pl:9",
        "    holds: base(rex)",
        "    holds: start_failed(rex)",
        "    holds: on(rex,left)",
        "    holds: turns_freely(left)",
        "    fails: turns(d2,left)   none of 3 clauses fits",
    ]
    assert found.to_json()["failed"][0]["tried"][0]["failed"]["goal"] == "turns(d2,left)"
    assert ask(program, "broken_drive(d1)", want="why_not").failed == ()


def test_why_not_of_what_nobody_knows_and_of_loops() -> None:
    program = read_text(":- table p/1.\np(X) :- p(X), present(X).\np(X) :- holds(X, _, _), X > 1.")
    failure = ask(program, "p(hot)", want="why_not").failed[0]
    lines = list(failure.lines())
    assert "    fails: p(hot)   as above" in lines
    assert "    fails: holds(hot,_,_)   there is nothing about holds/3" in lines


@pytest.mark.parametrize(
    ("goal", "what"),
    [
        ("brokn_drive(X)", "there is no predicate brokn_drive/1; did you mean 'broken_drive'?"),
        ("drive(X, Y)", "there is no drive/2, but drive/1"),
        ("drive(X), assertz(p(X))", "assertz/1 is not supported"),
        ("", "goal, column 1: "),
        ("drive(X", "goal, column 8: the text ends in the middle of a sentence"),
        ("drive(X), X < 3", "'d1' is no number"),
        ("call(drve, X)", "there is no predicate drve/1; did you mean 'drive'?"),
        ("X", "needs a goal"),
        ("X is 2 ** 100000", "more than 4,000 digits"),
        ("X = f(X), Y = X, copy_term(X, Z)", "contains itself"),
        ("length(X, 99999999999)", "too long"),
        ("3", "no goal"),
        ("maplist([X]>>(X > 1), [2])", "write a rule of its own"),
        ("1 + 2", "X is 1 + 2"),
    ],
)
def test_goals_that_cannot_be_asked(goal: str, what: str) -> None:
    with pytest.raises(RuleError) as caught:
        ask(read_text(TWIN), goal)
    assert what in str(caught.value)


def test_an_error_says_in_which_rule() -> None:
    program = read_text("p(1).\np(a).\nq(X) :- p(X),\n  X > 0.\n", "robot.pl")
    with pytest.raises(RuleError, match=r"robot.pl:4: 'a' is no number"):
        ask(program, "q(X), member(_, [1])")
    with pytest.raises(RuleError, match=r"robot.pl:4: 'a' is no number"):
        ask(program, "q(X)")


def test_unknown_names_behind_a_goal() -> None:
    program = read_text("p(X) :- q(X).\nq(X) :- ropot(X).\nfine(1).\n", "robot.pl")
    assert values(ask(program, "fine(X)")) == ["1"]
    with pytest.raises(ConfigurationError) as caught:
        ask(program, "p(X)")
    (problem,) = caught.value.problems
    assert (problem.line, problem.where) == (2, "column 9")
    assert "there is no predicate ropot/1; did you mean 'robot'?" in problem.what


def test_names_of_the_vocabulary_exist_and_fail() -> None:
    program = read_text("hot(X) :- holds(X, _, _), present(X), \\+ mission(X, _, _, _).")
    assert program.problems() == []
    assert ask(program, "hot(X)").answers == ()


@pytest.mark.parametrize(
    ("text", "goal", "what"),
    [
        ("p :- p, q.\nq.", "p", r"stopped [\d,]+ goals deep"),
        ("p :- p.", "p", "stopped after 50,"),
        ("p(1).", "between(1, inf, X), X < 0", "stopped after 50,"),
        ("p(1).", "findall(X, between(1, inf, X), L)", "stopped after 50,"),
        ("p(1).", "between(1, inf, X), fail", "stopped after 50,"),
        ("p(1).", "forall(between(1, inf, X), X > 0)", "stopped after 50,"),
        ("p(X) :- p(f(X)).\n:- table p/1.", "p(a)", "stopped after"),
        ("n(0). n(X) :- n(Y), X is Y + 1.", "n(X)", "stopped after"),
        ("p(X) :- length(X, _), fail.", "p(X)", "stopped after"),
        ("".join(f"c({n}). " for n in range(300)), "c(X), c(Y), c(Z), X \\== Y", "stopped after"),
    ],
)
def test_searches_without_an_end_are_stopped(text: str, goal: str, what: str) -> None:
    with pytest.raises(StoppedError, match=what):
        ask(read_text(text), goal, Budget(steps=50_000, depth=20_000))


def test_time_is_the_callers_and_what_was_found_is_kept() -> None:
    calls = iter(range(1000))
    budget = Budget(is_over=lambda: next(calls) > 2)
    with pytest.raises(StoppedError, match="the time is over") as caught:
        ask(read_text("p(1)."), "between(1, inf, X)", budget)
    assert len(caught.value.answers) > 100
    assert caught.value.exit_code == 1


def test_recursion_is_as_deep_as_the_budget() -> None:
    program = read_text(
        "len([], 0).\nlen([_|T], N) :- len(T, M), N is M + 1.\n"
        "down(0).\ndown(N) :- N > 0, M is N - 1, down(M).\n"
        ":- table chain/1.\nchain(0).\nchain(N) :- N > 0, M is N - 1, chain(M).\n"
    )
    assert values(ask(program, "numlist(1, 5000, L), len(L, N), N > 5, X = deep")) == ["deep"]
    assert values(ask(program, "down(10000), X = low")) == ["low"]
    assert values(ask(program, "chain(1000), X = end")) == ["end"]


def test_thousands_of_alternatives_are_not_deep() -> None:
    alternatives = "; ".join(f"X = {number}" for number in range(11_000))
    cases = "; ".join(f"X == {number} -> Y = even" for number in range(0, 11_000, 2))
    program = read_text(f"p(X) :- ({alternatives}).\nq(X, Y) :- ({cases} ; Y = odd).\n")
    assert len(ask(program, "p(X)").answers) == 11_000
    assert [ask(program, f"q({n}, Y)").answers[0]["Y"] for n in (10_998, 7)] == ["even", "odd"]
    (failure,) = ask(program, "p(x)", want="why_not").failed
    assert max(map(len, failure.lines())) < 1_000
    with pytest.raises(ConfigurationError, match="nested too deeply"):
        read_text("r :- " + " -> ".join(["true"] * 11_000) + ".")


DOUBLE = "double(X, X, 0).\ndouble(A, X, N) :- N > 0, M is N - 1, {goal}, double(B, X, M).\n"


@pytest.mark.parametrize(
    "goal", ["atom_concat(A, A, B)", "string_concat(A, A, B)", "atomic_list_concat([A, A], B)"]
)
def test_texts_count_against_the_budget(goal: str) -> None:
    program = read_text(DOUBLE.format(goal=goal))
    (answer,) = ask(program, "double(a, X, 16), atom_length(X, N)").answers
    assert answer["N"] == 2**16
    with pytest.raises(StoppedError, match="ever larger terms"):
        ask(program, "double(a, X, 40)")


def test_what_is_large_asks_for_the_time_within_one_goal() -> None:
    budget = Budget(is_over=lambda: True)
    with pytest.raises(StoppedError, match="the time is over"):
        ask(read_text("p."), "length(L, 100000), msort(L, M)", budget)


def test_deep_answers_and_proofs_are_written() -> None:
    program = read_text("nest(0, z).\nnest(N, f(T)) :- N > 0, M is N - 1, nest(M, T).\n")
    found = ask(program, "nest(1500, X)", want="why")
    assert answer_text(found.answers[0]) == f"X = {'f(' * 1500}z{')' * 1500}"
    (node,) = found.proof[0]
    text = node.text().splitlines()
    assert len(text) == 3 * 1500 + 1
    assert max(map(len, text)) < 1_000
    goals = json.dumps(node.to_json())
    assert goals.count('"goal"') == len(text)


def test_each_answer_once_and_how_it_is_written() -> None:
    program = read_text("p(b). p(a). p(b). p('A b'). p(1.0). p(\"t\"). p([x, 1]). p(f(Y, Y)).")
    found = ask(program, "p(X)")
    assert [answer_text(answer) for answer in found.answers] == [
        "X = b", "X = a", "X = 'A b'", "X = 1.0", 'X = "t"', "X = [x,1]", "X = f(_,_)",
    ]  # fmt: skip
    plain = [answer["X"] for answer in found.to_json()["answers"]]
    assert plain == ["b", "a", "A b", 1.0, "t", ["x", 1], "f(_,_)"]
    assert [answer_text(answer) for answer in ask(program, "p(a)").answers] == ["yes"]


def test_tables_that_depend_on_their_own_negation_name_the_cycle() -> None:
    program = read_text(
        ":- table win/1.\nwin(X) :- move(X, Y), \\+ win(Y).\nmove(a, b). move(b, c). move(c, a).\n"
    )
    with pytest.raises(RuleError) as caught:
        ask(program, "win(a)")
    assert "win(a) depends on its own negation: win(a) -> win(b) -> win(c) -> win(a)" in str(
        caught.value
    )


@pytest.mark.parametrize(
    ("body", "what"),
    [
        ("findall(Y, p(Y), L), length(L, X)", "all solutions of itself"),
        ("( p(X) -> true ; X = 1 )", "a condition that is run once"),
        ("p(X), !", "a cut"),
    ],
)
def test_tables_across_what_runs_once(body: str, what: str) -> None:
    with pytest.raises(RuleError, match=what):
        ask(read_text(f":- table p/1.\np(X) :- {body}.\np(0)."), "p(X)")


def test_rules_may_replace_the_library_but_not_what_it_uses() -> None:
    program = read_text("member(X, Y) :- Y = only(X).\n")
    assert values(ask(program, "member(X, only(a))")) == ["a"]
    assert values(ask(program, "subtract([a, b], [a], X)")) == ["[b]"]
