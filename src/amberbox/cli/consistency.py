"""Consistency-based diagnosis: which modes of components agree with observations."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar, get_args

from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.query.record_window import RecordWindow
from amberbox.cli._arguments import (
    accept_relative_times,
    add_seconds,
    budget_of,
    refuse_options,
    robot_at,
    time_of,
)
from amberbox.cli._models import add_model, model_path
from amberbox.cli._output import print_json, print_lines, print_notes
from amberbox.client.address import is_url
from amberbox.core.clock import NS
from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time
from amberbox.diagnosis.consistency.answers import answer_json, observed_values, question_about
from amberbox.diagnosis.consistency.components import (
    Components,
    Step,
    load_components,
    read_value,
    value_text,
)
from amberbox.diagnosis.consistency.history import History
from amberbox.diagnosis.consistency.online import (
    Observed,
    history_s,
    observed_steps,
    question_of,
    seen_text,
)
from amberbox.diagnosis.consistency.question import Answer, Minimal, ask
from amberbox.diagnosis.consistency.recovery import MOST_COMMANDED, Goal, Plan, read_goal
from amberbox.diagnosis.consistency.trajectories import Moves, Times
from amberbox.diagnosis.evidence.consistency import bound_models

T = TypeVar("T")

_USAGE = (
    "amberbox consistency MODEL.yaml|FILE.bench [--observe NAME=VALUE...] [--times] "
    "[--reach NAME=VALUE... [--safe]] | WHERE [NAME] [--at T] [--folder FOLDER], "
    "[--minimal subset|cardinality|rank] [--most N] [--seconds S] [--json]"
)
_HINT = "models with observe: are, see docs/robot/consistency.md"
_FILES = (".yaml", ".yml", ".bench")
_MOST = 1_000
_SECONDS = 60.0
_SHOWN = 20


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.usage = _USAGE
    add_model(parser, "MODEL.yaml|FILE.bench")
    parser.add_argument("--at", metavar="T", help="as it was then, of a record: ISO (UTC), epoch, "
                        "-10m before the last record, now or now-10m")  # fmt: skip
    parser.add_argument("--folder", metavar="FOLDER", help="robot folder with the models, where "
                        "WHERE is none")  # fmt: skip
    parser.add_argument(
        "--observe", nargs="+", action="extend", default=[], metavar="NAME=VALUE",
        help="what was observed at component.port, or at a signal of a circuit (0 or 1); in every "
        "step of the model, where modes change with time in the last one",
    )  # fmt: skip
    parser.add_argument(
        "--minimal", choices=get_args(Minimal), default="subset",
        help="the diagnoses that contain no other, with all conflicts (subset, the default); only "
        "those with the fewest faults (cardinality), or of the most probable rank (rank)",
    )  # fmt: skip
    parser.add_argument("--times", action="store_true", help="in which steps the faults may have "
                        "happened, and in how many ways")  # fmt: skip
    parser.add_argument(
        "--reach", nargs="+", action="extend", default=[], metavar="NAME=VALUE",
        help="the commands that bring a component to a mode, or component.port to a value: the "
        "fewest steps, for the most probable diagnosis",
    )  # fmt: skip
    parser.add_argument(
        "--safe", action="store_true",
        help="commands for --reach that do it with each of the diagnoses",
    )  # fmt: skip
    parser.add_argument(
        "--most", type=int, default=_MOST, metavar="N",
        help=f"at most N diagnoses, and as many conflicts (default {_MOST:,})",
    )  # fmt: skip
    parser.add_argument(
        "--solver", choices=["python", "clingo"], default="",
        help="which solver is used for a file; without: clingo where it is installed",
    )  # fmt: skip
    add_seconds(parser, _SECONDS)
    parser.add_argument("--json", action="store_true", help="one object")


@dataclass
class _Found:
    """An answer, and where time matters what is known of it over time."""

    answer: Answer = field(default_factory=Answer)
    history: History | None = None
    times: list[Times] | None = None
    goal: Goal | None = None
    plan: Plan | None = None
    incomplete: str = ""


def run(args: argparse.Namespace) -> int:
    """Diagnose and show; return 1 when the search ended early, or nothing reaches the goal."""
    if args.most < 1:
        raise UsageError("--most is at least 1")
    if args.safe and not args.reach:
        raise UsageError("--safe is about the commands for --reach", "--reach NAME=VALUE --safe")
    if is_url(args.where):
        return _run_on_server(args)
    path = Path(args.where)
    if path.suffix not in _FILES or path.is_dir():
        models = bound_models(Path(args.folder or args.where))
        is_about_file = args.observe or args.times or args.reach
        if models and not is_about_file and (not args.name or args.name in models):
            return _run_on_record(args, models)
        path = model_path(args.folder or args.where, "components", args.name)
    elif args.folder or args.name:
        raise UsageError(f"{path} is a file: NAME and --folder are for a record", _USAGE)
    if args.at:
        raise UsageError(f"{path} is not evaluated over a record: --at means nothing", _HINT)
    found = _found(args, path)
    found.incomplete = found.answer.incomplete or found.incomplete
    if args.json:
        print_json(_as_json(path, found))
    else:
        print_lines(_as_text(found, args))
    if found.incomplete:
        print_notes([f"incomplete: {found.incomplete}; --most and --seconds allow more"])
    return 1 if found.incomplete or (found.goal and found.plan is None) else 0


def _run_on_server(args: argparse.Namespace) -> int:
    """Show what a server answers about a model with its steps."""
    given = {"seconds": args.seconds != _SECONDS, "at": args.at, "folder": args.folder,
             "times": args.times, "reach": args.reach, "solver": args.solver}  # fmt: skip
    refuse_options(args.where, given, "they are for a model on this computer")
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.consistency(
            robot, args.name, args.observe, minimal=args.minimal, most=args.most
        )
    if args.json:
        print_json(found)
    else:
        ranked = list(zip(found["ranks"], found["diagnoses"], strict=True))
        answer = Answer(ranked, found["conflicts"], found["incomplete"])
        print_lines(_diagnoses_text(_Found(answer, incomplete=found["incomplete"]), args.minimal))
    if found["incomplete"]:
        print_notes([f"incomplete: {found['incomplete']}"])
    return 1 if found["incomplete"] else 0


def _run_on_record(args: argparse.Namespace, models: Mapping[str, Components]) -> int:
    """Show the diagnoses of a robot's models at an instant of its record; return 1 with faults."""
    wanted = {args.name: models[args.name]} if args.name else models
    with open_record(args.where) as record:
        print_notes(record.notes)
        at_ns = record.last_ns() if args.at is None else time_of("--at", args.at, record.time_ns)
        if at_ns is None:
            raise UsageError(f"{args.where} has no record", "amberbox record FOLDER makes one")
        found = {name: _at(record, model, at_ns, args) for name, model in wanted.items()}
    if args.json:
        print_json({"at_ns": at_ns, "models": {name: one.as_json() for name, one in found.items()}})
    else:
        for name, one in found.items():
            print_lines([f"{name} at {format_time(at_ns)[:19]}:", *one.as_text(args.minimal)])
    return 1 if any(one.answer.diagnoses != [(0, [])] for one in found.values()) else 0


@dataclass(frozen=True)
class _AtInstant:
    """The diagnoses of a model at an instant of a record, from its last steps."""

    observed: Observed
    answer: Answer

    def as_json(self) -> dict[str, object]:
        last = self.observed.steps[-1:]
        return {
            "observed": {name: value for step in last for name, value in step.observe.items()},
            "commands": {name: value for step in last for name, value in step.commands.items()},
            "steps": len(self.observed.steps),
            **answer_json(self.answer),
        }  # fmt: skip

    def as_text(self, minimal: Minimal) -> Iterator[str]:
        if self.observed.is_empty:
            yield "nothing of it was recorded then, or its values were changing"
            return
        yield f"observed: {', '.join(seen_text(self.observed.steps[-1]))}"
        yield from _diagnoses_text(_Found(self.answer), minimal)


def _at(record: Record, model: Components, at_ns: int, args: argparse.Namespace) -> _AtInstant:
    past = RecordWindow(record, at_ns - round(history_s(model) * NS), at_ns + 1)
    observed = observed_steps(model, past, at_ns)
    budget = budget_of(args)
    question = question_of(model, observed.steps, budget)
    return _AtInstant(observed, ask(question, args.minimal, args.most, budget))


def _found(args: argparse.Namespace, path: Path) -> _Found:
    budget = budget_of(args)
    about_time = args.times or args.reach
    if path.suffix == ".bench" and about_time:
        raise UsageError("a circuit knows no time", "--times and --reach are for models")
    model = None if path.suffix == ".bench" else load_components(path)
    if model is None or not model.is_timed:
        if about_time:
            raise UsageError(
                f"{path}: modes do not change in this model",
                "--times and --reach need initial: and transitions:",
            )
        question = question_about(path, args.observe, budget, args.solver)
        return _Found(ask(question, args.minimal, args.most, budget))
    seen = observed_values(args.observe, lambda name, text: read_value(text, name, model))
    goal = read_goal(args.reach, model) if args.reach else None
    last = [replace(step, observe={**step.observe, **seen}) for step in model.steps[-1:]]
    if seen and not last:
        raise UsageError("--observe: the model has no step", "write steps: [{observe: {}}]")
    return _over_time(args, [*model.steps[:-1], *last], goal, model, budget)


def _over_time(
    args: argparse.Namespace,
    steps: Sequence[Step],
    goal: Goal | None,
    model: Components,
    budget: Budget,
) -> _Found:
    found = _Found(goal=goal)
    try:
        found.history = history = History.of(model, steps, budget)
        found.answer = ask(history.question(budget, args.solver), args.minimal, args.most, budget)
        _take_times(args, found, history, budget)
    except OutOfTimeError:
        found.incomplete = "time was up"
    return found


def _take_times(args: argparse.Namespace, found: _Found, history: History, budget: Budget) -> None:
    diagnoses = found.answer.diagnoses
    moves = Moves(history.model, budget)
    if args.times:
        found.times = [history.times(moves, names, rank) for rank, names in diagnoses]
    if found.goal is None or not diagnoses:
        return
    wanted = diagnoses if args.safe else [min(diagnoses, key=lambda one: one[0])]
    times = [history.times(moves, names, rank) for rank, names in wanted]
    recovery = history.plan(times, found.goal, budget)
    found.plan, found.incomplete = recovery.plan, recovery.incomplete


def _as_json(path: Path, found: _Found) -> dict[str, object]:
    answer, history = found.answer, found.history
    shown: dict[str, object] = {
        "model": str(path), "conflicts": answer.conflicts,
        "diagnoses": [names for _, names in answer.diagnoses],
        "ranks": [rank for rank, _ in answer.diagnoses], "rank": answer.rank,
        "count": len(answer.diagnoses), "time_variants": None, "incomplete": found.incomplete,
    }  # fmt: skip
    if found.times is not None:
        shown["time_variants"] = sum(one.variants for one in found.times)
        shown["times"] = [
            {"variants": one.variants, "earliest": dict(sorted(one.first.items())),
             "latest": dict(sorted(one.last.items()))}
            for one in found.times
        ]  # fmt: skip
    if history is not None:
        shown["probabilities"] = history.probabilities(answer.diagnoses, found.times or ())
        shown["steps_forgotten"], shown["pruned"] = history.forgotten, history.pruned
    if found.goal is not None:
        shown["plan"] = None if found.plan is None else [dict(step) for step in found.plan]
    return shown


def _as_text(found: _Found, args: argparse.Namespace) -> Iterator[str]:
    yield from _diagnoses_text(found, args.minimal)
    if found.history is not None and found.history.forgotten:
        least = "at least " if found.history.is_cut else ""
        yield (
            f"of the first {found.history.forgotten:,} steps {len(found.history.starts):,} states "
            f"are remembered; {least}{found.history.pruned:.2g} of their probability was dropped"
        )
    if found.goal is not None and not found.incomplete:
        yield from _plan_text(found, "each of the diagnoses" if args.safe else "the most probable "
                              "diagnosis")  # fmt: skip


def _diagnoses_text(found: _Found, minimal: Minimal) -> Iterator[str]:
    answer = found.answer
    if answer.diagnoses == [(0, [])]:
        yield "no fault: the nominal modes agree with what was observed"
        return
    if not answer.diagnoses and not found.incomplete:
        yield "no modes agree with what was observed: the model or an observation is wrong"
        return
    which = {"subset": "", "cardinality": " with the fewest faults", "rank": " of the least rank"}
    yield f"diagnoses{which[minimal]}: {len(answer.diagnoses):,}"
    times: Sequence[Times | None] = found.times or [None] * len(answer.diagnoses)
    by_rank = sorted(zip(answer.diagnoses, times, strict=True), key=lambda one: one[0][0])
    yield from _shown(
        [
            f"{', '.join(names)}  (rank {rank})" + ("" if of is None else f": {_times_text(of)}")
            for (rank, names), of in by_rank
        ]
    )
    yield "conflicts, in each of which something is faulty" + (
        f": {len(answer.conflicts):,}" if minimal == "subset" else ", one of them:"
    )
    yield from _shown([", ".join(names) for names in answer.conflicts])


def _times_text(times: Times) -> str:
    def of(name: str) -> str:
        first, last = times.first[name], times.last[name]
        steps = f"step {first}" if first == last else f"steps {first} to {last}"
        return f"{name} in {steps}" if len(times.first) > 1 else f"in {steps}"

    ways = f"{times.variants:,} way{'' if times.variants == 1 else 's'}"
    return f"{', '.join(map(of, sorted(times.first)))} ({ways})"


def _plan_text(found: _Found, whom: str) -> Iterator[str]:
    if found.plan is None:
        yield f"no commands of up to {MOST_COMMANDED} steps are certain to reach it with {whom}"
    elif not found.plan:
        yield f"it is reached already, with {whom}"
    else:
        yield f"commands that reach it with {whom}:"
        for number, step in enumerate(found.plan, 1):
            given = ", ".join(f"{name}={value_text(value)}" for name, value in step.items())
            yield f"  {number}. {given or 'wait'}"


def _shown(lines: Sequence[str]) -> Iterator[str]:
    yield from (f"  {line}" for line in lines[:_SHOWN])
    if len(lines) > _SHOWN:
        yield f"  and {len(lines) - _SHOWN:,} more (--json shows all)"
