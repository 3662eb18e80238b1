"""Record a robot: listen to everything its black_box.yaml names and keep it."""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict

from amberbox.blackbox.recorder.recorder import Recorder, RecorderState
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli._output import warn_readable
from amberbox.core.files import keep_to_group
from amberbox.core.interrupt import called_by_signals
from amberbox.core.safe_text import OWN_ESCAPE
from amberbox.core.systemd import is_service
from amberbox.core.units import bytes_text, in_unit

_TABLE_S = 1.0
_NO_TROUBLE = {"started", "stopped", "source_ended", "imported", "power_mains"}
_EXIT = (
    "exit status: 0 recorded, 1 nothing was heard, 2 wrong usage or configuration. As a service "
    "of systemd it is 0 also if nothing was heard: a robot that was off is no failure of the box."
)
_HEADINGS = ("item", "rate Hz", "kept", "filtered", "dropped", "bytes")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("folder", metavar="FOLDER", help="robot folder")
    parser.add_argument(
        "--for", dest="duration", metavar="TIME", type=_seconds,
        help="stop by itself after this long, such as 30s or 5 min",
    )  # fmt: skip
    parser.add_argument(
        "--json", action="store_true", help="one JSON object per second instead of the table"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing while recording")
    parser.epilog = _EXIT


def run(args: argparse.Namespace) -> int:
    """Record until stopped by a signal, by ``--for``, or by the end of all inputs."""
    keep_to_group()
    folder = load_folder(args.folder)
    warn_readable(folder.store_path)
    recorder = Recorder(folder)
    recorder.pipeline.on_event = print_event
    with called_by_signals(recorder.stop.set):
        return _run(recorder, args)


def _run(recorder: Recorder, args: argparse.Namespace) -> int:
    if args.duration is not None:
        timer = threading.Timer(args.duration, recorder.stop.set)
        timer.daemon = True
        timer.start()
    view = threading.Thread(target=_watch, args=(recorder, args), daemon=True)
    if not args.quiet:
        view.start()
    started = time.monotonic()
    recorder.run()
    state = recorder.state()
    if not args.quiet:
        view.join(2 * _TABLE_S)
        if sys.stdout.isatty() and not args.json:
            print("\n".join(table(state, time.monotonic() - started)), flush=True)
        print(_last_line(state, str(recorder.store.path)), file=sys.stderr)
    if any(item.received for item in state.items):
        return 0
    print("warning: nothing was heard; the events above and amberbox events say why",
          file=sys.stderr)  # fmt: skip
    return 0 if is_service() else 1


def print_event(kind: str, text: str) -> None:
    """Print an event about a problem to stderr; the record holds all events."""
    if kind not in _NO_TROUBLE:
        with suppress(OSError):  # stderr may be closed; recording goes on
            # in one piece: events come from several threads
            sys.stderr.write(f"{time.strftime('%H:%M:%S')} {kind}: {text}\n")
            sys.stderr.flush()


def _seconds(text: str) -> float:
    try:
        return float(in_unit(text, "s"))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{text}' {error}") from None


def _watch(recorder: Recorder, args: argparse.Namespace) -> None:
    """Print the state of the recorder every second, until stdout is closed."""
    with suppress(BrokenPipeError):
        lines, started = 0, time.monotonic()
        while not recorder.stop.wait(_TABLE_S):
            state = recorder.state()
            if args.json:
                print(json.dumps(asdict(state)), flush=True)
            elif sys.stdout.isatty():
                rows = table(state, time.monotonic() - started)
                up = f"{OWN_ESCAPE}[{lines}A" if lines else ""
                print(up + "".join(f"{OWN_ESCAPE}[K{row}\n" for row in rows), end="", flush=True)
                lines = len(rows)
            elif round(time.monotonic() - started) % 10 == 0:
                print(summary(state), flush=True)


def table(state: RecorderState, elapsed_s: float) -> list[str]:
    """Return the live table as lines of text."""
    rows = [_HEADINGS, *(
        (i.name, f"{i.rate_hz:.1f}", str(i.kept), str(i.filtered), str(i.dropped),
         bytes_text(i.bytes))
        for i in state.items
    )]  # fmt: skip
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
    lines = [
        row[0].ljust(widths[0])
        + "".join("  " + c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))
        for row in rows
    ]
    foot = f"{elapsed_s:.0f} s, written {bytes_text(state.written_bytes)}, "
    foot += f"queue {bytes_text(state.queue_bytes)}, disk left {bytes_text(state.disk_free_bytes)}"
    return [*lines, foot, *_trouble(state)]


def summary(state: RecorderState) -> str:
    """Return the summary of the table in one line."""
    kept = sum(item.kept for item in state.items)
    dropped = sum(item.dropped for item in state.items)
    rate = sum(item.rate_hz for item in state.items)
    text = f"{len(state.items)} items, {rate:.0f} messages/s, {kept} kept, {dropped} dropped, "
    text += f"{bytes_text(state.written_bytes)} written, {bytes_text(state.disk_free_bytes)} left"
    return "; ".join([text, *_trouble(state)])


def _trouble(state: RecorderState) -> list[str]:
    """Return lines about a full or failing disk."""
    full = [f"{state.full.upper()}: only events are recorded"] if state.full else []
    return [*full, f"DISK: {state.disk_error}"] if state.disk_error else full


def _last_line(state: RecorderState, store: str) -> str:
    kept = sum(item.kept for item in state.items)
    return f"recorded {kept} messages of {len(state.items)} items in {store}"
