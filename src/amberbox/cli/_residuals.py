"""Residuals of a model over records, for the verb ``structure``: violations, thresholds."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from amberbox.cli._arguments import budget_of, opened
from amberbox.cli._output import print_json, print_lines, print_notes
from amberbox.core.clock import NS
from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.core.equations.generator import (
    Differentiated,
    NoResidualError,
    ResidualGenerator,
    Solved,
    Step,
    derived,
)
from amberbox.core.equations.model_file import (
    EquationModel,
    ResidualOptions,
    load_model,
    structure_of,
)
from amberbox.core.equations.structure import bits
from amberbox.core.errors import UsageError
from amberbox.core.expression import Expression
from amberbox.core.timestamps import format_time
from amberbox.core.yaml_nodes import load_yaml
from amberbox.detection.residuals import ResidualReport, residual_reports, with_thresholds
from amberbox.diagnosis.structure.submodels import mso_sets

_MOST_RESIDUALS = 200  # that are derived from minimal sets at once
_SHOWN = 20


def add_options(parser: argparse.ArgumentParser, what: argparse._MutuallyExclusiveGroup) -> None:
    """Add ``--residuals`` to the questions of the verb, and the options that go with it."""
    what.add_argument(
        "--residuals", nargs="+", metavar="WHERE",
        help="compute residuals over records: robot folders, stores or recordings",
    )  # fmt: skip
    parser.add_argument(
        "--missions", nargs="+", default=[], metavar="NAME",
        help="with --residuals: names or ids of missions; without: all that did not fail, else "
        "the record",
    )  # fmt: skip
    parser.add_argument(
        "--learn", action="store_true",
        help="with --residuals: thresholds from these missions, which are nominal, as a diff",
    )  # fmt: skip
    parser.add_argument(
        "--quantile", type=float, default=1.0, metavar="Q",
        help="with --learn: of the sizes that lasted (default 1: the greatest)",
    )  # fmt: skip
    parser.add_argument(
        "--margin", type=float, default=1.5, metavar="M",
        help="with --learn: the threshold is so many times the quantile (default 1.5)",
    )  # fmt: skip
    parser.add_argument(
        "--apply", action="store_true", help="with --learn: write them into the model's file"
    )


def check_options(args: argparse.Namespace) -> None:
    """Raise UsageError for options that do not belong together."""
    if not args.residuals and (args.learn or args.apply or args.missions):
        raise UsageError("--learn, --apply and --missions belong to --residuals WHERE")
    if args.apply and not args.learn:
        raise UsageError("--apply belongs to --learn")
    if not 0 < args.quantile <= 1:
        raise UsageError("--quantile must lie above 0, and be 1 at most")
    if not 1 <= args.margin < 1_000:
        raise UsageError("--margin must be 1 or more")


def run(path: Path, args: argparse.Namespace) -> int:
    """Compute a model's residuals over records; return 1 where one was violated, or time was up."""
    model, budget = load_model(path), budget_of(args)
    generators, refused, incomplete = _generators(model, budget)
    with ExitStack() as stack:
        records = [stack.enter_context(opened(where)) for where in args.residuals]
        reports = residual_reports(records, generators, args.missions)
    diff = _learn(model, path, reports, args) if args.learn else ""
    if args.json:
        shown = [_as_json(report, args) for report in reports]
        document: dict[str, Any] = {"model": str(path), "residuals": shown, "refused": refused}
        document |= {"incomplete": incomplete}
        print_json(document | ({"diff": diff} if args.learn else {}))
    else:
        print_lines(_report_lines(reports, args))
        print_lines(f"{name}: {why}" for name, why in refused.items())
        print(diff, end="")
    if incomplete:
        print_notes([f"incomplete: {incomplete}"])
    violated = not args.learn and any(report.violations for report in reports)
    return 1 if violated or incomplete else 0


def _generators(
    model: EquationModel, budget: Budget
) -> tuple[list[ResidualGenerator], dict[str, str], str]:
    """Return the residuals that a model lists, else one of each minimal set; what is refused."""
    asked, incomplete = dict(model.residuals), ""
    if not asked:
        structure = structure_of(model)
        sets: list[list[str]] = []
        try:
            for mask in mso_sets(structure, budget):
                if len(sets) == _MOST_RESIDUALS:
                    incomplete = f"there are more than {_MOST_RESIDUALS} minimal sets"
                    break
                sets.append([structure.equations[number] for number in bits(mask)])
        except OutOfTimeError:
            incomplete = f"the time was up after {len(sets):,} sets; --seconds allows more"
        sets.sort(key=lambda one: (len(one), one))
        asked = {f"r{number}": ResidualOptions(one) for number, one in enumerate(sets, 1)}
    found, refused = [], {}
    for name, options in asked.items():
        try:
            found.append(derived(model, name, options))
        except NoResidualError as error:
            of = "" if name in model.residuals else f" ({', '.join(options.equations)})"
            refused[f"{name}{of}"] = error.what
    return found, refused, incomplete


def _learn(
    model: EquationModel, path: Path, reports: Sequence[ResidualReport], args: argparse.Namespace
) -> str:
    """Return the change of the model's file as a diff; write it where that is wanted."""
    learnt = {r.generator.name: r.learnt(args.quantile, args.margin) for r in reports}
    known = {name: value for name, value in learnt.items() if value is not None}
    new = {
        report.generator.name: f"{{equations: [{', '.join(report.generator.equations)}], "
        f"checks: {report.generator.checks}, threshold: {known[report.generator.name]:g}}}"
        for report in reports
        if report.generator.name in known and report.generator.name not in model.residuals
    }
    root = load_yaml(path, [])
    assert root is not None, "the model has been read"
    text = path.read_bytes().decode("utf-8-sig")
    changed = with_thresholds(text, root, known, new)
    lines = difflib.unified_diff(
        text.splitlines(keepends=True), changed.splitlines(keepends=True), path.name, path.name
    )
    diff = "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)
    if args.apply and diff:
        path.write_bytes(changed.encode())
    return diff


def _as_json(report: ResidualReport, args: argparse.Namespace) -> dict[str, Any]:
    generator = report.generator
    document = {
        "name": generator.name,
        "equations": list(generator.equations),
        "checks": generator.checks,
        "computes": [{"variable": s.name, "equation": s.equation} for s in generator.steps],
        "components": list(generator.components),
        "faults": list(generator.faults),
        "delay_s": generator.lead_ns / NS,
        "threshold": generator.options.threshold,
        "missing": list(report.missing),
        "watched_s": report.watched_s,
        "known_s": report.known_s,
        "excited_s": report.excited_s,
        "largest": report.quantile(1.0),
        "violations": report.violations,
        "listed": [
            {"from": format_time(v.from_ns), "to": format_time(v.to_ns), "size": v.size}
            for v in report.listed
        ],
    }
    return document | ({"learnt": report.learnt(args.quantile, args.margin)} if args.learn else {})


def _report_lines(reports: Sequence[ResidualReport], args: argparse.Namespace) -> Iterator[str]:
    for report in reports:
        generator, options = report.generator, report.generator.options
        yield f"{generator.name}: is the equation {generator.checks} as the others have it?"
        yield from (f"  {step.equation}: {_step_text(step)}" for step in generator.steps)
        yield f"  {generator.checks}: {_compared_text(generator)}"
        who = ", ".join((*generator.components, *generator.faults)) or "nothing is named"
        yield f"  sensitive to: {who}"
        if report.missing:
            yield f"  not recorded: {', '.join(report.missing)}"
            continue
        limit = "none yet" if options.threshold is None else f"{options.threshold:g}"
        delay, lasting = f"{generator.lead_ns / NS:g}", f"{options.persistence_s:g}"
        yield f"  delay {delay} s, threshold {limit} for {lasting} s"
        largest = report.quantile(1.0)
        yield (
            f"  of {report.watched_s:g} s known {report.known_s:g} s, excited "
            f"{report.excited_s:g} s; largest size "
            + ("none" if largest is None else f"{largest:.4g}")
        )
        if args.learn:
            learnt = report.learnt(args.quantile, args.margin)
            yield f"  learnt threshold: {learnt or 'none, it was never excited'}"
        elif options.threshold is not None:
            yield f"  violations: {report.violations}"
        for one in report.listed[:_SHOWN]:
            yield f"    {format_time(one.from_ns)} to {format_time(one.to_ns)}: {one.size:.4g}"
        if report.violations > _SHOWN:
            yield f"    and {report.violations - _SHOWN:,} more (--json shows them)"


def _compared_text(generator: ResidualGenerator) -> str:
    one = generator.compared
    if isinstance(one, Expression):
        return f"{one.text} is 0"
    return f"{one.name} is {_step_text(one).partition(' = ')[2]}"


def _step_text(step: Step) -> str:
    if isinstance(step, Solved):
        return f"{step.name} = {step.expression.text}"
    if isinstance(step, Differentiated):
        return f"{step.name} = derivative of {step.state} over {step.window_ns / NS:g} s"
    leak = f", leak {step.leak:g} per s" if step.leak else ""
    return (
        f"{step.name} = integral of {step.derivative} over {step.over_ns / NS:g} s from "
        f"{step.initial.text}{leak}"
    )
