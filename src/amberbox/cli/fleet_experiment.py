"""Experiments and unit tests of robots by their server: lists, runs, reports, comparisons."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.cli._arguments import refuse_options, robot_at
from amberbox.cli._output import print_json, print_lines, print_listing, print_notes
from amberbox.cli.experiment_runs import (
    FORMATS,
    print_comparison,
    report_lines,
    report_target,
    show_report,
)
from amberbox.cli.fleet_run import FollowedRun, Signer, run_text, signer_of
from amberbox.client.address import read_address
from amberbox.core.errors import ConfigurationError, UsageError, did_you_mean
from amberbox.core.interrupt import Interrupt
from amberbox.core.safe_text import one_line
from amberbox.core.timestamps import NS
from amberbox.experiments.action import values_of_words
from amberbox.experiments.profile import SUFFIX, read_experiment
from amberbox.experiments.report import Comparison, RunReport
from amberbox.experiments.step_list import duration_text

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import ExperimentLine, RunDetail, RunLine

_SERVER = "a server: https://fleet.example:8443"
_RUNS = ("run", "robot", "created (UTC)", "experiment", "state", "who", "reason")
_EXPERIMENTS = ("experiment", "title", "people", "duration", "from", "state")


def add_verbs(verbs: Any) -> None:
    """Add the actions that only servers have to the parser of ``amberbox experiment``."""
    what = "keep experiments on a server, to be run on any of its robots"
    upload = verbs.add_parser("upload", help=what, description=what)
    upload.add_argument("where", metavar="URL", help=_SERVER)
    upload.add_argument("files", nargs="+", metavar="FILE", help="NAME.bpmn; the files that it "
                        "needs go with it")  # fmt: skip
    what = "take an uploaded experiment from the list of a server"
    withdraw = verbs.add_parser("withdraw", help=what, description=what)
    withdraw.add_argument("where", metavar="URL", help=_SERVER)
    withdraw.add_argument("name", metavar="NAME", help="its name; its runs stay")


def run_on_server(args: argparse.Namespace) -> int:
    """Do what the action says with WHERE as the address of a server."""
    if args.action not in _ACTIONS:
        what = f"experiment {args.action} takes files, not the address of a server"
        raise UsageError(what, f"with a server: {', '.join(_ACTIONS)}")
    return _ACTIONS[args.action](args)


def refuse_at_robot(args: argparse.Namespace) -> None:
    """Raise UsageError for an action or options that only mean something on a server."""
    options = {"queue": "--queue", "sign": "--sign", "key": "--key", "role": "--as"}
    given = [option for name, option in options.items() if vars(args).get(name)]
    if args.action in ("upload", "withdraw"):
        given = [f"experiment {args.action}"]
    if given:
        hint = "https://fleet.example:8443, of a robot https://fleet.example:8443/robots/ropod_001"
        raise UsageError(f"{', '.join(given)} goes with the address of a server", hint)


def _list_experiments(args: argparse.Namespace) -> int:
    """List the experiments that a robot can run; of a server alone, those uploaded."""
    refuse_options(args.where, {"folder": args.folder}, "its robots know their actions")
    from amberbox.client.fleet import Fleet

    with Fleet(args.where) as fleet:
        found = fleet.experiments(read_address(args.where).robot)
    nothing = "no experiments"
    print_listing(found, msgspec.to_builtins, _EXPERIMENTS, _row, nothing, as_json=args.json)
    return 0


def _row(line: ExperimentLine) -> Sequence[Any]:
    duration = "-" if line.duration_s is None else duration_text(int(line.duration_s * NS))
    origin = "its folder" if line.robot else f"uploaded by {line.who}"
    state = f"{len(line.problems)} errors" if line.problems else "fine"
    return (line.name, one_line(line.title), ", ".join(line.roles) or "-", duration, origin, state)


def _run(args: argparse.Namespace) -> int:
    hint = "at the robot: amberbox experiment run FOLDER"
    given = {"simulated": args.simulated, "who": args.who, "no-answer": args.no_answer}
    refuse_options(args.where, given, hint)
    target = None if args.report is None else report_target(args.report)
    signer = signer_of(args)
    fleet, robot = robot_at(args.where)
    with fleet:
        values = values_of_words(_kinds(fleet, robot, args.name), args.parameters)
        line = fleet.start_run(robot, args.name, values, repeats=args.repeat, queue=args.queue)
        if line.state == "planned":
            print_lines([f"run {line.id} is planned: begin it when {robot} is there: "
                         f"amberbox experiment resume {args.where} {line.id}"])  # fmt: skip
            return 0
        return _follow(args, fleet, line, signer, target)


def _kinds(fleet: Fleet, robot: str, name: str) -> Mapping[str, str]:
    """Return the kinds of an experiment's parameters; print what is to be minded."""
    known = {one.name: one for one in fleet.experiments(robot)}
    if name not in known:
        hint = f"known: {', '.join(known)}" if known else "amberbox experiment upload URL FILE"
        raise UsageError(f"{robot} has no experiment '{name}'{did_you_mean(name, known)}", hint)
    if known[name].safety:
        print_lines([f"mind: {one_line(known[name].safety)}"])
    return {one.name: one.type for one in known[name].parameters}


def _resume(args: argparse.Namespace) -> int:
    """Begin a planned run, or take part in one that goes on."""
    refuse_options(args.where, {"who": args.who}, "on a server it is who has signed in")
    signer = signer_of(args)
    fleet, robot = robot_at(args.where)
    with fleet:
        line = fleet.run(robot, args.run).run
        if line.state == "planned":
            line = fleet.begin_run(robot, args.run)
        if line.is_over:
            raise UsageError(f"the run {line.id} is over: {line.state}", "begin another one")
        return _follow(args, fleet, line, signer, None)


def _follow(
    args: argparse.Namespace, fleet: Fleet, line: RunLine, signer: Signer | None, target: Any
) -> int:
    """Take part in a run and those that repeat it; print the verdicts, return the exit status."""
    ended: list[RunLine] = []
    roles = (args.role,) if args.role else ("technician", "operator")
    following: RunLine | None = line
    while following is not None:
        print_lines([f"run {following.id}: {one_line(following.title)}"])
        followed = FollowedRun(fleet, following.robot, following.id, signer, roles)
        detail = followed.follow()
        ended.append(detail.run)
        print_lines(_verdict_lines(fleet, detail))
        if followed.interrupted:
            return Interrupt.STATUS
        following = _next(fleet, detail.run)
    if target is not None:
        kind = FORMATS[target.suffix.lower()]
        target.write_bytes(fleet.run_report(line.robot, ended[-1].id, kind))
    if len(ended) > 1:
        compared = fleet.compare_runs(line.robot, [one.id for one in ended])
        print_comparison(msgspec.convert(compared, Comparison))
    return 0 if all(one.state == "passed" for one in ended) else 1


def _verdict_lines(fleet: Fleet, detail: RunDetail) -> list[str]:
    line = detail.run
    if line.begun is None or not line.is_over:
        return [f"{run_text(line.state)} {line.reason}".rstrip()]
    report = RunReport.from_json(fleet.run_report(line.robot, line.id))
    if line.state == report.verdict:
        return report_lines(report)
    return [f"verdict: {run_text(line.state)}: {line.reason}", *report_lines(report)[1:]]


def _next(fleet: Fleet, line: RunLine) -> RunLine | None:
    """Return the run that repeats one, if it has begun by itself."""
    if not line.left:
        return None
    newest = fleet.runs(line.robot, series=line.series, limit=1)
    if not newest or newest[0].number <= line.number:
        print_notes([f"{line.left} more runs were wanted: they are not begun after this one"])
        return None
    if newest[0].state == "planned":
        print_notes([f"the next run waits: amberbox experiment resume ... {newest[0].id}"])
        return None
    return newest[0]


def _list_runs(args: argparse.Namespace) -> int:
    from amberbox.client.fleet import Fleet

    with Fleet(args.where) as fleet:
        found = fleet.runs(read_address(args.where).robot)
    print_listing(found, msgspec.to_builtins, _RUNS, _run_row, "no runs", as_json=args.json)
    return 0


def _run_row(line: RunLine) -> Sequence[Any]:
    state = run_text(line.state)
    return line.id, line.robot, line.created[:19], line.name, state, line.who, line.reason


def _show(args: argparse.Namespace) -> int:
    fleet, robot = robot_at(args.where)
    with fleet:
        line = fleet.run(robot, args.run).run
        if line.begun is None:
            print_listing([line], msgspec.to_builtins, _RUNS, _run_row, "", as_json=args.json)
            return 0
        report = RunReport.from_json(fleet.run_report(robot, line.id))
    if not args.json and line.state != report.verdict:
        print_lines([f"{run_text(line.state)} {line.reason}".rstrip()])
    return show_report(report, as_json=args.json)


def _report(args: argparse.Namespace) -> int:
    target = report_target(args.output)
    fleet, robot = robot_at(args.where)
    with fleet:
        target.write_bytes(fleet.run_report(robot, args.run, FORMATS[target.suffix.lower()]))
    print(f"wrote {target}")
    return 0


def _compare(args: argparse.Namespace) -> int:
    fleet, robot = robot_at(args.where)
    with fleet:
        runs = [run for word in args.runs for run in _runs_of(fleet, robot, word)]
        compared = fleet.compare_runs(robot, runs, args.since, args.software)
    if args.json:
        print_json(compared)
    else:
        print_comparison(msgspec.convert(compared, Comparison))
    return 0


def _runs_of(fleet: Fleet, robot: str, word: str) -> list[str]:
    """Return a run, or those of an experiment that are over and whose files are the newest."""
    found = [one for one in fleet.runs(robot, name=word) if one.is_over and one.begun is not None]
    return [one.id for one in found if one.sha256 == found[0].sha256] or [word]


def _upload(args: argparse.Namespace) -> int:
    """Upload experiments, with those that they call; all are judged before the first is sent."""
    from amberbox.client.fleet import Fleet

    packed = {path: _packed(Path(path)) for path in args.files}
    with Fleet(args.where) as fleet:
        for path, files in packed.items():
            line = fleet.upload_experiment(Path(path).name.removesuffix(SUFFIX), files)
            print_lines([f"{line.name}: {one_line(line.title)} ({', '.join(sorted(files))})"])
    return 0


def _packed(path: Path) -> dict[str, bytes]:
    """Return the files that an experiment needs, by name; raises ConfigurationError."""
    if not path.is_file():
        raise UsageError(f"there is no file '{path}'", "name a BPMN file")
    experiment, problems = read_experiment(path)
    if experiment is None:
        raise ConfigurationError([problem for problem in problems if problem.is_error])
    return {file.name: file.read_bytes() for file in experiment.all_files}


def _withdraw(args: argparse.Namespace) -> int:
    from amberbox.client.fleet import Fleet

    with Fleet(args.where) as fleet:
        fleet.withdraw_experiment(args.name)
    print(f"withdrawn: {args.name}")
    return 0


_ACTIONS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "list": _list_experiments, "upload": _upload, "withdraw": _withdraw, "run": _run,
    "resume": _resume, "runs": _list_runs, "show": _show, "report": _report, "compare": _compare,
}  # fmt: skip
