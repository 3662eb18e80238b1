"""Experiments as files: check, list and draw BPMN files, import those of the predecessor."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from amberbox.cli._arguments import add_where
from amberbox.cli._output import in_columns, print_json, print_lines
from amberbox.core.errors import ConfigurationError, Problem, UsageError, did_you_mean
from amberbox.core.safe_text import one_line
from amberbox.experiments.action import FOLDER as ACTIONS
from amberbox.experiments.drawing import State, draw_bpmn
from amberbox.experiments.experiment import FOLDER
from amberbox.experiments.legacy_definitions import (
    definition_name,
    import_definition,
    is_definition,
)
from amberbox.experiments.profile import SUFFIX, Experiment, list_experiments, read_experiment
from amberbox.experiments.step_list import OrderedStep, duration_text, ordered_steps


def add_verbs(verbs: Any) -> None:
    """Add the actions that concern files to the parser of ``amberbox experiment``."""
    check = _verb(verbs, "check", _check, "check experiments: name what is wrong or is not run")
    listing = _verb(verbs, "list", _list, "list the experiments of a robot or a folder")
    draw = _verb(verbs, "draw", _draw, "draw an experiment as SVG, or list its steps in order")
    files = "a BPMN file, a robot folder, or a folder of BPMN files"
    for verb in (check, draw):
        verb.add_argument("where", metavar="FILE|FOLDER", help="a BPMN file" if verb is draw else
                          files)  # fmt: skip
    add_where(listing, files, "FILE|FOLDER|URL")
    for verb in (check, listing, draw):
        verb.add_argument("--folder", metavar="FOLDER", help="robot whose actions are used "
                          "[the folder that has the file in experiments/]")  # fmt: skip
    draw.add_argument("-o", "--output", metavar="DRAWING.svg", help="file to write")
    draw.add_argument("--state", action="append", default=[], metavar="STATE=ID,...",
                      help="mark elements as current, done, failed or waiting")  # fmt: skip
    draw.add_argument("--list", action="store_true", help="print the steps in reading order")
    imports = _verb(verbs, "import", _import, "turn state machines of ROPOD into experiments")
    imports.add_argument("files", nargs="+", metavar="FILE", help="NAME.toml, or folders of them")
    imports.add_argument("-o", "--output", metavar="FOLDER", required=True, help="where to write")


def _verb(
    verbs: Any, name: str, act: Callable[[argparse.Namespace], int], summary: str
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=summary, description=summary)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(act=act)
    return parser


# ---------------------------------------------------------------------------- check and list


def _check(args: argparse.Namespace) -> int:
    paths, robot = _experiments(args)
    wrong = False
    shown: list[dict[str, Any]] = []
    for path in paths:
        experiment, problems = read_experiment(path, robot, draft=True)
        wrong = wrong or any(problem.is_error for problem in problems)
        if args.json:
            shown.append(check_data(path, experiment, problems))
        else:
            print_lines(check_lines(path, experiment, problems))
    if args.json:
        print_json({"ok": not wrong, "experiments": shown})
    return ConfigurationError.exit_code if wrong else 0


def check_lines(
    path: Path, experiment: Experiment | None, problems: Sequence[Problem]
) -> Iterator[str]:
    """Yield what an experiment is, its problems and the verdict."""
    if experiment is not None:
        yield from _about(experiment)
    notes = [problem for problem in problems if not problem.is_error]
    errors = [problem for problem in problems if problem.is_error]
    yield from map(str, [*notes, *errors])
    refused = len(experiment.refused) if experiment is not None else 0
    not_run = f", {refused} of its elements are not run" if refused else ""
    counts = f"{_count(errors, 'error')}, {_count(notes, 'note')}{not_run}"
    yield f"{path}: {counts if errors else 'fine'}"


def _about(experiment: Experiment) -> Iterator[str]:
    options = experiment.options
    duration = options.duration
    facts = [
        ("experiment", f"{experiment.name}: {one_line(experiment.title)}"),
        ("people", ", ".join(experiment.person_roles)),
        ("steps", f"{len(experiment.person_steps)} of people, {len(experiment.robot_steps)} "
                  "of the robot"),
        ("parameters", ", ".join(options.parameters)),
        ("calls", ", ".join(sorted(set(experiment.calls.values())))),
        ("usual duration", "" if duration is None else duration_text(int(duration * 1e9))),
        ("files", experiment.sha256[:16]),
    ]  # fmt: skip
    yield from in_columns([fact for fact in facts if fact[1]], "")


def check_data(
    path: Path, experiment: Experiment | None, problems: Sequence[Problem]
) -> dict[str, Any]:
    """Return the same as JSON."""
    refused = experiment.refused if experiment is not None else ()
    return {
        "file": str(path),
        "ok": not any(problem.is_error for problem in problems),
        "experiment": None if experiment is None else summary(experiment),
        "not_run": [
            {"id": r.id, "type": r.type, "name": r.name, "line": r.line, "reason": r.reason}
            for r in refused
        ],
        "problems": [
            {"file": p.file, "line": p.line, "where": p.where, "what": p.what, "hint": p.hint,
             "error": p.is_error}
            for p in problems
        ],
    }  # fmt: skip


def summary(experiment: Experiment) -> dict[str, Any]:
    """Return what a list shows of an experiment, as JSON."""
    return {
        "name": experiment.name,
        "title": experiment.title,
        "description": experiment.options.description,
        "safety": experiment.options.safety,
        "duration_s": experiment.options.duration,
        "people": list(experiment.person_roles),
        "parameters": list(experiment.options.parameters),
        "about": list(experiment.options.about),
        "calls": sorted(set(experiment.calls.values())),
        "sha256": experiment.sha256,
    }


def _list(args: argparse.Namespace) -> int:
    paths, robot = _experiments(args)
    rows: list[tuple[str, ...]] = [("experiment", "title", "people", "duration", "state")]
    shown = []
    for path in paths:
        experiment, problems = read_experiment(path, robot, draft=True)
        errors = sum(problem.is_error for problem in problems)
        state = f"{errors} errors" if errors else "fine"
        if experiment is None:
            rows.append((path.name, "-", "-", "-", "cannot be read"))
            shown.append({"file": str(path), "ok": False})
            continue
        seconds = experiment.options.duration
        duration = "-" if seconds is None else duration_text(int(seconds * 1e9))
        people = ", ".join(experiment.person_roles) or "-"
        rows.append((experiment.name, one_line(experiment.title), people, duration, state))
        shown.append({"file": str(path), "ok": not errors, **summary(experiment)})
    if args.json:
        print_json({"experiments": shown})
    elif paths:
        print_lines(in_columns(rows, ""))
    else:
        print(f"no experiments: there is no {FOLDER}/*{SUFFIX} in {args.where}")
    return 0


def _experiments(args: argparse.Namespace) -> tuple[list[Path], Path | None]:
    """Return the files to read, and the robot folder whose actions they use."""
    where = Path(args.where)
    if not where.exists():
        raise UsageError(f"there is no file or folder '{where}'", _near(where))
    robot = None if args.folder is None else Path(args.folder)
    if robot is not None and not robot.is_dir():
        raise UsageError(f"there is no robot folder '{robot}'")
    if where.is_file():
        return [where], robot or _robot_of(where.absolute().parent)
    place = where / FOLDER if (where / FOLDER).is_dir() else where
    paths = list_experiments(place)
    if not paths and args.act is _check:
        raise UsageError(f"there is no {SUFFIX} file in '{place}'", "name a BPMN file or a folder")
    return paths, robot or _robot_of(place.absolute())


def _near(path: Path) -> str:
    folder = path.absolute().parent
    names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
    return did_you_mean(path.name, names).removeprefix("; ")


def _robot_of(place: Path) -> Path | None:
    """Return the robot folder that a folder of experiments is in; None if it is in none."""
    folder = place.parent
    is_robot = place.name == FOLDER and (
        (folder / "robot.yaml").exists() or (folder / ACTIONS).is_dir()
    )
    return folder if is_robot else None


def _count(of: Sequence[object], what: str) -> str:
    return f"{len(of)} {what}{'' if len(of) == 1 else 's'}"


# -------------------------------------------------------------------------------------- draw


def _draw(args: argparse.Namespace) -> int:
    if args.output is None and not args.list:
        raise UsageError("draw needs -o DRAWING.svg, or --list")
    paths, robot = _experiments(args)
    if len(paths) != 1 or not Path(args.where).is_file():
        raise UsageError("draw takes one BPMN file")
    experiment, problems = read_experiment(paths[0], robot, draft=True)
    if experiment is None:
        raise ConfigurationError(problems)
    if args.output is not None:
        states = _states(args.state, experiment)
        svg = draw_bpmn(experiment.model, states)
        Path(args.output).write_text(f"{svg}\n", encoding="utf-8")
    if args.list:
        steps = ordered_steps(experiment)
        if args.json:
            print_json({"steps": [_step_data(step) for step in steps]})
        else:
            print_lines(line for step in steps for line in step_lines(step))
    return 0


def _states(given: Sequence[str], experiment: Experiment) -> dict[str, State]:
    """Return the states ``current=ID,done=ID`` by id; raises UsageError for unknown ones."""
    known = [*experiment.model.elements, *experiment.model.flows]
    states: dict[str, State] = {}
    for word in (word for text in given for word in text.split(",") if word):
        name, _, own = word.partition("=")
        state = next((state for state in get_args(State) if state == name), None)
        if state is None:
            near = did_you_mean(name, get_args(State))
            raise UsageError(f"'{name}' is no state{near}", f"one of {', '.join(get_args(State))}")
        if own not in known:
            near = did_you_mean(own, known)
            raise UsageError(f"the diagram has no element '{own}'{near}")
        states[own] = state
    return states


def step_lines(step: OrderedStep) -> Iterator[str]:
    """Yield a step of the list as lines for a terminal."""
    blank = "   " * step.level
    yield f"{blank}{step.number:3}. {step.line}"
    for word, text in (("expected", step.expected), ("deviation", step.deviation)):
        if text:
            yield f"{blank}     {word}: {text}"
    yield from (f"{blank}     hint: {hint}" for hint in step.hints)


def _step_data(step: OrderedStep) -> dict[str, Any]:
    return {
        "number": step.number, "id": step.id, "type": step.type, "who": step.who,
        "name": step.name, "text": step.text, "expected": step.expected,
        "deviation": step.deviation, "level": step.level, "hints": list(step.hints),
        "branches": [{"when": branch.when, "to": branch.to} for branch in step.branches],
    }  # fmt: skip


# ------------------------------------------------------------------------------------ import


def _import(args: argparse.Namespace) -> int:
    """Write each definition as a BPMN file; nothing that is there is overwritten."""
    paths = [path for word in args.files for path in _definitions(Path(word))]
    folder = Path(args.output)
    wrong, written = [], []
    for name, path in _names(paths).items():
        definition, problems = import_definition(path, name)
        print_lines(str(problem) for problem in problems)
        if definition is None:
            wrong.append(path)
            continue
        target = folder / f"{name}{SUFFIX}"
        if target.exists():
            hint = "remove it, or name another folder with -o"
            raise UsageError(f"'{target}' is there already", hint)
        folder.mkdir(parents=True, exist_ok=True)
        target.write_text(definition.bpmn, encoding="utf-8")
        written.append(target)
    if args.json:
        print_json({"written": list(map(str, written)), "not_imported": list(map(str, wrong))})
    else:
        not_imported = f", {len(wrong)} could not be imported" if wrong else ""
        print(f"{_count(written, 'experiment')} written to {folder}{not_imported}")
    return ConfigurationError.exit_code if wrong else 0


def _definitions(path: Path) -> list[Path]:
    if path.is_dir():
        found = [file for file in sorted(path.rglob("*")) if file.is_file() and is_definition(file)]
        if not found:
            raise UsageError(f"there is no NAME.toml in '{path}'")
        return found
    if not path.is_file():
        raise UsageError(f"there is no file '{path}'", _near(path))
    return [path]


def _names(paths: Sequence[Path]) -> Mapping[str, Path]:
    """Return the files by the name of their experiment; of several, with that of their folder."""
    names = [definition_name(path) for path in paths]
    found: dict[str, Path] = {}
    for name, path in zip(names, paths, strict=True):
        own = name if names.count(name) == 1 else f"{path.absolute().parent.name}_{name}".lower()
        if own in found:
            raise UsageError(f"{found[own]} and {path} have the same name", "import them apart")
        found[own] = path
    return found
