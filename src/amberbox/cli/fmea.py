"""Failure modes of a robot or a server: check the FMEA; show sheet, criticality and coverage; learn
numbers from repairs.
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from amberbox.blackbox.query.record import LocalRecord, Record
from amberbox.blackbox.robot_folder.folder import inspect_folder, load_folder
from amberbox.cli._arguments import (
    PAGE,
    accept_relative_times,
    accept_where_first,
    add_where,
    opened,
    refuse_options,
    robot_at,
    time_of,
)
from amberbox.cli._output import (
    print_grid,
    print_json,
    print_lines,
    print_notes,
    writable,
)
from amberbox.client.address import is_url
from amberbox.consult.folder_knowledge import fmea_references, load_knowledge
from amberbox.consult.repairs import (
    KnownSituations,
    evaluated_faults,
    read_situations,
    recorded_faults,
    was_found,
    with_known_modes,
)
from amberbox.core.config import raise_errors
from amberbox.core.errors import (
    AmberboxError,
    ConfigurationError,
    Problem,
    UsageError,
    did_you_mean,
)
from amberbox.core.files import replace_file
from amberbox.core.redaction import masked_values
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.diagnosis.fmea.criticality import (
    AmbiguousModes,
    PriorityRule,
    by_risk_number,
    coverage,
    criticalities,
    load_priorities,
    matrix,
    mode_criticality,
    priority,
)
from amberbox.diagnosis.fmea.edits import edited
from amberbox.diagnosis.fmea.learning import WEIGHT, Proposal, learn
from amberbox.diagnosis.fmea.loader import FILE, load_fmea, read_fmea
from amberbox.diagnosis.fmea.model import FailureMode, Fmea, FmeaReferences
from amberbox.diagnosis.fmea.parser import read
from amberbox.diagnosis.fmea.sheet import (
    coverage_json,
    criticality_json,
    read_sheet,
    row_of,
    write_sheet,
)
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.server.archive.location import archive_in

_USAGE = (
    "amberbox fmea check|table|criticality|coverage WHERE [--json] [--csv FILE] "
    "[--import FILE.csv] [--priorities FILE.csv] [--exposure HOURS], "
    "learn WHERE [RECORD...] [--apply] [--replay] [--from T] [--to T] [--weight N]"
)
_NOT_COMPARED = "symptoms are not compared with monitors"
_SHOWN = ("Item", "Failure mode", "Severity", "S", "O", "D", "RPN", "Detection", "Action")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    parser.add_argument("action", metavar="ACTION", help=", ".join(_ACTIONS))
    add_where(parser, f"robot folder, or a {FILE}")
    parser.add_argument(
        "records", nargs="*", metavar="RECORD",
        help=f"learn: robot folders, stores, archives, or {PAGE}; without any, that of WHERE",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--csv", metavar="FILE", help="write the sheet to a file (- prints it)")
    parser.add_argument(
        "--import", dest="import_", metavar="FILE", help=f"make {FILE} from a sheet first"
    )
    parser.add_argument("--priorities", metavar="FILE", help="table of S, O, D and priorities")
    parser.add_argument(
        "--exposure",
        type=float,
        metavar="HOURS",
        help="time in which failures come about; "
        "learn: hours of operation, where the records hold only a part",
    )
    parser.add_argument("--apply", action="store_true", help=f"learn: write it into {FILE}")
    parser.add_argument(
        "--replay", action="store_true", help="learn: evaluate records that were watched, too"
    )
    parser.add_argument("--from", dest="from_", metavar="T", help="learn: from this time on")
    parser.add_argument("--to", metavar="T", help="learn: up to this time, not included")
    parser.add_argument(
        "--weight", type=float, default=WEIGHT, metavar="N",
        help=f"learn: a 'detects' of the file counts as so many repairs [{WEIGHT:g}]",
    )  # fmt: skip
    accept_relative_times(parser)
    accept_where_first(parser, _ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Run the action; return 2 if the file has errors."""
    if args.action not in _ACTIONS:
        near = did_you_mean(args.action, _ACTIONS)
        raise UsageError(f"there is no action '{args.action}'{near}", _USAGE)
    if args.exposure is not None and not args.exposure >= 0:
        raise UsageError(f"an exposure of {args.exposure:g} h cannot be", "give hours from 0")
    if args.action == "learn":
        return _learn(args)
    _refuse_options_of_learn(args)
    if is_url(args.where):
        _run_on_server(args)
        return 0
    path = fmea_path(args.where)
    if args.import_:
        _import(Path(args.import_), path)
    fmea, known, problems = loaded(path)
    rules: list[PriorityRule] = []
    if args.priorities:
        rules = load_priorities(Path(args.priorities), problems)
    if args.action == "check":
        return _check(args, fmea, known, problems)
    raise_errors(problems)
    assert fmea is not None
    if args.csv == "-":
        print(write_sheet(fmea, rules), end="")
    elif args.csv:
        writable(args.csv).write_text(write_sheet(fmea, rules), encoding="utf-8")
        print(f"wrote {len(fmea.modes)} failure modes to {args.csv}")
    else:
        _ACTIONS[args.action](args, fmea, known, rules)
    return 0


def fmea_path(where: str) -> Path:
    """Return the path of the FMEA file for a robot folder, or for the file itself."""
    path = Path(where)
    return path / FILE if path.is_dir() else path


def loaded(path: Path) -> tuple[Fmea | None, FmeaReferences | None, list[Problem]]:
    """Read the file, with problems; symptoms are checked against its robot folder's monitors."""
    if not path.exists():
        importing = f"amberbox fmea check {path.parent} --import FILE.csv"
        hint = f"write one (docs/robot/fmea.md), or: {importing}"
        raise UsageError(f"there is no {path}", hint)
    folder, _ = inspect_folder(path.parent) if (path.parent / "robot.yaml").exists() else (None, [])
    known = fmea_references(folder) if folder is not None else None
    fmea, problems = load_fmea(path, known)
    return fmea, known, problems


def _import(sheet: Path, path: Path) -> None:
    """Create the file from a sheet; never overwrites one."""
    if path.exists():
        raise UsageError(f"there is a {path} already, nothing was written", "move it away first")
    problems: list[Problem] = []
    text = read_sheet(sheet, problems)
    raise_errors(problems)
    print_notes(str(problem) for problem in problems)
    writable(str(path)).write_text(text, encoding="utf-8")


def _check(
    args: argparse.Namespace,
    fmea: Fmea | None,
    known: FmeaReferences | None,
    problems: Sequence[Problem],
) -> int:
    wrong = any(problem.is_error for problem in problems)
    if args.json:
        report = {"ok": not wrong, "problems": [masked_values(problem) for problem in problems]}
        print_json(report | (_counts(fmea) if fmea else {}))
    else:
        for problem in problems:
            print(problem)
        verdict = _in_words(fmea) if fmea and not wrong else _errors(problems)
        print_lines([f"{args.where}: {verdict}"])
    if fmea and known is None and not args.json:
        print_notes([f"no robot folder that can be read at {args.where}: {_NOT_COMPARED}"])
    return ConfigurationError.exit_code if wrong else 0


def _errors(problems: Sequence[Problem]) -> str:
    count = sum(problem.is_error for problem in problems)
    return f"{count} error{'' if count == 1 else 's'}"


def _counts(fmea: Fmea) -> dict[str, int]:
    return {
        "components": len(fmea.components),
        "failure_modes": len(fmea.modes),
        "written_once": len({(fmea.components[m.component].type, m.name) for m in _modes(fmea)}),
        "functions": len(fmea.functions),
        "system_functions": len(fmea.system_functions()),
        "symptoms": len(fmea.symptoms),
        "tests": len(fmea.tests),
    }


def _modes(fmea: Fmea) -> Iterator[FailureMode]:
    yield from fmea.modes.values()


def _in_words(fmea: Fmea) -> str:
    of = _counts(fmea)
    once = f"{of['failure_modes']} failure modes ({of['written_once']} written once)"
    rest = f"{of['functions']} functions, {of['symptoms']} symptoms, {of['tests']} tests"
    return f"fine: {of['components']} components, {once}, {rest}"


def _table(
    args: argparse.Namespace, fmea: Fmea, known: FmeaReferences | None, rules: list[PriorityRule]
) -> None:
    """Show the sheet, the highest S x O x D first."""
    rows = [row_of(fmea, mode, rules) for mode in by_risk_number(_modes(fmea))]
    if args.json:
        print_json(rows)
        return
    _print_sheet(rows, (*_SHOWN[:7], *(["Priority"] if rules else []), *_SHOWN[7:]))


def _print_sheet(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = _SHOWN) -> None:
    header = [column.lower() if len(column) > 3 else column for column in columns]
    print_grid(header, [[row[column] for column in columns] for row in rows])


def _criticality(
    args: argparse.Namespace, fmea: Fmea, known: FmeaReferences | None, rules: list[PriorityRule]
) -> None:
    """Show C_m of modes, C_r of components and the matrix."""
    modes = sorted(_modes(fmea), key=lambda mode: -mode_criticality(mode, args.exposure))
    sums, cells = criticalities(fmea, args.exposure), matrix(fmea, args.exposure)
    if args.json:
        print_json(criticality_json(fmea, args.exposure, rules))
        return
    print_grid(("component", "C_r"), [(name, f"{value:.3g}") for name, value in sums.items()])
    print()
    header = ("failure mode", "severity", "S x O x D", *(["priority"] if rules else []), "C_m")
    print_grid(header, [_mode_row(mode, args.exposure, rules) for mode in modes])
    print()
    rows = [
        [level, *(str(len(cells.cells.get((level, word), ())) or "") for word in cells.columns)]
        for level in cells.rows
    ]
    print_grid(("failure modes by occurrence", *cells.columns), rows)


def _mode_row(mode: FailureMode, exposure: float | None, rules: list[PriorityRule]) -> list[str]:
    number = "-" if mode.ranks.number is None else str(mode.ranks.number)
    word = [priority(mode.ranks, rules)] if rules else []
    return [mode.id, mode.severity, number, *word, f"{mode_criticality(mode, exposure):.3g}"]


def _coverage(
    args: argparse.Namespace, fmea: Fmea, known: FmeaReferences | None, rules: list[PriorityRule]
) -> None:
    """Show undetected failure modes, unexplained symptoms and indistinguishable modes."""
    found = coverage(fmea, sorted(known.watched) if known else ())
    if args.json:
        print_json(coverage_json(found))
    else:
        alike = [_similar_line(group) for group in found.ambiguous]
        print_lines(_coverage_lines(coverage_json(found), alike))


def _coverage_lines(found: Mapping[str, Any], alike: Sequence[str]) -> Iterator[str]:
    """Yield the lines of the coverage; ``alike`` are those of indistinguishable modes."""
    total, unseen = found["modes"], found["unseen"]
    distinct = f"{found['distinct']} can be told apart by that"
    yield f"{total - len(unseen)} of {total} failure modes show; {distinct}"
    yield from _section("nothing shows", [f"{m}: {why}" for m, why in unseen.items()])
    weak = [f"{mode}: seen in {share:.0%} of cases" for mode, share in found["weak"].items()]
    yield from _section("show weakly", weak)
    yield from _section("no failure mode explains", found["unexplained"])
    yield from _section("look the same", alike)


def _section(title: str, lines: Sequence[str]) -> Iterator[str]:
    if lines:
        yield f"{title} ({len(lines)}):"
        yield from (f"  {line}" for line in lines)


def _similar_line(group: AmbiguousModes) -> str:
    tests = f"told apart by {', '.join(group.tests)}" if group.tests else "no test tells them apart"
    left = [" = ".join(modes) for modes in group.left] if group.tests else []
    rest = f"; no test tells {' and '.join(left)}" if left else ""
    return f"{', '.join(group.modes)}: {tests}{rest}"


def _refuse_options_of_learn(args: argparse.Namespace) -> None:
    given = {"RECORD": args.records, "--apply": args.apply, "--from": args.from_, "--to": args.to,
             "--replay": args.replay}  # fmt: skip
    strange = [name for name, value in given.items() if value]
    if strange:
        raise UsageError(f"fmea {args.action} takes no {', '.join(strange)}", _USAGE)


def _learn(args: argparse.Namespace) -> int:
    """Print what repairs say of the numbers of the file, and the change as a diff; or apply it."""
    if not 0 < args.weight < 1e6:
        raise UsageError(f"a weight of {args.weight:g} cannot be", "give a number of repairs")
    if is_url(args.where):
        what = f"'fmea learn' changes a {FILE} on this computer"
        raise UsageError(what, f"amberbox fmea learn FOLDER {args.where}")
    path = fmea_path(args.where)
    fmea, known, problems = loaded(path)
    raise_errors(problems)
    assert fmea is not None
    situations = _situations(args, fmea)
    text, mark = _text_of(path)
    root = parse_yaml(text, str(path), [])
    assert root is not None
    sheet = read(root, known, [])
    hours = situations.hours if args.exposure is None else args.exposure
    found = learn(sheet, fmea, situations.situations, hours, known, args.weight)
    new, by_hand = edited(text, root, found)
    if any(problem.is_error for problem in read_fmea(new, known, str(path))[1]):
        what = f"the proposals cannot be written into {path} as it is laid out"
        raise AmberboxError(what, "take the numbers by hand: amberbox fmea learn ... --json")
    name = str(path)
    lines = difflib.unified_diff(text.splitlines(True), new.splitlines(True), name, name)
    diff = "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)
    if args.json:
        print_json({"situations": _situation_counts(situations), "diff": diff,
                    "proposals": [_proposal_json(one, by_hand) for one in found]})  # fmt: skip
    else:
        print_lines([_learnt_from(situations), *_proposal_lines(found, by_hand)])
        print(diff, end="")
    print_notes(situations.remarks)
    if args.apply and diff:
        replace_file(path, mark + new)
        print_notes([f"wrote {len(found) - len(by_hand)} changes to {path}"])
    return 0


def _text_of(path: Path) -> tuple[str, str]:
    """Return the text of a file, and the mark of its encoding at the beginning, if any."""
    text = path.read_bytes().decode("utf-8")
    return text.removeprefix("\ufeff"), "\ufeff" if text.startswith("\ufeff") else ""


def _situations(args: argparse.Namespace, fmea: Fmea) -> KnownSituations:
    """Return the situations of all records; one that nobody watched is evaluated here."""
    found, own = KnownSituations(), str(fmea_path(args.where).parent)
    for where in args.records or [own]:
        archive = None if is_url(where) else archive_in(where)
        if archive is not None and not archive[1]:
            raise UsageError(f"{where} has several robots", f"name one: {where}/journals/ROBOT")
        with opened(where) as record:
            from_ns = time_of("--from", args.from_, record.time_ns)
            to_ns = time_of("--to", args.to, record.time_ns)
            said = _said_at_server(where, from_ns, to_ns) if is_url(where) else {}
            if not args.replay and was_found(record):
                faults = recorded_faults(record, from_ns, to_ns)
            else:
                local = _local(record, where)
                faults = evaluated_faults(*_watching(own), local)
            found += read_situations(record, faults, said, from_ns, to_ns)
    return with_known_modes(found, fmea.modes)


def _watching(where: str) -> tuple[Knowledge, MonitoringPlan]:
    """Return what a watcher of a folder knows."""
    folder = load_folder(where)
    plan, _ = load_plan(folder)
    knowledge, problems = load_knowledge(folder, plan)
    raise_errors(problems)
    assert knowledge is not None
    return knowledge, plan


def _local(record: Record, where: str) -> Record:
    if isinstance(record, LocalRecord):
        return record
    what = f"nobody watched {where}: it has no symptoms"
    raise UsageError(what, "records on this computer are evaluated by 'learn' itself")


def _said_at_server(where: str, from_ns: int | None, to_ns: int | None) -> dict[str, list[str]]:
    """Return the causes that people gave on a server, by diagnosis."""
    fleet, robot = robot_at(where)
    with fleet:
        names = [one.id for one in fleet.diagnoses(robot, from_ns, to_ns)]
        details = {name: fleet.diagnosis(robot, name) for name in names}
    return {
        name: [str(cause["failure_mode"]) for cause in one.get("causes", ())]
        for name, one in details.items()
    }


def _situation_counts(found: KnownSituations) -> dict[str, float]:
    repairs = sum(bool(one.faults) for one in found.situations)
    return {
        "repairs": repairs, "without_fault": len(found.situations) - repairs,
        "unsaid": found.unsaid, "hours": round(found.hours, 3),
    }  # fmt: skip


def _learnt_from(found: KnownSituations) -> str:
    of = _situation_counts(found)
    unsaid = f"; of {of['unsaid']} diagnoses nobody said the cause" if found.unsaid else ""
    return (
        f"{of['repairs']} repairs, {of['without_fault']} situations without a fault, "
        f"{found.hours:.3g} h of record{unsaid}"
    )


def _proposal_lines(found: Sequence[Proposal], by_hand: Collection[Proposal]) -> Iterator[str]:
    """Yield two lines for each proposal: the number, and the reason."""
    for one in found:
        place = " ".join(filter(None, (one.mode, one.kind, one.symptom)))
        by_whom = ", to be written by hand" if one in by_hand else ""
        yield f"{place}: {one.now} -> {one.value}{by_whom}"
        yield f"  {one.reason}"
    yield "" if found else "nothing to change"


def _proposal_json(one: Proposal, by_hand: Collection[Proposal]) -> dict[str, Any]:
    return {
        "kind": one.kind, "mode": one.mode, "symptom": one.symptom, "now": one.now,
        "value": one.value, "reason": one.reason, "in_diff": one not in by_hand,
    }  # fmt: skip


_ACTIONS: dict[str, Callable[..., Any]] = {
    "learn": _learn,
    "check": _check,
    "table": _table,
    "criticality": _criticality,
    "coverage": _coverage,
}


FOR_LOCAL_FOLDER = "they are for a robot folder on this computer"


def _run_on_server(args: argparse.Namespace) -> None:
    """Show the sheet, criticality or coverage that a server computed."""
    given = {"csv": args.csv, "import": args.import_, "priorities": args.priorities}
    refuse_options(args.where, given, FOR_LOCAL_FOLDER)
    if args.action not in _SERVER_ACTIONS:
        raise UsageError(f"fmea {args.action} is about files on this computer",
                         f"of a server: {', '.join(_SERVER_ACTIONS)}")  # fmt: skip
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.fmea(robot, exposure_h=args.exposure)
    print_notes(found["notes"])
    if args.json:
        print_json(found[args.action])
    else:
        _SERVER_ACTIONS[args.action](found[args.action])


def _print_server_criticality(found: Mapping[str, Any]) -> None:
    rows = [(one["component"], f"{one['C_r']:.3g}") for one in found["components"]]
    print_grid(("component", "C_r"), rows)
    print()
    modes = [
        (one["mode"], one["severity"], "-" if one["RPN"] is None else one["RPN"],
         f"{one['C_m']:.3g}")
        for one in found["modes"]
    ]  # fmt: skip
    print_grid(("failure mode", "severity", "S x O x D", "C_m"), modes)


def _print_server_coverage(found: Mapping[str, Any]) -> None:
    alike = [", ".join(group["modes"]) for group in found["alike"]]
    print("\n".join(_coverage_lines(found, alike)))


_SERVER_ACTIONS: dict[str, Callable[[Any], None]] = {
    "table": _print_sheet,
    "criticality": _print_server_criticality,
    "coverage": _print_server_coverage,
}
