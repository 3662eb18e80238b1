"""The program ``amberbox``: the table of its verbs, and the run of one; errors as two lines.

A file of one verb defines ``configure`` and ``run``, a file of several ``configure_VERB`` and
``run_VERB``.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from types import ModuleType
from typing import NoReturn

from amberbox.core.errors import AmberboxError, ConfigurationError, UsageError, did_you_mean
from amberbox.core.interrupt import Interrupt
from amberbox.core.plugins import Plugin, entry_points_of
from amberbox.core.safe_text import terminal_safe
from amberbox.core.version import __version__

# verb, the file that defines it, its summary
_EVERYDAY = (
    ("new", "new",
     "Start a robot folder: from a sample, or from a robot that runs, with monitors that work."),
    ("check", "folder",
     "Judge a robot folder without touching a device; show what would be recorded and monitored."),
    ("record", "record",
     "Record a robot: listen to everything its black_box.yaml names and keep it."),
    ("watch", "watch",
     "Watch a robot's record: monitor and diagnose it live, once, or over what is recorded."),
    ("run", "box",
     "Run the whole box on a robot: record, keep, monitor, and start again whatever dies."),
    ("status", "status",
     "Say how a robot and its components are, as its watcher sees them now; wait for one of them."),
    ("query", "query",
     "Print the variables of a data item as a table, CSV, JSON or Parquet."),
    ("plot", "plot",
     "Draw variables over time: PNG, SVG or PDF, or an HTML page with zoom that needs no network."),
    ("incident", "incident",
     "Mark an incident so that its window of the record is kept; list, show, release them."),
    ("diagnose", "diagnose",
     "Say what is broken: one ranked answer with reasons, and what to look at next."),
    ("experiment", "experiment",
     "Check and draw experiments, carry one out with the robot, show and compare its runs."),
    ("serve", "serve",
     "Run the fleet's server: robots send it what they recorded, people see all of it."),
)  # fmt: skip
_MORE = (
    ("act", "command",
     "Take commands for a robot and carry them out, until it is stopped; 'run' keeps it going."),
    ("action", "action",
     "List the actions of a robot; carry one out by hand, at the robot or simulated."),
    ("alarm", "alarm",
     "List the alarms of a robot; acknowledge one, or shelve it for some time."),
    ("annotate", "annotate",
     "Write a note into a robot's record, at a moment or on a range; list, change, withdraw them."),
    ("command", "fleet_command",
     "Send a command to a robot by its server, follow, confirm or abort it; list commands."),
    ("confirm", "command",
     "Confirm, at the robot, the motion that somebody has ordered; see what runs, and stop it."),
    ("consistency", "consistency",
     "Diagnose a model of components or a circuit: which modes agree with what was observed."),
    ("demo", "demo",
     "Show it all: a server, three simulated robots in the browser, and a button that breaks "
     "them."),
    ("detect", "detect",
     "Detect what a model of nominal operation does not know, live or in what is recorded."),
    ("doctor", "doctor",
     "Examine the box: clock, disk, wear, power, service, keys, versions; say what to improve. Or "
     "listen to what is on the buses."),
    ("evaluate", "evaluate",
     "Evaluate the detectors of a model on a record with labelled faults."),
    ("events", "listings",
     "List what happened to the box: starts, recoveries, sources in trouble, a full disk."),
    ("export", "export",
     "Export a view of a record: CSV, Parquet, MCAP, or a ROS 1 bag."),
    ("faulttree", "faulttree",
     "Solve fault trees, compiled or of a file: minimal cut sets, exact probability, what "
     "matters."),
    ("fetch", "export",
     "Ask a robot, by its server, for a window of its record that was not copied; list such "
     "windows."),
    ("fmea", "fmea",
     "Judge what can fail: check the FMEA, show its sheet, what matters most, what nobody sees."),
    ("foxglove", "foxglove",
     "Serve a record, live or a time range, to Foxglove and other viewers."),
    ("gaps", "listings",
     "List what is missing from a record: from when to when, and why."),
    ("import", "export",
     "Import recordings: bags, MCAP, ULog, CSV and mongodump folders become part of a store."),
    ("install-service", "box",
     "Make this computer record a robot folder from its start on, as a service of systemd."),
    ("items", "listings",
     "List what was recorded: data items with rows, rates and times."),
    ("join", "box",
     "Make a robot report to a server, by the line that the server printed for it."),
    ("learn", "learn",
     "Learn from nominal missions what is normal: a model file, and monitors with limits."),
    ("link", "box",
     "Link a robot to its server: tell it what is concluded, copy journals, until it is stopped."),
    ("mirror", "box",
     "Copy items of a robot's record to a MongoDB as they come, until it is stopped."),
    ("mission", "mission",
     "List the missions of a record, begin and end one by hand, find them in old recordings."),
    ("model", "model",
     "List models of detectors on a server, save or install one, run one there, delete one."),
    ("play", "play",
     "Play a record into ROS 1, over ZeroMQ, or to Foxglove, at any speed."),
    ("plugins", "plugins",
     "List sources, monitor modes, probes and kinds of actions, or explain one of them."),
    ("probe", "probe",
     "Look at what only the robot's computer can see, and publish it for a box elsewhere."),
    ("rules", "rules",
     "Check rules of an expert system, ask them, show why and why not, export them for "
     "SWI-Prolog."),
    ("sign", "sign",
     "Make one's key for commands; sign, on one's own computer, what waits for a signature."),
    ("sign-in", "sign_in",
     "Keep a token of a server here, and whom to trust there, so that its address can be WHERE."),
    ("sign-out", "sign_in",
     "Forget a server's token that ``sign-in`` kept here."),
    ("sql", "query",
     "Ask the record in SQL: one view per data item (DuckDB)."),
    ("structure", "structure",
     "Analyse a model of equations: which faults can be detected and told apart, and by what."),
    ("test", "test",
     "Run the unit tests of a robot's folder, or list them: what the record shows, what it does."),
    ("tf", "tf",
     "Show the coordinate frames of a record: a tree with rates and ages, or one transform."),
    ("verify", "verify",
     "Verify a record: what is as the robot left it, and what is damaged, altered or missing."),
)  # fmt: skip
_BROKEN_PIPE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status."""
    with redirect_stdout(terminal_safe(sys.stdout)), redirect_stderr(terminal_safe(sys.stderr)):
        try:
            return _run(list(sys.argv[1:] if arguments is None else arguments))
        except SystemExit as request:  # argparse, after it has printed a help page
            return request.code if isinstance(request.code, int) else 2
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return _BROKEN_PIPE
        except KeyboardInterrupt:
            return Interrupt.STATUS
        except Exception as error:
            return Interrupt.STATUS if _interrupted() else _failed(error)


def _interrupted() -> bool:
    """Return whether an error was caused by Ctrl-C."""
    handler = signal.getsignal(signal.SIGINT)
    return isinstance(handler, Interrupt) and handler.came


def _failed(error: Exception) -> int:
    """Print an error as two lines; return the exit status."""
    if os.environ.get("AMBERBOX_DEBUG", "") not in ("", "0"):
        traceback.print_exc()
    if isinstance(error, AmberboxError):
        _report(error)
        return error.exit_code
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        _report(AmberboxError(f"{place}{error.strerror or error}"))
        return 1
    # a defect of amberbox: no bare traceback for the user
    hint = "this is a defect of amberbox; AMBERBOX_DEBUG=1 shows where it happened"
    _report(AmberboxError(f"{type(error).__name__}: {error}", hint))
    return 1


def verbs() -> Mapping[str, Plugin]:
    """Return the verbs, everyday ones first; none of them is imported."""
    table = (*_EVERYDAY, *_MORE)
    own = {verb: Plugin(verb, summary, f"amberbox.cli.{file}") for verb, file, summary in table}
    others = {verb.name.replace("_", "-"): verb for verb in entry_points_of("amberbox.cli")}
    known, everyday = others | own, [verb for verb, _, _ in _EVERYDAY]
    return {name: known[name] for name in (*everyday, *sorted(known.keys() - set(everyday)))}


def help_text() -> str:
    """Return the overview: every verb with its summary."""
    known = verbs()
    width = max(map(len, known))
    lines = [f"  {name:<{width}}  {verb.summary}" for name, verb in known.items()]
    everyday, more = lines[: len(_EVERYDAY)], lines[len(_EVERYDAY) :]
    listing = "\n".join(["every day:", *everyday, "", "more:", *more])
    return (
        "usage: amberbox VERB ... [-v]\n\nA flight recorder and a doctor for robots.\n\n"
        f"{listing}\n\n"
        "amberbox VERB --help explains a verb; --version tells the version.\n"
        "exit status: 0 fine, 1 a problem found, 2 wrong usage or configuration\n"
    )


def _run(arguments: list[str]) -> int:
    verbosity = 0
    while arguments and arguments[0].startswith("-"):
        option = arguments.pop(0)
        if option in ("-h", "--help", "--version"):
            print(f"amberbox {__version__}" if option == "--version" else help_text())
            return 0
        if option.strip("v") != "-":
            raise UsageError(f"unknown option '{option}'", "amberbox --help")
        verbosity += option.count("v")
    if not arguments:
        print(help_text())
        return 2
    return _run_verb(arguments[0], arguments[1:], verbosity)


def _run_verb(name: str, arguments: Sequence[str], verbosity: int) -> int:
    known = verbs()
    if name == "help":
        name, arguments = (arguments or ["help"])[0], ["--help"]
    if name not in known:
        raise UsageError(f"unknown verb '{name}'{did_you_mean(name, known)}", "amberbox --help")
    parser = _Parser(prog=f"amberbox {name}", description=known[name].summary)
    configure, run = _functions(known[name].load(), name.replace("-", "_"))
    configure(parser)
    parser.add_argument("-v", "--verbose", action="count", default=0, help="say more; -vv: all")
    parsed = parser.parse_args(arguments)
    if getattr(parsed, "robot", None):
        from amberbox.cli._arguments import name_robot

        name_robot(parsed)
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbosity + parsed.verbose, 2)]
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s")
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Interrupt):
        handler.loading = False
    status = run(parsed)
    sys.stdout.flush()
    return status


def _functions(
    module: ModuleType, verb: str
) -> tuple[Callable[[argparse.ArgumentParser], None], Callable[[argparse.Namespace], int]]:
    """Return the functions that add a verb's arguments and run it."""
    if hasattr(module, f"run_{verb}"):
        return getattr(module, f"configure_{verb}"), getattr(module, f"run_{verb}")
    return module.configure, module.run


class _Parser(argparse.ArgumentParser):
    """Reports wrong usage in the form of all other errors."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(message, f"{self.prog} --help")


def _report(error: AmberboxError) -> None:
    if isinstance(error, ConfigurationError):
        count = sum(problem.is_error for problem in error.problems)
        what = f"{count} {'error' if count == 1 else 'errors'} in the configuration"
        print(f"{error.what}\nerror: {what}", file=sys.stderr)
    else:
        print(f"error: {error.what}", file=sys.stderr)
    if error.hint:
        print(f"hint: {error.hint}", file=sys.stderr)
