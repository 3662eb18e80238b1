"""Play a record into ROS 1, over ZeroMQ, or to Foxglove, at any speed."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Collection
from dataclasses import dataclass

from amberbox.blackbox.play.player import (
    Player,
    PlayReport,
    PlayTarget,
    RenamedMessages,
    is_command,
    left_out_lines,
)
from amberbox.blackbox.play.ros1 import RosTarget
from amberbox.blackbox.play.zmq import ENDPOINT, ZmqTarget
from amberbox.blackbox.query.foxglove import (
    HOST,
    PORT,
    Frames,
    MergedFrames,
    MessageFrames,
    Playback,
    span_of,
)
from amberbox.blackbox.robot_folder.robot_yaml import PublishOptions
from amberbox.blackbox.sources.ros1.master import is_global_name, master_uri
from amberbox.cli._arguments import add_range_only, add_window, opened, window_of
from amberbox.cli._output import print_json, print_lines, print_notes
from amberbox.cli.foxglove import serve_range
from amberbox.core.errors import UsageError
from amberbox.core.interrupt import called_by_signals
from amberbox.core.types import Topic
from amberbox.monitoring.viewer_findings import FindingFrames

KINDS = ("ros", "zmq", "foxglove")
_FASTEST = 1000.0
_LOOK_S = 0.05


@dataclass(frozen=True)
class PlayPlace:
    """Where to play to: the kind of peer, and its address or port, empty for the usual one."""

    kind: str
    address: str


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("where", metavar="WHERE", help="robot folder, store or recording file")
    parser.add_argument(
        "--to", dest="place", metavar="PEER", required=True,
        help=f"ros, ros=http://HOST:11311; zmq, zmq={ENDPOINT}; foxglove, foxglove={PORT}",
    )  # fmt: skip
    parser.add_argument(
        "--item", action="append", default=[], metavar="NAME",
        help="data item, again for more; without it all, but commands to ROS and ZeroMQ",
    )  # fmt: skip
    parser.add_argument("--with-commands", action="store_true",
                        help="topics that may move a robot, too, such as /cmd_vel")  # fmt: skip
    add_range_only(parser, end="--to-time")
    add_window(parser)
    parser.add_argument("--speed", default="1", metavar="X",
                        help="times the recorded pace, or max: as fast as it is taken")  # fmt: skip
    parser.add_argument("--loop", action="store_true", help="again and again, until Ctrl-C")
    parser.add_argument(
        "--wait", action="store_true", help="begin when somebody subscribes"
    )  # fmt: skip
    parser.add_argument("--prefix", default="", metavar="/NAME",
                        help="put before the name of each topic: /replay/odom")  # fmt: skip
    parser.add_argument("--clock", action="store_true",
                        help="publish the time of the record on /clock (ROS)")  # fmt: skip
    parser.add_argument("--force", action="store_true",
                        help="also topics that other nodes publish at present (ROS)")  # fmt: skip
    parser.add_argument("--start-paused", action="store_true",
                        help="wait for the viewer to play (Foxglove)")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Play to the end, or until Ctrl-C; return 1 if messages were dropped or are missing."""
    place, speed = _place(args.place), _speed(args.speed)
    _check(args, place, speed)
    stop = threading.Event()
    with opened(args.where) as record, called_by_signals(stop.set):
        window = window_of(args, record)
        frames = MessageFrames(record, args.item, window)
        span = frames.current.ask(lambda catalogue: span_of(catalogue, window))
        # what is recorded from now on is not played
        frames.window = (span[0], span[1] + 1 if window[1] is None else window[1])
        known = list(frames.report.missing)
        print_notes(known)
        source: Frames = frames
        if place.kind == "foxglove" and not args.item:
            source = MergedFrames([frames, FindingFrames(record, frames.window)])
        source = RenamedMessages(source, args.prefix) if args.prefix else source
        if place.kind == "foxglove":
            playback = Playback(source, span, speed or 1.0, loop=args.loop)
            if args.start_paused:
                playback.pause()
            args.host, args.port = HOST, _port(place.address)
            serve_range(args, playback, record.path.name, stop)
            return 0
        target = _target(args, place, stop)
        allowed = bool(args.item) or args.with_commands
        chosen, left_out = choose_topics(source.topics, target, allowed)
        report = PlayReport(left_out=left_out)
        player = Player(source, span, target, frozenset(chosen), speed, args.loop, report)
        _play(args, player, chosen, stop)
        print_notes(text for text in frames.report.missing if text not in known)
    if args.json:
        print_json(report.to_json())
    else:
        print_lines(report.lines())
    return int(bool(report.dropped or frames.report.missing))


def choose_topics(
    topics: Collection[Topic], target: PlayTarget, with_commands: bool
) -> tuple[list[Topic], dict[str, str]]:
    """Return the topics that are played, and why the others are left out, by name.

    Raises UsageError when none is left.
    """
    left_out, chosen = dict[str, str](), list[Topic]()
    for topic in topics:
        why = target.refused(topic)
        if not why and not with_commands and is_command(topic):
            why = "it may move a robot; name it with --item, or use --with-commands"
        if why:
            left_out[topic.name] = why
        else:
            chosen.append(topic)
    if not chosen:
        reasons = [line.strip() for line in left_out_lines(left_out)]
        what = "none of the recorded messages can be played there"
        raise UsageError(what, reasons[0] if reasons else "'amberbox items WHERE' lists them")
    return chosen, left_out


def _play(
    args: argparse.Namespace, player: Player, chosen: list[Topic], stop: threading.Event
) -> None:
    try:
        player.target.open(chosen)
        if not args.json:
            topics = f"{len(chosen)} topic{'' if len(chosen) == 1 else 's'}"
            text = f"playing {topics} of {args.where} to {args.place}; Ctrl-C ends"
            print(text, file=sys.stderr, flush=True)
        while args.wait and not player.target.is_heard() and not stop.wait(_LOOK_S):
            pass
    except BaseException:
        was_ended = stop.is_set()
        stop.set()  # nothing has to be waited for
        player.target.close()
        if was_ended:  # by Ctrl-C, while it waited
            return
        raise
    player.run(stop)


def _place(text: str) -> PlayPlace:
    kind, _, address = text.partition("=")
    if kind not in KINDS:
        hint = "--to ros, zmq or foxglove; the end of the range is --to-time"
        raise UsageError(f"'{text}' is no peer to play to", hint)
    return PlayPlace(kind, address)


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0 < speed <= _FASTEST:
        raise UsageError(f"'{text}' is no speed", f"write --speed 10, up to {_FASTEST:g}, or max")
    return speed


def _check(args: argparse.Namespace, place: PlayPlace, speed: float | None) -> None:
    """Raise UsageError for options that do not go with the peer."""
    of_kind = {"clock": "ros", "force": "ros", "start_paused": "foxglove"}
    for name, kind in of_kind.items():
        if getattr(args, name) and place.kind != kind:
            raise UsageError(f"--{name.replace('_', '-')} goes with --to {kind}")
    if place.kind == "foxglove" and speed is None:
        what = "viewers do not tell when they are too slow, so there is no --speed max for them"
        raise UsageError(what, f"choose a speed up to {_FASTEST:g}")
    if args.prefix and place.kind == "ros" and not is_global_name(args.prefix.rstrip("/")):
        raise UsageError(f"'{args.prefix}' is not a name that ROS allows", "--prefix /replay")
    _port(place.address if place.kind == "foxglove" else "")


def _port(text: str) -> int:
    port = int(text) if text.isdecimal() else -1 if text else PORT
    if not 0 <= port < 1 << 16:
        raise UsageError(f"there is no port {text}", "choose one from 1024 to 65535")
    return port


def _target(args: argparse.Namespace, place: PlayPlace, stop: threading.Event) -> PlayTarget:
    if place.kind == "zmq":
        socket = PublishOptions(place.address or ENDPOINT)
        for _, problem in socket.check():
            raise UsageError(problem, f"--to zmq={ENDPOINT}")
        if not socket.is_local:
            print_notes([f"everybody who reaches {socket.url} can read what is played"])
        return ZmqTarget(socket.url, stop)
    try:
        uri = master_uri(place.address) if place.address else ""
    except ValueError as error:
        raise UsageError(f"{place.address}: {error}", "write --to ros=http://HOST:11311") from error
    return RosTarget(uri, args.clock, args.force, stop)
