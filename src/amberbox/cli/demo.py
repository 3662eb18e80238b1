"""Show it all: a server, three simulated robots in the browser, and a button that breaks them."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from amberbox.cli.serve import check_installed
from amberbox.core.errors import UsageError

SECONDS = 45.0  # length of the scripted story where stdout is no terminal
_LEAST_S, _RECORDER_S = 8.0, 20.0
_PORT = 8443
_EXIT = "exit status: 0 it was ended, or every step of the story worked; 1 one did not"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "--seconds", type=float, default=os.environ.get("DEMO_SECONDS") or None, metavar="N",
        help="go through the story alone, in about so long (DEMO_SECONDS); without it and on a "
        "terminal: stay until Ctrl-C",
    )  # fmt: skip
    parser.add_argument("--port", type=int, default=_PORT,
                        help=f"port to listen at, or the next that is free ({_PORT})")  # fmt: skip
    parser.add_argument("--keep", type=Path, metavar="DIR",
                        help="a new folder for server and robots, which stays (default: one that "
                        "goes at the end)")  # fmt: skip
    parser.add_argument("--recorder", action="store_true", help="show the black box alone: it is "
                        "killed and loses nothing, its record proves itself")  # fmt: skip
    parser.epilog = _EXIT


def run(args: argparse.Namespace) -> int:
    """Run the demonstration; return 0 only if every step worked."""
    if args.seconds is not None and args.seconds < _LEAST_S:
        raise UsageError("the demonstration needs at least 8 seconds", "DEMO_SECONDS=45")
    with _place(args.keep, keep=args.recorder) as place:
        if args.recorder:
            from amberbox.demo import recorder

            return recorder.run(place, args.seconds or _RECORDER_S)
        check_installed()
        from amberbox.demo import show

        return show.run(place, args.port, _seconds(args.seconds))


def _seconds(given: float | None) -> float | None:
    """Return the length of the scripted story in seconds; None on a terminal: run until Ctrl-C."""
    return SECONDS if given is None and not sys.stdout.isatty() else given


@contextmanager
def _place(wanted: Path | None, *, keep: bool) -> Iterator[Path]:
    """Yield an empty folder; a temporary one is removed afterwards."""
    place = wanted or Path(tempfile.mkdtemp(prefix="amberbox-demo-"))
    place.mkdir(parents=True, exist_ok=True)
    if any(place.iterdir()):
        raise UsageError(f"{place} is not empty", "name a new folder, or none")
    try:
        yield place.resolve()
    finally:
        if wanted is None and not keep:
            shutil.rmtree(place, ignore_errors=True)
