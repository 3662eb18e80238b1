"""Ask SWI-Prolog the same as our own engine, and compare sets of answers."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from amberbox.core.contracts import Budget
from amberbox.diagnosis.prolog.program import Program
from amberbox.diagnosis.prolog.query import ask
from amberbox.diagnosis.prolog.syntax import read_goal
from amberbox.diagnosis.prolog.terms import RuleError, args_of, make_list, variant

Result = frozenset[object] | str
"""Answers up to the names of variables, or ``error``."""

_DRIVER = """
:- style_check(-singleton).
:- initialization(run_all).
run_all :- forall('$question'(N, Vs, G), run_one(N, Vs, G)), halt.
run_one(N, Vs, G) :-
    catch(forall(call_with_inference_limit(G, 3000000, R),
                 ( R == inference_limit_exceeded -> throw(limit) ; show(N, Vs) )),
          _, show(N, error)).
show(N, T) :- write_term(a(N, T), [quoted(true), ignore_ops(true)]), write(' .'), nl.
"""


def need_swipl() -> str:
    """Return the program's path; skip the test if it is not installed."""
    path = shutil.which("swipl")
    if path is None:
        pytest.skip("requires_swipl: SWI-Prolog is not installed (Debian: swi-prolog-nox)")
    return path


def ask_swi(folder: Path, text: str, goals: Sequence[str]) -> list[Result]:
    """Return SWI-Prolog's answers to each goal after loading a text unchanged."""
    program, driver = folder / "program.pl", folder / "driver.pl"
    program.write_text(text, encoding="utf-8")
    questions = "\n".join(_question(number, goal) for number, goal in enumerate(goals))
    loads = f":- ['{program}'].\n:- discontiguous '$question'/3.\n"
    driver.write_text(loads + questions + _DRIVER, encoding="utf-8")
    command = [need_swipl(), "-q", "--stack-limit=500m", str(driver)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=20, stdin=subprocess.DEVNULL
    )
    assert "rror" not in done.stderr, done.stderr
    return _results(done.stdout, len(goals))


def _question(number: int, goal: str) -> str:
    names = ",".join(read_goal(goal).names)
    return f"'$question'({number}, [{names}], ({goal}))."


def _results(output: str, count: int) -> list[Result]:
    found: list[set[object]] = [set() for _ in range(count)]
    failed = set()
    for line in output.splitlines():
        number, values = args_of(read_goal(line).term)
        assert isinstance(number, int)
        if values == "error":
            failed.add(number)
        found[number].add(variant([values]))
    return ["error" if n in failed else frozenset(rows) for n, rows in enumerate(found)]


def ask_us(program: Program, goals: Sequence[str]) -> Iterator[Result]:
    """Yield what our engine answers to each goal."""
    for goal in goals:
        try:
            answers = ask(program, goal, Budget(steps=1_000_000)).answers
        except RuleError:
            yield "error"
            continue
        yield frozenset(variant([make_list([*answer.values()])]) for answer in answers)


def difference(goals: Sequence[str], swi: Sequence[Result], ours: Sequence[Result]) -> list[str]:
    """Return a line for each goal with different answers."""
    rows = zip(goals, swi, ours, strict=True)
    return [f"{goal}: SWI {theirs}, we {own}" for goal, theirs, own in rows if theirs != own]
