"""Serve a record, live or a time range, to Foxglove and other viewers."""

from __future__ import annotations

import argparse
import sys
import threading

from amberbox.blackbox.query.foxglove import (
    HOST,
    PORT,
    ColumnFrames,
    LiveColumns,
    LiveMessages,
    MergedFrames,
    MessageFrames,
    Playback,
    Server,
    ViewerListener,
    span_of,
)
from amberbox.blackbox.query.foxglove_layout import FILE as LAYOUT
from amberbox.blackbox.query.foxglove_layout import recorded_topics, write_layout
from amberbox.blackbox.store.store import store_path
from amberbox.cli._arguments import add_range_only, opened
from amberbox.cli._arguments import span_of as asked_span
from amberbox.cli._output import print_notes, writable
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time
from amberbox.core.tls import is_loopback
from amberbox.monitoring.viewer_findings import FindingFrames, LiveFindings


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("where", metavar="WHERE", help="robot folder, store or recording file")
    add_range_only(parser)
    parser.add_argument("--live", action="store_true", help="messages as they are recorded")
    parser.add_argument(
        "--item", action="append", default=[], metavar="NAME",
        help="data item, again for more; all without",
    )  # fmt: skip
    parser.add_argument(
        "--columns", action="store_true", help="flat columns as JSON, for tools without the types"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="of the playback (default: 1)"
    )
    parser.add_argument(
        "--layout", nargs="?", const=LAYOUT, metavar="FILE",
        help=f"write a layout for viewers with the panels of this record, and end ({LAYOUT})",
    )  # fmt: skip
    parser.add_argument("--port", type=int, default=PORT, help=f"default: {PORT}")
    parser.add_argument("--host", default=HOST, help=f"address to listen on (default: {HOST})")


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C, or write a layout."""
    _check(args)
    if args.layout is not None:
        with opened(args.where) as record:
            topics = recorded_topics(record, args.item, columns=args.columns)
        path = writable(args.layout)
        write_layout(path, topics)
        print(f"wrote {path}: import it in the viewer's menu of layouts")
        return 0
    stop = threading.Event()
    try:
        if args.live:
            _live(args, stop)
        else:
            _range(args, stop)
    except KeyboardInterrupt:
        stop.set()
        print(file=sys.stderr)
    return 0


def _check(args: argparse.Namespace) -> None:
    if args.live and (args.from_ is not None or args.to is not None):
        raise UsageError("--live goes on from now", "leave out --from and --to, or --live")
    if not 0 < args.speed <= 1000:
        raise UsageError("--speed must be above 0, at most 1000", "1 is the original speed")
    if not 0 <= args.port < 1 << 16:
        raise UsageError(f"there is no port {args.port}", "choose one from 1024 to 65535")
    if not is_loopback(args.host):
        print_notes(
            [
                f"everybody who reaches {args.host}:{args.port} can read this record: the protocol "
                "has no login"
            ]
        )


def _live(args: argparse.Namespace, stop: threading.Event) -> None:
    path, server = store_path(args.where), Server(ViewerListener())
    source = (LiveColumns if args.columns else LiveMessages)(path, args.item)
    source.prepare(server)
    findings = LiveFindings(path)
    finding = threading.Thread(target=findings.run, args=(server, stop), daemon=True)
    if not args.item:
        findings.prepare(server)
    server.start(f"amberbox {path.name}", args.host, args.port)
    try:
        _greet(args, server, "live")
        if not args.item:
            finding.start()
        source.run(server, stop)
    finally:
        stop.set()
        server.stop()


def _range(args: argparse.Namespace, stop: threading.Event) -> None:
    with opened(args.where) as record:
        window = asked_span(args, record)
        frames = (ColumnFrames if args.columns else MessageFrames)(record, args.item, window)
        span = frames.current.ask(lambda catalogue: span_of(catalogue, window))
        print_notes(frames.report.missing)
        parts = [frames] if args.item else [frames, FindingFrames(record, window)]
        serve_range(args, Playback(MergedFrames(parts), span, args.speed), record.path.name, stop)


def serve_range(
    args: argparse.Namespace, playback: Playback, name: str, stop: threading.Event
) -> None:
    """Serve a range to viewers, who control its playback, until stopped."""
    server, span = Server(ViewerListener(playback.control)), playback.span
    for topic in playback.frames.topics:
        server.advertise(topic)
    server.start(f"amberbox {name}", args.host, args.port, span)
    try:
        _greet(args, server, f"{format_time(span[0])} to {format_time(span[1])}")
        playback.run(server, stop)
    finally:
        server.stop()


def _greet(args: argparse.Namespace, server: Server, what: str) -> None:
    host = f"[{args.host}]" if ":" in args.host else args.host
    print(f"serving {args.where}, {what}, at ws://{host}:{server.websocket.port}")
    print("open this address in Foxglove or Lichtblick; Ctrl-C ends", flush=True)
