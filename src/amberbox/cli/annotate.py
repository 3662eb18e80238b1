"""Notes of people on a robot's record, at the robot or on its server: write, list, change them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.blackbox.retention.notes import annotate, change_note
from amberbox.cli._arguments import (
    PAGE,
    accept_relative_times,
    add_robot,
    check_time,
    opened,
    robot_at,
    time_of,
    user_name,
)
from amberbox.cli._output import print_json, print_listing
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.notes import CAUSE, NO_CAUSE, RecordedNote
from amberbox.diagnosis.fmea.loader import FILE, load_fmea

if TYPE_CHECKING:
    from amberbox.client.models import MomentNote

_USAGE = (
    "amberbox annotate WHERE TEXT [--at T | --from T --to T] [--about ITEM | --cause MODE], "
    "list WHERE, "
    "change WHERE ID TEXT, withdraw WHERE ID"
)
_WORDS = {"list": 0, "change": 2, "withdraw": 1}  # words after WHERE
_HEADER = ("id", "at (UTC)", "until", "who", "about", "text")
_TIMES = "ISO (UTC), epoch, -10m before the last record, now or now-10m"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    accept_relative_times(parser)
    parser.add_argument(
        "words", nargs="+", metavar="[ACTION] WHERE",
        help=f"robot folder or store, or {PAGE}; then the text of a note. Before WHERE: list, "
        "change or withdraw, then the ID of a note, and its new text",
    )  # fmt: skip
    add_robot(parser)
    parser.add_argument("--at", metavar="T", help=f"the moment; now without: {_TIMES}")
    parser.add_argument("--from", dest="from_", metavar="T", help="instead: start of a range")
    parser.add_argument("--to", metavar="T", help="end of the range, not included")
    parser.add_argument(
        "--about", "--item", "--component", default="", metavar="NAME",
        help="an item, a variable or a component",
    )  # fmt: skip
    parser.add_argument(
        "--cause",
        default="",
        metavar="MODE",
        help="what it was in the end: a failure mode (component#mode), or none for a false alarm; "
        "at a moment it is about the last diagnosis before it",
    )
    parser.add_argument("--who", default="", metavar="NAME", help="who writes; else the user")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parse = parser.parse_intermixed_args

    def parse_args(arguments: Sequence[str]) -> argparse.Namespace:
        parsed = parse(arguments)
        parsed.action, parsed.where, parsed.rest = _split(parsed.words)
        return parsed

    vars(parser)["parse_args"] = parse_args


def _split(words: Sequence[str]) -> tuple[str, str, Sequence[str]]:
    """Return action, WHERE and the words after it; ``WHERE ACTION`` is accepted, too."""
    if len(words) == 1:
        if words[0] in _WORDS:
            raise UsageError(f"annotate {words[0]} needs WHERE", _USAGE)
        return "list", words[0], ()
    for action, where in (words[:2], words[1::-1]):
        if _WORDS.get(action) == len(words) - 2:
            return action, where, words[2:]
    if words[0] in _WORDS or len(words) > 2:
        raise UsageError("these words are no note: put its text in quotes", _USAGE)
    return "add", words[0], words[1:]


def run(args: argparse.Namespace) -> int:
    """Run the action; with a text alone, write a note."""
    if args.at is not None and (args.from_ is not None or args.to is not None):
        raise UsageError("a note is on a moment or on a range", "--at T, or --from T --to T")
    if args.action == "add" and args.to is not None and args.from_ is None:
        raise UsageError("a range has a beginning", "--from T --to T")
    if args.cause:
        args.about = _about_cause(args)
    if args.action in ("change", "withdraw") and (args.at or args.from_ or args.about):
        raise UsageError(f"annotate {args.action} keeps time and place", _USAGE)
    if is_url(args.where):
        if args.who:
            raise UsageError("on a server it is who the token belongs to", "leave out --who")
        _run_on_server(args)
    else:
        _ACTIONS[args.action](args)
    return 0


def _about_cause(args: argparse.Namespace) -> str:
    """Return what a note about a cause is about; its failure mode must be one of the folder's."""
    if args.about:
        raise UsageError("a note is about one thing", "--about ITEM, or --cause MODE")
    path = Path(args.where) / FILE
    if args.action == "add" and args.cause != NO_CAUSE and path.is_file():
        fmea, _ = load_fmea(path)
        if fmea is not None and args.cause not in fmea.modes:
            near = did_you_mean(args.cause, fmea.modes)
            what = f"there is no failure mode '{args.cause}'{near}"
            raise UsageError(what, f"amberbox fmea table {args.where} lists them")
    return f"{CAUSE}{args.cause}"


def _add(args: argparse.Namespace) -> None:
    with opened(args.where) as record:
        at_ns = time_of("--at", args.at or args.from_ or "now", record.time_ns)
        to_ns = time_of("--to", args.to, record.time_ns)
    assert at_ns is not None
    who = args.who or user_name()
    _print(annotate(args.where, args.rest[0], at_ns, to_ns, who=who, about=args.about), args)


def _list(args: argparse.Namespace) -> None:
    with opened(args.where) as record:
        notes = record.annotations(args.from_ or args.at, args.to)
    found = [note for note in notes if args.about in ("", note.about)]
    print_listing(found, RecordedNote.to_json, _HEADER, _row, "no notes", as_json=args.json)


def _change(args: argparse.Namespace) -> None:
    note_id, text = args.rest
    _print(change_note(args.where, note_id, text, who=args.who or user_name()), args)


def _withdraw(args: argparse.Namespace) -> None:
    who = args.who or user_name()
    _print(change_note(args.where, args.rest[0], who=who, withdrawn=True), args)


_ACTIONS: dict[str, Callable[[argparse.Namespace], None]] = {
    "add": _add, "list": _list, "change": _change, "withdraw": _withdraw,
}  # fmt: skip


def _print(note: RecordedNote, args: argparse.Namespace) -> None:
    if args.json:
        print_json(note.to_json())
    else:
        print(f"{note.id}: {'withdrawn' if note.withdrawn else 'written into the record'}")


def _row(note: RecordedNote) -> tuple[Any, ...]:
    shown = note.to_json()
    text = " ".join(note.text.split())
    return note.id, shown["at"][:19], (shown["to"] or "")[:19], note.who, note.about, text


def _run_on_server(args: argparse.Namespace) -> None:
    for option in ("at", "from_", "to"):
        check_time(f"--{option.strip('_')}", getattr(args, option))
    fleet, robot = robot_at(args.where)
    begin = args.at or args.from_
    with fleet:
        if args.action == "list":
            listed = fleet.notes(robot, begin, args.to)[::-1]
            found = [note for note in listed if args.about in ("", note.about)]
            print_listing(
                found, msgspec.to_builtins, _HEADER, _server_row, "no notes", as_json=args.json
            )
            return
        if args.action == "add":
            note = fleet.annotate(robot, args.rest[0], begin, args.to, args.about)
        elif args.action == "change":
            note = fleet.change_note(robot, *args.rest)
        else:
            note = fleet.withdraw_note(robot, *args.rest)
    if args.json:
        print_json(msgspec.to_builtins(note))
    else:
        print(f"{note.note}: {'withdrawn' if args.action == 'withdraw' else 'written'}")


def _server_row(note: MomentNote) -> tuple[Any, ...]:
    text = " ".join(note.text.split())
    return note.note, note.at[:19], (note.to or "")[:19], note.who, note.about, text
