"""Check rules of an expert system, ask them, show why and why not, export them for SWI-Prolog."""

from __future__ import annotations

import argparse
import sys
import time

from amberbox.cli._output import print_json, writable
from amberbox.core.config import refuse
from amberbox.core.errors import UsageError
from amberbox.diagnosis.rules import Answers, Budget, Program, ask, export, read_rules
from amberbox.diagnosis.rules.answers import show
from amberbox.diagnosis.rules.ask import Want
from amberbox.diagnosis.rules.terms import show_key

_NOTHING = Answers(())


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("files", nargs="+", metavar="FILE.pl", help="rule files, read as one")
    parser.add_argument("--ask", metavar="GOAL", help="all answers of a goal, such as 'broken(X)'")
    reasons = parser.add_mutually_exclusive_group()
    reasons.add_argument("--why", action="store_true", help="what each answer follows from")
    reasons.add_argument("--why-not", action="store_true", help="what failed if there is no answer")
    parser.add_argument("--export", metavar="FILE", help="write all for SWI-Prolog")
    parser.add_argument(
        "--steps", type=int, default=Budget().steps, help="stop after so many steps"
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="stop after so long (30)")
    parser.add_argument("--json", action="store_true", help="answers, proof, failed")


def run(args: argparse.Namespace) -> int:
    """Read the files, then export or ask; without either, say what is defined."""
    if (args.why or args.why_not) and args.ask is None:
        raise UsageError("--why and --why-not explain an answer", "add --ask GOAL")
    if args.steps < 1 or args.seconds <= 0:
        raise UsageError("--steps and --seconds must be above 0")
    program = read_rules(args.files)
    if not args.json:
        _tell(program)
    refuse(program.problems())
    if args.export is not None:
        writable(args.export).write_text(export(program), encoding="utf-8")
    if args.ask is not None:
        return _ask(program, args)
    if args.json:
        print_json(_NOTHING.to_json())
    elif args.export is None:
        _list(program)
    return 0


def _tell(program: Program) -> None:
    for note in program.notes:
        print(note, file=sys.stderr)


def _ask(program: Program, args: argparse.Namespace) -> int:
    end_s = time.monotonic() + args.seconds
    budget = Budget(steps=args.steps, is_over=lambda: time.monotonic() > end_s)
    want: Want = "why" if args.why else "why_not" if args.why_not else None
    found = ask(program, args.ask, budget, want)
    if args.json:
        print_json(found.to_json())
    else:
        _show(found)
    return 0


def _show(found: Answers) -> None:
    for number, answer in enumerate(found.answers):
        print(show(answer))
        for node in found.proof[number] if found.proof else ():
            print("\n".join(f"  {line}" for line in node.text().splitlines()))
    for failure in found.failed:
        print("\n".join(failure.lines()))
    if not found.answers and not found.failed:
        print("no")


def _list(program: Program) -> None:
    for key, predicate in sorted(program.predicates.items()):
        rules = sum(clause.body is not None for clause in predicate.clauses)
        facts = len(predicate.clauses) - rules
        tabled = ", tabled" if predicate.tabled else ""
        print(f"{show_key(key)}: {facts} facts, {rules} rules{tabled}")
