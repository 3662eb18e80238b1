"""Check rules of an expert system, ask them, show why and why not, export them for SWI-Prolog."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from amberbox.blackbox.query.record import Record
from amberbox.cli._output import add_range_only, opened, print_json, span_of, tell, writable
from amberbox.cli._server import add_robot
from amberbox.client.address import is_url
from amberbox.consult.facts import Place, facts_of, place_of
from amberbox.core.config import refuse
from amberbox.core.errors import UsageError
from amberbox.diagnosis.rules import Answers, Budget, Program, ask, export, read_rules
from amberbox.diagnosis.rules.answers import show
from amberbox.diagnosis.rules.ask import Want
from amberbox.diagnosis.rules.faults import RuleError, RuleFault
from amberbox.diagnosis.rules.terms import show_key

_NOTHING = Answers(())


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "files", nargs="*", metavar="FILE.pl",
        help="rule files, read as one; without, rules/*.pl of the folder WHERE",
    )  # fmt: skip
    parser.add_argument(
        "--where", metavar="WHERE",
        help="robot folder, store or recording file to ask about, or a robot's page on a server",
    )  # fmt: skip
    add_robot(parser)
    parser.add_argument("--ask", metavar="GOAL", help="all answers of a goal, such as 'broken(X)'")
    reasons = parser.add_mutually_exclusive_group()
    reasons.add_argument("--why", action="store_true", help="what each answer follows from")
    reasons.add_argument("--why-not", action="store_true", help="what failed if there is no answer")
    parser.add_argument("--export", metavar="FILE", help="write all for SWI-Prolog")
    add_range_only(parser)
    parser.add_argument(
        "--steps", type=int, default=Budget().steps, help="stop after so many steps"
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="stop after so long (30)")
    parser.add_argument("--json", action="store_true", help="answers, proof, failed")


def run(args: argparse.Namespace) -> int:
    """Read the files, then export or ask; without either, say what is defined."""
    _refuse(args)
    if is_url(args.where):
        from amberbox.cli._remote_knowledge import rules_remote

        return rules_remote(args)
    place = place_of(args.where) if args.where is not None else None
    program = _read(args, place)
    if not args.json:
        _tell(program)
    refuse(program.problems())
    if args.export is None and args.ask is None:
        _list(program, as_json=args.json)
        return 0
    with _record(place) as record:
        return _answer(_with_facts(program, place, record, args), args)


def _refuse(args: argparse.Namespace) -> None:
    if (args.why or args.why_not) and args.ask is None:
        raise UsageError("--why and --why-not explain an answer", "add --ask GOAL")
    if args.steps < 1 or args.seconds <= 0:
        raise UsageError("--steps and --seconds must be above 0")
    if args.where is None and (args.from_, args.to) != (None, None):
        raise UsageError("--from and --to are about a record", "add --where WHERE")
    if args.where is None and not args.files:
        raise UsageError("there are no rules", "name files, or a robot folder with --where")


def _read(args: argparse.Namespace, place: Place | None) -> Program:
    """Read the files that are named, else those of the folder."""
    files = [Path(name) for name in args.files] or (place.rules if place is not None else [])
    if not files and args.ask is None and args.export is None:
        raise UsageError(f"there are no rules/*.pl in {args.where}", "name files, or --ask GOAL")
    return read_rules(files)


@contextmanager
def _record(place: Place | None) -> Iterator[Record | None]:
    """Open the record of a place; None if there is none."""
    if place is None or not place.has_record():
        if place is not None:
            tell([f"no record at {place.path}: nothing is known of missions, statuses, conditions"])
        yield None
        return
    with opened(str(place.path)) as record:
        yield record


def _with_facts(
    program: Program, place: Place | None, record: Record | None, args: argparse.Namespace
) -> Program:
    if place is None:
        return program
    span: tuple[int | None, int | None] = (None, None)
    if record is not None:
        span = span_of(args, record)
    return facts_of(place, record, span).added_to(program)


def _tell(program: Program) -> None:
    """Say on stderr what in the rules looks like a mistake."""
    for note in program.notes:
        print(note, file=sys.stderr)


def _answer(program: Program, args: argparse.Namespace) -> int:
    if args.export is not None:
        writable(args.export).write_text(_exported(program, args.ask or ""), encoding="utf-8")
    if args.ask is None:
        if args.json:
            print_json(_NOTHING.to_json())
        return 0
    end_s = time.monotonic() + args.seconds
    budget = Budget(steps=args.steps, is_over=lambda: time.monotonic() > end_s)
    want: Want = "why" if args.why else "why_not" if args.why_not else None
    found = ask(program, args.ask, budget, want)
    if args.json:
        print_json(found.to_json())
    else:
        _show(found)
    return 0


def _exported(program: Program, goal: str) -> str:
    try:
        return export(program, goal)
    except RuleFault as fault:
        raise RuleError(fault.what, fault.hint) from fault


def _show(found: Answers) -> None:
    for number, answer in enumerate(found.answers):
        print(show(answer))
        for node in found.proof[number] if found.proof else ():
            print("\n".join(f"  {line}" for line in node.text().splitlines()))
    for failure in found.failed:
        print("\n".join(failure.lines()))
    if not found.answers and not found.failed:
        print("no")


def _list(program: Program, *, as_json: bool) -> None:
    if as_json:
        print_json(_NOTHING.to_json())
        return
    for key, predicate in sorted(program.predicates.items()):
        rules = sum(clause.body is not None for clause in predicate.clauses)
        facts = len(predicate.clauses) - rules
        tabled = ", tabled" if predicate.tabled else ""
        print(f"{show_key(key)}: {facts} facts, {rules} rules{tabled}")
