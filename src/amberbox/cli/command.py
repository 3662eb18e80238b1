"""Commands at the robot: the process that carries them out, and the confirmation of motions."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec

from amberbox.agent.command_socket import (
    SiteAborts,
    SiteAsks,
    SiteConfirms,
    SiteConnection,
    SiteState,
)
from amberbox.blackbox.robot_folder.folder import load_folder, store_of
from amberbox.blackbox.store.store import WriterLock, create_store
from amberbox.cli._output import print_lines, print_notes
from amberbox.core.errors import UsageError
from amberbox.core.files import keep_to_group
from amberbox.core.interrupt import called_by_signals
from amberbox.core.safe_text import one_line

_WATCH_S = 0.3
_ACT_EXIT = (
    "exit status: 0 after an orderly end, 1 the command log cannot be used, 2 wrong usage or "
    "configuration"
)
_CONFIRM_EXIT = "exit status: 0 done, 1 nothing waits or no process answers, 2 wrong usage"


def configure_act(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument("--quiet", action="store_true", help="print nothing about commands")
    parser.epilog = _ACT_EXIT


def run_act(args: argparse.Namespace) -> int:
    """Take and carry out commands until SIGTERM or Ctrl-C; what runs is stopped safely then."""
    keep_to_group()
    from amberbox.agent.act import WRITER, CommandProcess  # only here: it loads the actions

    folder = load_folder(args.folder)
    store = create_store(folder.store_path)
    lock = WriterLock(store, WRITER)
    stop = threading.Event()
    try:
        with called_by_signals(stop.set):
            CommandProcess(folder, store, log=_nothing if args.quiet else _note).run(stop)
    finally:
        lock.release()
    return 0


def _nothing(text: str) -> None:
    return None


def _note(text: str) -> None:
    print_notes([one_line(text)])


def configure_confirm(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder, on the robot's computer")
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--yes", action="store_true", help="confirm the motion that waits: the "
                        "robot may move at once")  # fmt: skip
    choice.add_argument("--abort", metavar="ID", nargs="?", const="", help="stop a command or a "
                        "run; everything without ID")  # fmt: skip
    choice.add_argument("--watch", action="store_true", help="print a line for each change, for a "
                        "display at the robot")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.epilog = _CONFIRM_EXIT


def run_confirm(args: argparse.Namespace) -> int:
    """Show which motion waits for a confirmation and its code, confirm it, or stop what runs."""
    store = store_of(Path(args.folder))
    if store is None:
        raise UsageError(f"'{args.folder}' is no robot folder", "confirm takes a robot folder")
    connection = SiteConnection(store)
    try:
        if args.watch:
            return _watch(connection, args)
        before = connection.ask(SiteAsks())
        if args.abort is not None:
            before = connection.ask(SiteAborts(args.abort, "somebody at the robot"))
        elif args.yes and before.waiting is not None:
            _print(connection.ask(SiteConfirms(on_site=True)), args)
            return 0
        _print(before, args)
        return 1 if args.yes else 0
    finally:
        connection.close()


def _watch(connection: SiteConnection, args: argparse.Namespace) -> int:
    """Print what changes until Ctrl-C or the end of the process."""
    last: list[str] = []
    while True:
        state = connection.ask(SiteAsks())
        lines = [_json(state)] if args.json else list(_lines(state, timed=False))
        key = [_json(state, timed=False)] if args.json else lines
        if key != last:
            print_lines(lines)
            sys.stdout.flush()
            last = key
        time.sleep(_WATCH_S)


def _print(state: SiteState, args: argparse.Namespace) -> None:
    print_lines([_json(state)] if args.json else list(_lines(state)))


def _json(state: SiteState, *, timed: bool = True) -> str:
    found = msgspec.to_builtins(state)
    if not timed:
        for one in (found["waiting"] or {}, *found["running"]):
            one.pop("left_s", None)
            one.pop("for_s", None)
    return json.dumps(found, ensure_ascii=False)


def _lines(state: SiteState, *, timed: bool = True) -> Iterator[str]:
    waiting = state.waiting
    if waiting is not None:
        within = f", within {waiting.left_s:.0f} s" if timed else ""
        how = f"code {waiting.code}" if waiting.code else "press the button"
        what = f"{waiting.person} orders {waiting.action} {waiting.parameters}"
        yield one_line(f"confirm{within}: {what}: {how}")
    for running in state.running:
        for_s = f" for {running.for_s:.0f} s" if timed else ""
        report = f": {running.report}" if running.report else ""
        yield one_line(f"runs{for_s}: {running.action} of {running.person}{report}")
    lease = state.lease
    run = f" (run {lease.run})" if lease.run else ""
    yield one_line(f"held by {lease.holder}{run}" if lease.holder else "held by nobody")
    if waiting is None and not state.running:
        yield "nothing waits for a confirmation"
