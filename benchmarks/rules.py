"""Rules: 10,000 facts and 1,000 rules read and asked, beside SWI-Prolog where it is installed."""

from __future__ import annotations

import random
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from amberbox.diagnosis.prolog.program import read_text
from amberbox.diagnosis.prolog.query import ask
from benchmarks.common import Row

FACTS, RULES, KINDS, SIGNS = 10_000, 1_000, 100, 300
TARGET = "all 1,000 goals, reading included; to be <= 2 s"
_RUN = """
:- initialization(main).
main :- statistics(cputime, A), forall(between(0, {last}, I), count(I)),
    statistics(cputime, B), C is B - A, format("seconds ~w~n", [C]), halt.
count(I) :- atom_concat(f, I, P), G =.. [P, X], findall(X, G, L), sort(L, S), length(S, N),
    format("~w ~w~n", [P, N]).
"""
_CHAIN = """:- table leads/2.
leads(X, Y) :- leads(X, Z), edge(Z, Y).
leads(X, Y) :- edge(X, Y).
"""


def measure() -> list[Row]:
    """Measure CPU seconds for rules in two orders of their goals, and for a tabled predicate."""
    return [
        *_rules("goals in a good order", False),
        *_rules("goals in a bad order", True),
        _chain(),
    ]


def _rules(what: str, is_bad: bool) -> Iterator[Row]:
    text = program(is_bad)
    start_s = time.process_time()
    rules = read_text(text)
    read_s = time.process_time() - start_s
    counts = [len(ask(rules, f"f{number}(X)").answers) for number in range(RULES)]
    seconds = time.process_time() - start_s
    yield Row(f"read 10,000 facts and 1,000 rules, {what}", read_s, "s CPU")
    peer_s = None if is_bad else _swi(text, counts)  # in a bad order it takes minutes
    note = TARGET if peer_s is not None or not is_bad else f"{TARGET}; takes the peer minutes"
    peer = "" if peer_s is None else f"SWI-Prolog, goals only, {peer_s:.2f} s"
    ratio = None if peer_s is None else peer_s / seconds
    yield Row(f"answer them, {what}", seconds, "s CPU", peer, ratio, note)


def program(is_bad: bool) -> str:
    """Write facts of components and rules about them; in a bad order goals multiply."""
    rng = random.Random(1)
    quarter = FACTS // 4
    lines = [f"component(c{number})." for number in range(quarter)]
    lines += [f"type(c{number},t{rng.randrange(KINDS)})." for number in range(quarter)]
    lines += [f"needs_it(c{number},c{rng.randrange(quarter)})." for number in range(quarter)]
    lines += [f"sign(c{rng.randrange(quarter)},s{rng.randrange(SIGNS)})." for _ in range(quarter)]
    lines += [_rule(number, rng, is_bad) for number in range(RULES)]
    return "\n".join(lines) + "\n"


def _rule(number: int, rng: random.Random, is_bad: bool) -> str:
    kind, sign = rng.randrange(KINDS), rng.randrange(SIGNS)
    if number % 3 == 0:
        goals = [f"type(X,t{kind})", f"sign(X,s{sign})", "component(X)"]
    elif number % 3 == 1:
        goals = [f"sign(Y,s{sign})", "needs_it(X,Y)", "type(Y,T)", "type(X,U)", "T \\== U"]
    else:
        goals = [f"f{number - 1}(X)", f"\\+ f{number - 2}(X)", "type(X,_)"]
    if is_bad and number % 3 == 1:
        goals = ["component(X)", "component(Y)", *goals]
    return f"f{number}(X) :- {', '.join(goals)}."


def _swi(text: str, counts: list[int]) -> float | None:
    """Return the CPU seconds of SWI-Prolog for the same goals; its answers must be the same."""
    if shutil.which("swipl") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rules.pl"
        path.write_text(text + _RUN.format(last=RULES - 1))
        done = subprocess.run(
            ["swipl", "-q", str(path)], capture_output=True, text=True, check=True, timeout=300
        )
    found = [int(line.split()[1]) for line in done.stdout.splitlines() if line.startswith("f")]
    assert found == counts, "SWI-Prolog has other answers"
    seconds = re.search(r"seconds (\S+)", done.stdout)
    assert seconds is not None
    return float(seconds[1])


def _chain() -> Row:
    edges = "".join(f"edge(n{number}, n{number + 1}).\n" for number in range(5_000))
    rules = read_text(_CHAIN + edges)
    start_s = time.process_time()
    count = len(ask(rules, "leads(n0, X)").answers)
    rate = count / (time.process_time() - start_s)
    return Row("answers of a tabled predicate that calls itself to the left", rate, "answers/s CPU")
