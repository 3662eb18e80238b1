"""Runs of experiments at the robot: carry one out, go on with one, show, compare, report."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.query import record
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.retention.pins import mark
from amberbox.blackbox.robot_folder.folder import RobotFolder, load_folder
from amberbox.blackbox.store.derived_journal import DerivedJournal
from amberbox.blackbox.store.journal_reader import previous_chain
from amberbox.blackbox.store.store import Store, WriterLock, create_store, is_locked, store_path
from amberbox.cli._arguments import add_where, user_name
from amberbox.cli._output import in_columns, print_json, print_lines, print_notes, writable
from amberbox.cli.action import ActionPort
from amberbox.cli.experiment_terminal import Terminal
from amberbox.consult.run_answers import store_run_answers
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, ConfigurationError, UsageError, did_you_mean
from amberbox.core.files import replace_file
from amberbox.core.interrupt import Interrupt
from amberbox.core.timestamps import format_duration, format_to_second
from amberbox.core.version import __version__
from amberbox.experiments.action import accept_values, values_of_words
from amberbox.experiments.criteria import CriterionResult
from amberbox.experiments.drawing import draw_bpmn
from amberbox.experiments.experiment import FOLDER
from amberbox.experiments.live_values import LiveValues
from amberbox.experiments.local import (
    REPORT,
    WRITER,
    LocalRunner,
    RunFolder,
    row_of,
    run_folders,
)
from amberbox.experiments.procedure import Procedure, procedure_of
from amberbox.experiments.profile import SUFFIX, Experiment, list_experiments, read_experiment
from amberbox.experiments.report import Comparison, RunReport, compare, make_report
from amberbox.experiments.report_junit import junit
from amberbox.experiments.report_page import Diagram, report_page
from amberbox.experiments.run import ExperimentRun, RunEvent, element_states

_RECORD_WAIT_S = 5.0
_BEFORE_S, _AFTER_S = 5.0, 1.0


def add_verbs(verbs: Any) -> None:
    """Add the actions that concern runs to the parser of ``amberbox experiment``."""
    run = _verb(verbs, "run", _run, "carry out an experiment, in this terminal")
    run.add_argument("name", metavar="NAME", help="an experiment of the robot")
    run.add_argument("parameters", nargs="*", metavar="PARAMETER=VALUE", help="its parameters")
    run.add_argument("--simulated", action="store_true", help="actions as their twins, no robot")
    run.add_argument("--repeat", type=int, default=1, metavar="N", help="so many runs [1]")
    run.add_argument("--report", metavar="FILE", help="write the report: FILE.html, .json or .xml "
                     "(JUnit); of the last run")  # fmt: skip
    run.add_argument("--no-answer", action="store_true", help="leave the open diagnosis as it is, "
                     "even if it asks for such a test")  # fmt: skip
    run.add_argument("--queue", action="store_true", help="on a server: plan the run if the robot "
                     "is away")  # fmt: skip
    resume = _verb(verbs, "resume", _resume, "go on with a run: its process has ended; or, on a "
                   "server, begin a planned one, or take part in one")  # fmt: skip
    resume.add_argument("run", metavar="RUN", help="id of the run")
    for verb in (run, resume):
        verb.add_argument("--yes", action="store_true", help="do not ask before the robot moves")
        verb.add_argument("--who", default="", metavar="NAME", help="who does it; else the user")
        verb.add_argument("--sign", action="store_true", help="on a server: sign the commands of "
                          "the run; each is asked for, unless --yes")  # fmt: skip
        verb.add_argument("--key", default="", metavar="NAME", help="the key to sign with")
        verb.add_argument("--as", dest="role", choices=("technician", "operator"), help="on a "
                          "server: do only the steps of this role")  # fmt: skip
    runs = _verb(verbs, "runs", _list, "list the runs of a robot, or of all robots of a server")
    runs.add_argument("--json", action="store_true", help="print JSON")
    show = _verb(verbs, "show", _show, "show a run: verdict, criteria, steps, deviations")
    show.add_argument("run", metavar="RUN", help="id of the run")
    show.add_argument("--json", action="store_true", help="print JSON, with every event")
    report = _verb(verbs, "report", _report, "write the report of a run as one HTML page, as JSON "
                   "or as JUnit XML")  # fmt: skip
    report.add_argument("run", metavar="RUN", help="id of the run")
    report.add_argument("-o", "--output", required=True, metavar="FILE", help="FILE.html, .json "
                        "or .xml")  # fmt: skip
    side = _verb(verbs, "compare", _compare, "compare runs of one experiment")
    side.add_argument("runs", nargs="+", metavar="RUN", help="runs; or a NAME: all of it")
    side.add_argument("--since", default="", metavar="VERSION", help="change since this version")
    side.add_argument("--software", default="", metavar="NAME", help="whose version [robot]")
    side.add_argument("--json", action="store_true", help="print JSON, with the curves")


def _verb(
    verbs: Any, name: str, act: Callable[[argparse.Namespace], int], summary: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=summary, description=summary)
    add_where(parser, "robot folder")
    parser.set_defaults(act=act)
    return parser


def _store(args: argparse.Namespace) -> Path:
    path: Path = store_path(args.where)
    return path


def find_experiment(folder: Path, name: str) -> Experiment:
    """Return an experiment of a robot folder without errors.

    Raises UsageError if there is none of this name, ConfigurationError if something is wrong.
    """
    known = {path.name.removesuffix(SUFFIX): path for path in list_experiments(folder / FOLDER)}
    if name not in known:
        hint = f"known: {', '.join(known)}" if known else f"put a BPMN file into {FOLDER}/"
        raise UsageError(f"there is no experiment '{name}'{did_you_mean(name, known)}", hint)
    experiment, problems = read_experiment(known[name], folder)
    if experiment is None:
        raise ConfigurationError([problem for problem in problems if problem.is_error])
    return experiment


@dataclass
class _Site:
    """What runs at one robot have in common."""

    folder: RobotFolder
    store: Store
    journal: DerivedJournal
    port: ActionPort
    live: LiveValues
    who: str
    must_confirm: bool

    def runner(self, run: ExperimentRun, kept: RunFolder, terminal: Terminal) -> LocalRunner:
        """Return what carries a run on."""

        def keep(state: bytes, events: Sequence[RunEvent]) -> None:
            kept.save(state)
            self.journal.write([row_of(run, event, self.folder.robot.id) for event in events])

        return LocalRunner(
            run, self.port, terminal, self.who, keep, self.live.value, time.time_ns,
            must_confirm=self.must_confirm,
        )  # fmt: skip


def _site(args: argparse.Namespace, stack: ExitStack) -> _Site:
    folder = load_folder(args.where)
    store = create_store(folder.store_path)
    lock = WriterLock(store, WRITER)
    stack.callback(lock.release)
    journal = DerivedJournal(
        store, WRITER, robot=folder.robot.id, config_hash=folder.config_hash,
        chain=lambda: previous_chain(store, WRITER),
    )  # fmt: skip
    stack.callback(journal.close)
    is_simulated = getattr(args, "simulated", False)
    port = ActionPort(Path(args.where), simulated=is_simulated)
    who = args.who or user_name()
    must_confirm = not (args.yes or is_simulated)
    return _Site(folder, store, journal, port, LiveValues(store.path), who, must_confirm)


def _run(args: argparse.Namespace) -> int:
    if not 1 <= args.repeat <= 1000:
        raise UsageError("--repeat must be from 1 to 1000")
    target = None if args.report is None else report_target(args.report)
    experiment = find_experiment(Path(args.where), args.name)
    procedure = procedure_of(experiment)
    known = procedure.options.parameters
    given = values_of_words({name: one.kind for name, one in known.items()}, args.parameters)
    values = accept_values(known, given, procedure.name)
    reports: list[RunReport] = []
    with ExitStack() as stack:
        site, terminal = _site(args, stack), _terminal(procedure)
        for number in range(1, args.repeat + 1):
            about = {
                "versions": {"amberbox": __version__, "robot": site.folder.robot.software_version},
                "config_hash": site.folder.config_hash,
                "simulated": args.simulated,
                **({"repetition": f"{number} of {args.repeat}"} if args.repeat > 1 else {}),
            }
            run_id = _new_id(site.store.path, procedure.name)
            people: dict[str, str] = dict.fromkeys(experiment.person_roles, site.who)
            run = ExperimentRun.begin(
                procedure, run_id, site.folder.robot.id, values, people, time.time_ns(),
                who=site.who, about=about, live=site.live,
            )  # fmt: skip
            kept = RunFolder.make(site.store.path, run_id, experiment)
            print_lines([f"run {run_id}: {procedure.options.title}", *_safety(procedure)])
            report, is_interrupted = _carry_on(site, run, kept, terminal)
            reports.append(report)
            if not (args.no_answer or args.simulated):
                _answer(site.folder, report, site.who)
            if is_interrupted:
                return Interrupt.STATUS
            if report.verdict == "aborted":
                break
    if target is not None:
        _write_report(target, experiment, reports[-1])
    if len(reports) > 1:
        print_comparison(compare(reports))
    return 0 if all(report.verdict == "passed" for report in reports) else 1


def _answer(folder: RobotFolder, report: RunReport, who: str) -> None:
    """Leave what the verdict of a run answers to the open diagnosis."""
    if report.verdict in ("passed", "failed"):
        verdicts = {report.experiment: report.verdict}
        given = store_run_answers(folder, "experiment", verdicts, who)
        print_notes(f"{one.test} = {one.answer}: counts in the diagnosis {one.diagnosis}"
                    for one in given)  # fmt: skip


def _safety(procedure: Procedure) -> list[str]:
    return [f"mind: {procedure.options.safety}"] if procedure.options.safety else []


def _new_id(store: Path, name: str) -> str:
    """Return an id for a run: its experiment and the time, which no other run has."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    taken = {folder.path.name for folder in run_folders(store)}
    first = f"{name[:40]}-{stamp}"
    return next(
        one for one in (first, *(f"{first}-{n}" for n in range(2, 1000))) if one not in taken
    )


def _resume(args: argparse.Namespace) -> int:
    kept = RunFolder.find(_store(args), args.run)
    with ExitStack() as stack:
        site = _site(args, stack)
        procedure = procedure_of(kept.experiment())
        run = ExperimentRun.restore(procedure, kept.state(), site.live)
        if run.is_closed:
            raise UsageError(f"the run '{run.id}' is over: {run.outcome}", "begin another one")
        is_simulated = bool(run.events[0].values.get("simulated"))
        site.port = ActionPort(Path(args.where), simulated=is_simulated)
        site.must_confirm = site.must_confirm and not is_simulated
        report, is_interrupted = _carry_on(site, run, kept, _terminal(procedure), resumed=True)
    if is_interrupted:
        return Interrupt.STATUS
    return 0 if report.verdict == "passed" else 1


def _terminal(procedure: Procedure) -> Terminal:
    return Terminal(procedure.name_of, sys.stdin.fileno(), lambda text: print_lines([text]))


def _carry_on(
    site: _Site, run: ExperimentRun, kept: RunFolder, terminal: Terminal, resumed: bool = False
) -> tuple[RunReport, bool]:
    """Carry a run to its end; return its report, and whether Ctrl-C was pressed."""
    runner = site.runner(run, kept, terminal)
    is_interrupted = False
    if resumed:
        runner.resume()
    while not run.is_closed:
        try:
            runner.step()
        except KeyboardInterrupt:  # the robot is stopped first, however often it is pressed
            is_interrupted = True
            runner.abort("Ctrl-C")
    runner.step()  # the last events are kept
    _pin(site, run)
    report = _made(site.store.path, run.procedure, run.events)
    replace_file(kept.path / REPORT, report.to_json().decode())
    print_lines(report_lines(report))
    return report, is_interrupted


def _pin(site: _Site, run: ExperimentRun) -> None:
    """Keep the record of the run as an incident, where there is one."""
    if not is_locked(site.store, "main"):
        print_notes(["no recorder runs (amberbox run, amberbox record): what can be measured is "
                     "unknown, and there are no plots"])  # fmt: skip
        return
    lasted_s = (time.time_ns() - run.events[0].at_ns) / NS
    try:
        mark(
            site.folder.path, before_s=lasted_s + _BEFORE_S, after_s=_AFTER_S,
            reason=f"experiment {run.id}", who=site.who,
        )  # fmt: skip
    except AmberboxError as error:
        print_notes([f"the record of the run is not pinned: {error.what}"])


def _made(store: Path, procedure: Procedure, events: Sequence[RunEvent]) -> RunReport:
    """Make the report, when the record has come to the end of the run."""
    over_ns = events[-1].at_ns
    with record.open(store) as opened:
        end_s = time.monotonic() + _RECORD_WAIT_S
        while is_locked(Store(store, ""), "main") and time.monotonic() < end_s:
            if (opened.last_ns() or 0) >= over_ns:
                break
            time.sleep(0.1)
        return make_report(procedure, events, _recorded(opened))


def _recorded(opened: Record) -> Record | None:
    """Return the record; None where nothing of the robot is in it."""
    return opened if any(not item.name.startswith("amberbox_") for item in opened.items()) else None


def _list(args: argparse.Namespace) -> int:
    reports = [report for kept in run_folders(_store(args)) if (report := _kept_report(kept))]
    reports.sort(key=lambda report: report.began_ns)
    if args.json:
        print_json([_summary(report) for report in reports])
    elif reports:
        head = ("run", "began (UTC)", "lasted", "verdict", "deviations")
        print_lines(in_columns([head, *map(_row, reports)], ""))
    else:
        print("no runs: amberbox experiment run FOLDER NAME")
    return 0


def _kept_report(kept: RunFolder) -> RunReport | None:
    """Return the report of a run; for one that goes on, what has happened so far."""
    with suppress(OSError, UsageError):
        return RunReport.from_json((kept.path / REPORT).read_bytes())
    with suppress(OSError, UsageError):
        procedure = procedure_of(kept.experiment())
        return make_report(procedure, ExperimentRun.restore(procedure, kept.state()).events, None)
    return None


def _summary(report: RunReport) -> dict[str, Any]:
    return {
        "run": report.run, "experiment": report.experiment, "sha256": report.sha256,
        "began": format_to_second(report.began_ns), "verdict": report.verdict,
        "reasons": report.reasons, "deviations": _deviations(report),
    }  # fmt: skip


def _row(report: RunReport) -> tuple[str, ...]:
    lasted = "" if report.ended_ns is None else format_duration(report.ended_ns - report.began_ns)
    began = format_to_second(report.began_ns)
    return report.run, began, lasted, report.verdict or "going on", f"{_deviations(report)}"


def _deviations(report: RunReport) -> int:
    return sum(event.kind == "deviation" for event in report.deviations)


def _found(args: argparse.Namespace, run_id: str) -> RunReport:
    report = _kept_report(RunFolder.find(_store(args), run_id))
    if report is None:
        raise UsageError(f"what is kept of the run '{run_id}' cannot be read")
    return report


def _show(args: argparse.Namespace) -> int:
    return show_report(_found(args, args.run), as_json=args.json)


def show_report(report: RunReport, *, as_json: bool) -> int:
    """Print the report of a run."""
    if as_json:
        print_json(msgspec.to_builtins(report))
    else:
        print_lines([f"run {report.run}: {report.title}", *report_lines(report)])
        rows = [
            (step.name, step.who or step.role, step.state,
             "" if step.to_ns is None else format_duration(step.to_ns - step.from_ns), step.text)
            for step in report.steps
        ]  # fmt: skip
        print_lines(in_columns(rows))
    return 0


def report_lines(report: RunReport) -> list[str]:
    """Return verdict, reasons, criteria, deviations and notes."""
    lines = [f"verdict: {report.verdict or 'going on'}", *(f"  {why}" for why in report.reasons)]
    lines += [f"  {one.verdict}: {one.name}: {_measured(one)}" for one in report.criteria]
    return lines + [f"  {event.kind}: {event.text}" for event in report.deviations]


def _measured(result: CriterionResult) -> str:
    return result.text if result.value is None else f"{result.value:.4g} {result.unit}".rstrip()


def _report(args: argparse.Namespace) -> int:
    target = report_target(args.output)
    report = _found(args, args.run)
    _write_report(target, RunFolder.find(_store(args), args.run).experiment(), report)
    print(f"wrote {target}")
    return 0


FORMATS: Mapping[str, str] = {".html": "html", ".htm": "html", ".json": "json", ".xml": "junit"}


def report_target(name: str) -> Path:
    """Return the file for a report; its suffix is the format. Raises UsageError for another."""
    target = writable(name)
    if target.suffix.lower() not in FORMATS:
        raise UsageError(f"'{name}' is no name of a report", "end it with .html, .json or .xml")
    return target


def _write_report(target: Path, experiment: Experiment, report: RunReport) -> None:
    kind = FORMATS[target.suffix.lower()]
    if kind == "html":
        target.write_text(report_page(report, _diagram(experiment, report)), encoding="utf-8")
    else:
        target.write_text(junit(report) if kind == "junit" else report.to_json().decode(),
                          encoding="utf-8")  # fmt: skip


def _compare(args: argparse.Namespace) -> int:
    every = [folder.path.name for folder in run_folders(_store(args))]
    names = [
        run
        for word in args.runs
        for run in ([word] if word in every else _of_experiment(args, every, word))
    ]
    found = compare([_found(args, name) for name in names], args.since, args.software)
    if args.json:
        print_json(msgspec.to_builtins(found))
    else:
        print_comparison(found)
    return 0


def _of_experiment(args: argparse.Namespace, runs: Sequence[str], name: str) -> list[str]:
    """Return the runs of an experiment whose diagram is that of the newest one."""
    reports = [report for run in runs if (report := _found(args, run)).experiment == name]
    if not reports:
        raise UsageError(f"there is no run and no experiment '{name}'{did_you_mean(name, runs)}")
    newest = max(reports, key=lambda report: report.began_ns)
    return [report.run for report in reports if report.sha256 == newest.sha256]


def print_comparison(found: Comparison) -> None:
    """Print the verdicts of runs, and the statistics of what was measured."""
    print_lines([f"{run}: {verdict}" for run, verdict in found.verdicts.items()])
    head = ("measure", "n", "missing", "mean", "sd", "min", "max", "change")
    rows = [
        (
            f"{one.name} [{one.unit}]" if one.unit else one.name, f"{one.n}", f"{one.missing}",
            *(_figure(v) for v in (one.mean, one.sd, one.min, one.max, one.change)),
        )
        for one in found.measures
    ]  # fmt: skip
    print_lines(in_columns([head, *rows], ""))


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _diagram(experiment: Experiment, report: RunReport) -> Diagram:
    """Return the drawing of the diagram with the states that the run has come to."""
    states = element_states(procedure_of(experiment), report.events)
    return lambda: draw_bpmn(experiment.model, states)
