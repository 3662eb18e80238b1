"""Judge what can fail: check the FMEA, show its sheet, what matters most, what nobody sees."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from amberbox.blackbox.folder.folder import inspect_folder
from amberbox.cli._anyorder import accept_where_first
from amberbox.cli._output import print_grid, print_json, tell, writable
from amberbox.cli._server import add_where
from amberbox.cli._text import print_lines
from amberbox.client.address import is_url
from amberbox.consult.known import known_of
from amberbox.consult.sheets import coverage_json, criticality_json
from amberbox.core.config import did_you_mean, refuse
from amberbox.core.errors import ConfigurationError, Problem, UsageError
from amberbox.core.redaction import as_plain
from amberbox.diagnosis.fmea.coverage import Alike, Coverage, coverage
from amberbox.diagnosis.fmea.criticality import (
    Matrix,
    by_number,
    criticalities,
    matrix,
    mode_criticality,
)
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.load import FILE, load_fmea
from amberbox.diagnosis.fmea.model import FailureMode, Fmea
from amberbox.diagnosis.fmea.priorities import Rule, load_priorities, priority
from amberbox.diagnosis.fmea.sheet import row_of, write_sheet
from amberbox.diagnosis.fmea.sheet_reading import read_sheet

_USAGE = (
    "amberbox fmea check|table|criticality|coverage WHERE [--json] [--csv FILE] "
    "[--import FILE.csv] [--priorities FILE.csv] [--exposure HOURS]"
)
_NOT_COMPARED = "symptoms are not compared with monitors"
_SHOWN = ("Item", "Failure mode", "Severity", "S", "O", "D", "RPN", "Detection", "Action")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    parser.add_argument("action", metavar="ACTION", help=", ".join(_ACTIONS))
    add_where(parser, f"robot folder, or a {FILE}")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--csv", metavar="FILE", help="write the sheet to a file (- prints it)")
    parser.add_argument(
        "--import", dest="import_", metavar="FILE", help=f"make {FILE} from a sheet first"
    )
    parser.add_argument("--priorities", metavar="FILE", help="table of S, O, D and priorities")
    parser.add_argument(
        "--exposure", type=float, metavar="HOURS", help="time in which failures come about"
    )
    accept_where_first(parser, _ACTIONS)


def run(args: argparse.Namespace) -> int:
    """Do what is asked; 2 if the file is wrong, 1 if ``check`` finds nothing to judge."""
    if args.action not in _ACTIONS:
        near = did_you_mean(args.action, _ACTIONS)
        raise UsageError(f"there is no action '{args.action}'{near}", _USAGE)
    if args.exposure is not None and not args.exposure >= 0:
        raise UsageError(f"an exposure of {args.exposure:g} h cannot be", "give hours from 0")
    if is_url(args.where):
        from amberbox.cli._remote_knowledge import fmea_remote

        fmea_remote(args)
        return 0
    path = fmea_path(args.where)
    if args.import_:
        _import(Path(args.import_), path)
    fmea, known, problems = loaded(path)
    rules: list[Rule] = []
    if args.priorities:
        rules = load_priorities(Path(args.priorities), problems)
    if args.action == "check":
        return _check(args, fmea, known, problems)
    refuse(problems)
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
    """Return the file that a robot folder, or the path of a file itself, means."""
    path = Path(where)
    return path / FILE if path.is_dir() else path


def loaded(path: Path) -> tuple[Fmea | None, Known | None, list[Problem]]:
    """Read the file; symptoms are compared with the monitors of the robot folder it lies in."""
    if not path.exists():
        hint = f"write one (docs/fmea.md), or: amberbox fmea check {path.parent} --import FILE.csv"
        raise UsageError(f"there is no {path}", hint)
    folder, _ = inspect_folder(path.parent) if (path.parent / "robot.yaml").exists() else (None, [])
    known = known_of(folder) if folder is not None else None
    fmea, problems = load_fmea(path, known)
    return fmea, known, problems


def _import(sheet: Path, path: Path) -> None:
    """Make the file from a sheet; never over one that is there."""
    if path.exists():
        raise UsageError(f"there is a {path} already, nothing was written", "move it away first")
    problems: list[Problem] = []
    text = read_sheet(sheet, problems)
    refuse(problems)
    tell(str(problem) for problem in problems)
    writable(str(path)).write_text(text, encoding="utf-8")


def _check(
    args: argparse.Namespace, fmea: Fmea | None, known: Known | None, problems: Sequence[Problem]
) -> int:
    wrong = any(problem.is_error for problem in problems)
    if args.json:
        report = {"ok": not wrong, "problems": [as_plain(problem) for problem in problems]}
        print_json(report | (_counts(fmea) if fmea else {}))
    else:
        for problem in problems:
            print(problem)
        said = _in_words(fmea) if fmea and not wrong else _errors(problems)
        print_lines([f"{args.where}: {said}"])
    if fmea and known is None and not args.json:
        tell([f"no robot folder that can be read at {args.where}: {_NOT_COMPARED}"])
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


def _table(args: argparse.Namespace, fmea: Fmea, known: Known | None, rules: list[Rule]) -> None:
    """Show the sheet, the highest S x O x D first."""
    rows = [row_of(fmea, mode, rules) for mode in by_number(_modes(fmea))]
    if args.json:
        print_json(rows)
        return
    columns = (*_SHOWN[:7], *(["Priority"] if rules else []), *_SHOWN[7:])
    print_grid([column.lower() if len(column) > 3 else column for column in columns],
               [[row[column] for column in columns] for row in rows])  # fmt: skip


def _criticality(
    args: argparse.Namespace, fmea: Fmea, known: Known | None, rules: list[Rule]
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
    print_grid(*_matrix_table(cells))


def _mode_row(mode: FailureMode, exposure: float | None, rules: list[Rule]) -> list[str]:
    number = "-" if mode.ranks.number is None else str(mode.ranks.number)
    word = [priority(mode.ranks, rules)] if rules else []
    return [mode.id, mode.severity, number, *word, f"{mode_criticality(mode, exposure):.3g}"]


def _matrix_table(cells: Matrix) -> tuple[Sequence[str], list[list[str]]]:
    rows = [
        [level, *(str(len(cells.cells.get((level, word), ())) or "") for word in cells.columns)]
        for level in cells.rows
    ]
    return ("failure modes by occurrence", *cells.columns), rows


def _coverage(args: argparse.Namespace, fmea: Fmea, known: Known | None, rules: list[Rule]) -> None:
    """Show what nobody sees, what nothing explains and what looks the same."""
    found = coverage(fmea, sorted(known.watched) if known else ())
    if args.json:
        print_json(coverage_json(found))
    else:
        print_lines(_coverage_lines(found))


def _coverage_lines(found: Coverage) -> Iterator[str]:
    seen = found.modes - len(found.unseen)
    yield f"{seen} of {found.modes} failure modes show; {found.distinct} can be told apart by that"
    yield from _section("nothing shows", [f"{m}: {why}" for m, why in found.unseen.items()])
    weak = [f"{mode}: seen in {share:.0%} of cases" for mode, share in found.weak.items()]
    yield from _section("show weakly", weak)
    yield from _section("no failure mode explains", found.unexplained)
    yield from _section("look the same", [_alike_line(group) for group in found.alike])


def _section(title: str, lines: Sequence[str]) -> Iterator[str]:
    if lines:
        yield f"{title} ({len(lines)}):"
        yield from (f"  {line}" for line in lines)


def _alike_line(group: Alike) -> str:
    tests = f"told apart by {', '.join(group.tests)}" if group.tests else "no test tells them apart"
    left = [" = ".join(modes) for modes in group.left] if group.tests else []
    rest = f"; no test tells {' and '.join(left)}" if left else ""
    return f"{', '.join(group.modes)}: {tests}{rest}"


_ACTIONS: dict[str, Callable[..., Any]] = {
    "check": _check,
    "table": _table,
    "criticality": _criticality,
    "coverage": _coverage,
}
