"""The program ``amberbox``: find the verb, run it, say what went wrong in two lines."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from typing import NoReturn

from amberbox import __version__
from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError, ConfigurationError, UsageError
from amberbox.core.interrupt import Interrupt
from amberbox.core.plugins import Plugin, find
from amberbox.core.terminal import harmless

EVERYDAY = (
    *("new", "check", "record", "watch", "run", "status"),
    *("query", "plot", "incident", "diagnose", "experiment", "serve"),
)
_BROKEN_PIPE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status."""
    with redirect_stdout(harmless(sys.stdout)), redirect_stderr(harmless(sys.stderr)):
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
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
    """Tell whether Ctrl-C is what an error came of."""
    handler = signal.getsignal(signal.SIGINT)
    return isinstance(handler, Interrupt) and handler.came


def _failed(error: Exception) -> int:
    """Say what went wrong; return the exit status."""
    _show_trace()
    if isinstance(error, AmberboxError):
        _report(error)
        return error.exit_code
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        _report(AmberboxError(f"{place}{error.strerror or error}"))
        return 1
    # a defect of ours: never a bare traceback for the user
    hint = "this is a defect of amberbox; AMBERBOX_DEBUG=1 shows where it happened"
    _report(AmberboxError(f"{type(error).__name__}: {error}", hint))
    return 1


def verbs() -> Mapping[str, Plugin]:
    """Find the verbs, everyday ones first; none of them is imported."""
    files = find("amberbox.cli", defines=("configure", "run"))
    found = {name.replace("_", "-"): verb for name, verb in files.items()}
    everyday = [name for name in EVERYDAY if name in found]
    rest = [name for name in found if name not in everyday]
    return {name: found[name] for name in (*everyday, *rest)}


def help_text() -> str:
    """Return the overview: every verb with the first line of its file."""
    known = verbs()
    width = max((len(name) for name in known), default=0)
    lines = [f"  {name:<{width}}  {verb.summary}" for name, verb in known.items()]
    everyday = sum(name in EVERYDAY for name in known)
    groups = [("every day:", lines[:everyday]), ("more:", lines[everyday:])]
    listing = "\n\n".join("\n".join([title, *rows]) for title, rows in groups if rows)
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
    module = known[name].load()
    parser = _Parser(prog=f"amberbox {name}", description=known[name].summary)
    module.configure(parser)
    parser.add_argument("-v", "--verbose", action="count", default=0, help="say more; -vv: all")
    parsed = parser.parse_args(arguments)
    if getattr(parsed, "robot", None):
        from amberbox.cli._server import name_robot

        name_robot(parsed)
    _set_up_logging(verbosity + parsed.verbose)
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Interrupt):
        handler.loading = False
    status: int = module.run(parsed)
    sys.stdout.flush()
    return status


class _Parser(argparse.ArgumentParser):
    """Reports wrong usage as all other errors are reported."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(message, f"{self.prog} --help")


def _set_up_logging(verbosity: int) -> None:
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbosity, 2)]
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s")


def _report(error: AmberboxError) -> None:
    if isinstance(error, ConfigurationError):
        count = sum(problem.is_error for problem in error.problems)
        what = f"{count} {'error' if count == 1 else 'errors'} in the configuration"
        print(f"{error.what}\nerror: {what}", file=sys.stderr)
    else:
        print(f"error: {error.what}", file=sys.stderr)
    if error.hint:
        print(f"hint: {error.hint}", file=sys.stderr)


def _show_trace() -> None:
    if os.environ.get("AMBERBOX_DEBUG", "") not in ("", "0"):
        traceback.print_exc()
