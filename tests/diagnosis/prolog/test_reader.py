"""Reading and writing terms: operators, quotes, numbers, and where a text is wrong."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.errors import ConfigurationError
from amberbox.diagnosis.prolog.program import read_text
from amberbox.diagnosis.prolog.syntax import read_goal, sentences, write
from amberbox.diagnosis.prolog.terms import (
    Real,
    RuleFault,
    Struct,
    Term,
    TextTerm,
    make_list,
    variant,
)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("a:-b,c;d->e", "a :- b,c;d -> e"),
        ("1-(2-3)-4", "1-(2-3)-4"),
        ("- (2)^2", "- 2^2"),
        ("1 - -1", "1- -1"),
        ("\\+ (a, b)", "\\+ (a,b)"),
        ("[a,'B c'|[d]]", "[a,'B c',d]"),
        ("f(;, [], {}, !)", "f(;,[],{},!)"),
        ("0x1F + 0'a", "31+97"),
        ("'don''t'", "'don\\'t'"),
        ('"say \\"hi\\""', '"say \\"hi\\""'),
        ("a /* between */ = % to the end\n b", "a=b"),
        ("X = f(_, _Y)", "_=f(_,_)"),
        ("'\\x41\\'(1.0e3)", "'A'(1000.0)"),
        ("p :- (q, r)", "p :- q,r"),
        ("a:b:c", "a:b:c"),
    ],
)
def test_terms_as_they_are_written(text: str, written: str) -> None:
    assert write(read_goal(text).term) == written
    again = read_goal(write(read_goal(text).term)).term
    assert variant([again]) == variant([read_goal(text).term])


ATOMS = st.one_of(
    st.sampled_from(["a", "b_1", "+", "-", "is", ":-", "[]", "{}", "mod", ";", "\\+", "dynamic"]),
    st.text(max_size=4).filter(lambda text: "\r" not in text),
)
PLAIN = st.one_of(
    ATOMS,
    st.integers(-(10**20), 10**20),
    st.floats(allow_nan=False, allow_infinity=False).map(Real),
    st.text(max_size=4).map(TextTerm),
)


def _structs(inner: st.SearchStrategy[Term]) -> st.SearchStrategy[Term]:
    args = st.lists(inner, min_size=1, max_size=3).map(tuple)
    return st.one_of(st.builds(Struct, ATOMS, args), st.lists(inner, max_size=3).map(make_list))


@given(st.recursive(PLAIN, _structs, max_leaves=12))
def test_what_is_written_can_be_read(term: Term) -> None:
    assert variant([read_goal(write(term)).term]) == variant([term])


@pytest.mark.parametrize(
    ("text", "line", "column", "what"),
    [
        ("p(a.\nq(b).", 1, 4, "the sentence ends too early"),
        ("p(a).\n  q(b)) .\n", 2, 7, "')' is not expected here"),
        ("p :- q r.", 1, 8, "'r' is not expected here"),
        ("p :- X = \\+ a.", 1, 13, "'a' is not expected here"),
        ("p(a)", 1, 5, "ends in the middle"),
        ('p :- q("text).', 1, 8, '" is not closed'),
        ("/* no end\np.", 1, 1, "/* is not closed"),
        ("p().", 1, 2, "has no arguments"),
        ("3 :- p.", 1, 1, "must have a name"),
        ("X :- p.", 1, 1, "must have a name"),
        ("p :- 3.", 1, 1, "is no goal"),
        ("p('\\q').", 1, 3, "the escape \\q is unknown"),
        ("p(" + "f(" * 200 + ")" * 200 + ").", 1, 201, "is nested more than 100 deep"),
        ("p(1e999).", 1, 3, "too large"),
        ("p(\x01).", 1, 3, "is not understood"),
        (":- use_module(library(lists)).", 1, 1, "use_module is not supported"),
        (":- initialization(main).", 1, 1, "initialization is not supported"),
        (":- table p.", 1, 1, "table needs a name"),
        (":- dynamic append.", 1, 1, "dynamic needs a name"),
        (":- table length/2.", 1, 1, "length/2 is built in"),
        ("X is Y.", 1, 1, "is/2 is built in and cannot be defined"),
        ("p --> q.", 1, 1, "grammar rules"),
    ],
)
def test_where_a_text_is_wrong(text: str, line: int, column: int, what: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        read_text(text)
    problem = caught.value.problems[0]
    assert (problem.line, problem.where) == (line, f"column {column}")
    assert what in problem.what


def test_all_that_is_wrong_comes_at_once_with_a_picture() -> None:
    with pytest.raises(ConfigurationError) as caught:
        read_text("good(1).\np(a b).\ngood(2).\nq(c d).\n", "robot.pl")
    first, second = caught.value.problems
    assert str(first) == (
        "robot.pl:2: column 5: 'b' is not expected here\n"
        "    p(a b).\n"
        "        ^\n"
        "  hint: is ')' missing, for '('?"
    )
    assert second.line == 4


@given(st.text(alphabet="ab X_01'\"()[]{}|,.:-\\+;!/*%\n`", max_size=40))
def test_any_text_is_read_or_refused(text: str) -> None:
    for sentence in sentences(text):
        if not isinstance(sentence, RuleFault):
            write(sentence.term)


def test_long_bodies_and_lists_are_not_deep() -> None:
    numbers = ", ".join(map(str, range(5_000)))
    goals = ", ".join(["q"] * 3_000)
    program = read_text(f"q. long([{numbers}]). p :- {goals}.")
    assert {len(predicate.clauses) for predicate in program.predicates.values()} == {1}
