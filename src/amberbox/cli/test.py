"""Unit tests of a robot: list or run the tests in ``tests/`` of its folder, here or by a server."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from amberbox.agent.unit_tests import (
    Found,
    Progress,
    Result,
    RunEvent,
    RunTask,
    UnitTestRun,
    missing_pytest,
)
from amberbox.blackbox.robot_folder.folder import inspect_folder
from amberbox.cli._arguments import add_where, refuse_options, robot_at, user_name
from amberbox.cli._output import (
    in_columns,
    print_json,
    print_lines,
    print_listing,
    print_notes,
    writable,
)
from amberbox.cli.fleet_run import FollowedRun, signer_of, unit_test_result
from amberbox.client.address import is_url
from amberbox.consult.run_answers import store_run_answers
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.interrupt import Interrupt
from amberbox.core.safe_text import one_line
from amberbox.experiments.unit_tests import (
    FOLDER,
    GOOD,
    CollectionProblem,
    TestCollection,
    UnitTest,
    UnitTestResult,
    files_of,
    junit_xml,
)

if TYPE_CHECKING:
    from amberbox.client.models import UnitTestLine

_LOOK_S = 0.5


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    add = parser.add_argument
    add_where(parser, "a robot folder")
    add("name", metavar="NAME", nargs="?", default="", help="only this test")
    add("-k", dest="keyword", default="", metavar="EXPR",
        help="only the test of this name, or those whose names match, as in pytest: "
             "'laser and not rear'")  # fmt: skip
    add("--list", action="store_true", help="list the tests, run none")
    add("--junit", metavar="FILE", help="write the results as JUnit XML")
    add("--simulated", action="store_true", help="run the twins of actions, without the robot")
    add("--yes", action="store_true", help="do not ask before the robot moves")
    add("--no-answer", action="store_true",
        help="leave the open diagnosis as it is, even if it asks for such a test")  # fmt: skip
    add("--json", action="store_true", help="print JSON")
    add("--sign", action="store_true",
        help="on a server: sign the commands; each is asked for, unless --yes")  # fmt: skip
    add("--key", default="", metavar="NAME", help="the key to sign with")


def run(args: argparse.Namespace) -> int:
    """List the tests of a robot, or run them; return 0 if all have passed."""
    if is_url(args.where):
        return _on_server(args)
    if args.sign or args.key:
        raise UsageError("--sign and --key go with the address of a server")
    args.keyword = args.keyword or args.name
    return _at_robot(args, Path(args.where))


def _at_robot(args: argparse.Namespace, folder: Path) -> int:
    _require_tests(folder)
    junit = writable(args.junit) if args.junit else None
    place = str(folder.absolute())
    task = _chosen(RunTask(place, False, keyword=args.keyword, simulated=args.simulated))
    if args.list:
        return _list(_Run(task, quiet=True).found, folder, as_json=args.json)
    if not (args.yes or args.simulated):
        found = _Run(task, quiet=True).found.tests
        chosen = [test for test in found if task.names is None or test.name in task.names]
        _ask([test for test in chosen if test.risk == "moves"])
    done = _Run(msgspec.structs.replace(task, run=True), quiet=args.json)
    problems = done.found.problems
    if not (done.results or problems or done.interrupted):
        raise UsageError("no test is chosen", f"amberbox test {args.where} --list")
    if junit is not None:
        junit.write_text(junit_xml(_robot(folder), done.results, problems), encoding="utf-8")
    if args.json:
        print_json(msgspec.to_builtins({"results": done.results, "problems": problems}))
    else:
        print_lines([*_failures(done.results), *_problem_lines(folder, problems)])
        print(_in_words(done.results))
    if not (args.no_answer or args.simulated):
        print_notes(_answered(folder, done.results))
    if done.interrupted:
        return Interrupt.STATUS
    if not done.results:
        return UsageError.exit_code
    return 0 if all(one.outcome in GOOD for one in done.results) and not problems else 1


def _on_server(args: argparse.Namespace) -> int:
    """List the tests that a robot has announced, or run them there, one after the other."""
    given = {"k": args.keyword, "simulated": args.simulated, "no-answer": args.no_answer}
    refuse_options(args.where, given, "name one test, or run all of them")
    junit = writable(args.junit) if args.junit else None
    signer = signer_of(args)
    fleet, robot = robot_at(args.where)
    results: list[UnitTestResult] = []
    with fleet:
        known = fleet.tests(robot)
        chosen = [test.name for test in known if args.name in ("", test.name)]
        if args.list:
            header = ("test", "risk", "at most", "description")
            print_listing(known, msgspec.to_builtins, header, _announced_row, "no tests",
                          as_json=args.json)  # fmt: skip
            return 0 if known else UsageError.exit_code
        if not chosen:
            near = did_you_mean(args.name, [test.name for test in known])
            what = f"{robot} announces no unit test{f' {args.name!r}' if args.name else 's'}{near}"
            raise UsageError(what, f"amberbox test {args.where} --list")
        width, interrupted = max(map(len, chosen)), False
        for name in chosen:
            run = fleet.start_run(robot, test=name).id
            followed = FollowedRun(
                fleet, robot, run, signer, show=lambda text: print_notes([text])
            )  # fmt: skip
            results.append(unit_test_result(fleet, followed.follow()))
            if not args.json:
                print_lines([_line(results[-1], width)])
            interrupted = followed.interrupted
            if interrupted:
                break
    if junit is not None:
        junit.write_text(junit_xml(robot, results), encoding="utf-8")
    if args.json:
        print_json(msgspec.to_builtins({"results": results, "problems": []}))
    else:
        print_lines([*_failures(results), _in_words(results)])
    if interrupted:
        return Interrupt.STATUS
    return 0 if all(one.outcome in GOOD for one in results) else 1


def _announced_row(test: UnitTestLine) -> Sequence[str]:
    return test.name, test.risk, f"{test.timeout_s:g} s", test.description


def _chosen(task: RunTask) -> RunTask:
    """Return the task; a keyword that is the whole name of a test chooses only that one."""
    if "." not in task.keyword:
        return task
    every = _Run(msgspec.structs.replace(task, keyword=""), quiet=True).found.tests
    if all(test.name != task.keyword for test in every):
        return task
    return msgspec.structs.replace(task, keyword="", names=(task.keyword,))


def _answered(folder: Path, results: Sequence[UnitTestResult]) -> list[str]:
    """Store what the results answer to the open diagnosis; return it in words."""
    robot, _ = inspect_folder(folder)
    if robot is None:
        return []
    verdicts = {result.name: result.outcome for result in results}
    given = store_run_answers(robot, "unit_test", verdicts, user_name())
    return [f"{one.test} = {one.answer}: counts in the diagnosis {one.diagnosis}" for one in given]


def _require_tests(folder: Path) -> None:
    """Raise UsageError if there is nothing to run, or nothing to run it with."""
    if not folder.is_dir():
        hint = "the folder of a robot, or its page on a server"
        raise UsageError(f"there is no folder '{folder}'", hint)
    if not any(path.suffix == ".py" for path in files_of(folder)):
        hint = f"write one, {FOLDER}/test_NAME.py; 'amberbox new' writes some for a simulated robot"
        raise UsageError(f"there are no tests in {folder / FOLDER}", hint)
    missing = missing_pytest()
    if missing is not None:
        raise UsageError(missing.what, missing.hint)


def _robot(folder: Path) -> str:
    robot, _ = inspect_folder(folder)
    return folder.resolve().name if robot is None else robot.robot.id


class _Run:
    """A run to its end; results are printed as they come."""

    def __init__(self, task: RunTask, *, quiet: bool) -> None:
        self.found = TestCollection()
        self.results: list[UnitTestResult] = []
        self.interrupted = False
        self._quiet, self._width = quiet, 0
        tests = UnitTestRun(task)
        try:
            while not tests.is_over:
                try:
                    for event in tests.wait(_LOOK_S):
                        self._take(event)
                except KeyboardInterrupt:  # what moves is stopped first, however often it comes
                    self.interrupted = True
                    tests.abort("aborted with Ctrl-C")
        finally:
            tests.close()

    def _take(self, event: RunEvent) -> None:
        if isinstance(event, Found):
            self.found = event.collection
            self._width = max(map(len, event.chosen), default=0)
        elif isinstance(event, Progress) and not self._quiet and ":" in event.text:
            print(f"  {event.text}", file=sys.stderr, flush=True)
        elif isinstance(event, Result):
            self.results.append(event.result)
            if not self._quiet:
                print_lines([_line(event.result, self._width)])
                sys.stdout.flush()


def _line(result: UnitTestResult, width: int) -> str:
    time = f"{result.duration_s:.2f} s"
    measured = ", ".join(f"{m.name} {m.value:.4g} {m.unit}".rstrip() if isinstance(m.value, float)
                         else f"{m.name} {m.value} {m.unit}".rstrip()
                         for m in result.measurements)  # fmt: skip
    text = result.message.partition("\n")[0] or measured
    return f"{result.outcome:<7}  {result.name:<{width}}  {time:>9}  {one_line(text)}".rstrip()


def _failures(results: Iterable[UnitTestResult]) -> Iterator[str]:
    """Yield all of a failed test: its traceback, or message, and what it has printed."""
    for result in results:
        if result.outcome in GOOD:
            continue
        yield from ("", f"{result.name}: {result.outcome}")
        yield from (f"  {line}" for line in (result.details or result.message).splitlines())
        if result.output:
            left_out = f", without {result.left_out_bytes} bytes" if result.left_out_bytes else ""
            yield f"  it has printed{left_out}:"
            yield from (f"    {line}" for line in result.output.splitlines())
        yield from (f"  incident {one.incident}: {one.reason}" for one in result.recordings)


def _problem_lines(folder: Path, problems: Sequence[CollectionProblem]) -> Iterator[str]:
    for problem in problems:
        yield f"{folder / (problem.file or FOLDER)}:{problem.line}: {problem.what}"


def _in_words(results: Sequence[UnitTestResult]) -> str:
    """Return how many tests have ended how: ``5 passed, 1 failed``."""
    outcomes = dict.fromkeys(result.outcome for result in results)
    counts = [(sum(r.outcome == outcome for r in results), outcome) for outcome in outcomes]
    return ", ".join(f"{count} {outcome}" for count, outcome in counts) or "no test was run"


def _list(found: TestCollection, folder: Path, *, as_json: bool) -> int:
    if as_json:
        tests = [test.announced() for test in found.tests]
        print_json(msgspec.to_builtins({"tests": tests, "problems": found.problems}))
    elif found.tests:
        header = ("test", "risk", "at most", "description")
        print_lines(in_columns([header, *unit_test_rows(found.tests)], ""))
    elif not found.problems:
        print("no tests")
    if not as_json:
        print_lines(_problem_lines(folder, found.problems))
    return UsageError.exit_code if found.problems or not found.tests else 0


def unit_test_rows(tests: Iterable[UnitTest]) -> list[Sequence[str]]:
    """Return a row for each test: name, risk, longest run, description."""
    return [(test.name, test.risk, f"{test.timeout_s:g} s", test.description) for test in tests]


def _ask(moving: Sequence[UnitTest]) -> None:
    """Ask on the terminal whether the robot may move; raises UsageError if not."""
    if not moving:
        return
    names = ", ".join(test.name for test in moving)
    if not sys.stdin.isatty():
        hint = "--yes says that its way is free; --simulated runs without it; -k chooses others"
        raise UsageError(f"the robot would move: {names}", hint)
    print(f"The robot moves: {names}. Is its way free? [y/N] ", end="", flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise UsageError("not confirmed: no test was run")
