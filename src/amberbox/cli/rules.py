"""Check rules of an expert system, ask them, show why and why not, export them for SWI-Prolog."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from amberbox.blackbox.query.record import Record
from amberbox.cli._arguments import (
    add_range_only,
    add_robot,
    budget_of,
    check_time,
    opened,
    robot_at,
    span_of,
)
from amberbox.cli._output import print_json, print_notes, writable
from amberbox.client.address import is_url
from amberbox.consult.rule_lookups import RuleTarget, rule_facts, rule_target
from amberbox.core.config import raise_errors
from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.diagnosis.prolog.program import Program, export, read_rules
from amberbox.diagnosis.prolog.query import Answers, Want, answer_text, ask
from amberbox.diagnosis.prolog.terms import RuleError, RuleFault, show_key

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
    """Read the files, then export or query them; without either, list what is defined."""
    if (args.why or args.why_not) and args.ask is None:
        raise UsageError("--why and --why-not explain an answer", "add --ask GOAL")
    if args.steps < 1 or args.seconds <= 0:
        raise UsageError("--steps and --seconds must be above 0")
    if args.where is None and (args.from_, args.to) != (None, None):
        raise UsageError("--from and --to are about a record", "add --where WHERE")
    if args.where is None and not args.files:
        raise UsageError("there are no rules", "name files, or a robot folder with --where")
    if is_url(args.where):
        return _run_on_server(args)
    place = rule_target(args.where) if args.where is not None else None
    files = [Path(name) for name in args.files] or (place.rules if place is not None else [])
    if not files and args.ask is None and args.export is None:
        raise UsageError(f"there are no rules/*.pl in {args.where}", "name files, or --ask GOAL")
    program = read_rules(files)
    if not args.json:
        for note in program.notes:
            print(note, file=sys.stderr)
    raise_errors(program.problems())
    if args.export is None and args.ask is None:
        _list(program, as_json=args.json)
        return 0
    with _record(place) as record:
        return _answer(_with_facts(program, place, record, args), args)


@contextmanager
def _record(place: RuleTarget | None) -> Iterator[Record | None]:
    """Open the record of a place; yield None if there is none."""
    if place is None or not place.has_record():
        if place is not None:
            print_notes(
                [f"no record at {place.path}: nothing is known of missions, statuses, conditions"]
            )
        yield None
        return
    with opened(str(place.path)) as record:
        yield record


def _with_facts(
    program: Program, place: RuleTarget | None, record: Record | None, args: argparse.Namespace
) -> Program:
    if place is None:
        return program
    span: tuple[int | None, int | None] = (None, None)
    if record is not None:
        span = span_of(args, record)
    return rule_facts(place, record, span).added_to(program)


def _answer(program: Program, args: argparse.Namespace) -> int:
    if args.export is not None:
        writable(args.export).write_text(_exported(program, args.ask or ""), encoding="utf-8")
    if args.ask is None:
        if args.json:
            print_json(_NOTHING.to_json())
        return 0
    budget = budget_of(args, steps=args.steps)
    want: Want = "why" if args.why else "why_not" if args.why_not else None
    found = ask(program, args.ask, budget, want)
    if args.json:
        print_json(found.to_json())
    else:
        for number, answer in enumerate(found.answers):
            print(answer_text(answer))
            for node in found.proof[number] if found.proof else ():
                print("\n".join(f"  {line}" for line in node.text().splitlines()))
        for failure in found.failed:
            print("\n".join(failure.lines()))
        if not found.answers and not found.failed:
            print("no")
    return 0


def _exported(program: Program, goal: str) -> str:
    try:
        return export(program, goal)
    except RuleFault as fault:
        raise RuleError(fault.what, fault.hint) from fault


def _list(program: Program, *, as_json: bool) -> None:
    if as_json:
        print_json(_NOTHING.to_json())
        return
    for key, predicate in sorted(program.predicates.items()):
        rules = sum(clause.body is not None for clause in predicate.clauses)
        facts = len(predicate.clauses) - rules
        tabled = ", tabled" if predicate.tabled else ""
        print(f"{show_key(key)}: {facts} facts, {rules} rules{tabled}")


def _run_on_server(args: argparse.Namespace) -> int:
    """Query the rules of a robot on a server."""
    if args.files or args.export:
        raise UsageError("a server asks the rules that the robot has", "leave out files, --export")
    if args.ask is None:
        raise UsageError("a server is asked a goal", "--ask 'broken(X)'")
    want = "why_not" if args.why_not else "why" if args.why else ""
    check_time("--from", args.from_)
    check_time("--to", args.to)
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.rules(robot, args.ask, want, args.from_, args.to)
    print_notes(found["notes"])
    if args.json:
        print_json({name: found[name] for name in ("answers", "proof", "failed")})
    else:
        print("\n".join(_server_answers(found)))
    return 0


def _server_answers(found: Mapping[str, Any]) -> Iterator[str]:
    for number, answer in enumerate(found["answers"]):
        yield ", ".join(f"{name} = {value}" for name, value in answer.items()) or "yes"
        for node in found["proof"][number] if found["proof"] else ():
            yield from _server_proof(node, "  ")
    for failure in found["failed"]:
        yield from _server_failure(failure, "")
    if not found["answers"] and not found["failed"]:
        yield "no"


def _server_proof(node: Mapping[str, Any], indent: str) -> Iterator[str]:
    kind = "" if node["by"] in ("builtin", "lookup") else node["by"]
    source = ", ".join(filter(None, (kind, node.get("at", ""))))
    again = "   (shown above)" if node.get("shown_above") else f"   {source}" if source else ""
    yield f"{indent}{node['goal']}{again}"
    for below in node.get("because", ()):
        yield from _server_proof(below, f"{indent}  ")


def _server_failure(failure: Mapping[str, Any], indent: str) -> Iterator[str]:
    yield f"{indent}fails: {failure['goal']}   {failure['what']}".rstrip()
    for tried in failure["tried"]:
        yield f"{indent}  {tried['head']}   {tried['at']}"
        yield from (f"{indent}    holds: {goal}" for goal in tried["held"])
        yield from _server_failure(tried["failed"], f"{indent}    ")
