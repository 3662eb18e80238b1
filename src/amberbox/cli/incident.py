"""Mark an incident so that its window of the record is kept; list, show, release them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import Any

from amberbox.blackbox.incidents.budget import held_bytes, held_files
from amberbox.blackbox.incidents.incident import Incident, chosen, load_all, unreadable
from amberbox.blackbox.incidents.marking import mark, release_incident
from amberbox.blackbox.incidents.window import windows_of
from amberbox.blackbox.journal.reserved import PREFIX
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.store import Store, open_store
from amberbox.blackbox.where import store_path
from amberbox.cli._anyorder import add_actions
from amberbox.cli._output import print_grid, print_json, tell
from amberbox.cli._server import PAGE, add_robot
from amberbox.cli._text import in_columns, print_lines
from amberbox.client.address import is_url
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.core.units import in_bytes, parse_duration_s

_USAGE = "amberbox incident [mark] WHERE, list WHERE, show WHERE ID, release WHERE ID"
_HEADER = ("id", "state", "from (UTC)", "seconds", "who", "reason")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE + " [options]"
    words = {"mark": (), **{name: ("ID",)[: count - 1] for name, (_, count) in _ACTIONS.items()}}
    add_actions(parser, words, "mark", f"robot folder or store, or {PAGE}")
    add_robot(parser)
    parser.add_argument("--before", default="60s", metavar="TIME", help="kept from before: 60s")
    parser.add_argument("--after", default="20s", metavar="TIME", help="kept from now on: 20s")
    parser.add_argument("--reason", default="", metavar="TEXT", help="why it is kept")
    parser.add_argument("--who", default="", metavar="NAME", help="who wants it; else the user")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Do what the action says; without one, mark an incident."""
    if args.action == "mark":
        return _mark(args)
    first, rest = args.action, [args.where, *args.rest]
    action, count = _ACTIONS[first]
    if len(rest) != count:
        needed = " ".join(("WHERE", "ID")[:count])
        raise UsageError(
            f"incident {first} needs {needed}", f"{_USAGE}; a folder called {first}: ./{first}"
        )
    if is_url(rest[0]):
        from amberbox.cli._remote_incident import run_remote

        run_remote(first, rest, args.json)
        return 0
    action(rest, args.json)
    return 0


def _mark(args: argparse.Namespace) -> int:
    if args.rest:
        raise UsageError(f"what is '{args.rest[0]}'?", _USAGE)
    before_s, after_s = parse_duration_s(args.before), parse_duration_s(args.after)
    where = args.where
    if is_url(where):
        from amberbox.cli._remote_incident import mark_remote

        mark_remote(args, where)
        return 0
    made = mark(where, before_s=before_s, after_s=after_s, reason=args.reason, who=args.who)
    if args.json:
        print_json(made.to_json())
    else:
        print(f"{made.id}: {_range(made)} is kept")
    return 0


def _list(rest: list[str], as_json: bool) -> None:
    store = open_store(store_path(rest[0]))
    incidents = load_all(store)
    tell(f"{path} cannot be read" for path in unreadable(store))
    if as_json:
        print_json([incident.to_json() for incident in incidents])
    elif incidents:
        print_grid(_HEADER, map(_row, incidents))
        print(f"they hold {in_bytes(held_bytes(store, incidents))}")
    else:
        print("there are no incidents")


def _show(rest: list[str], as_json: bool) -> None:
    store = open_store(store_path(rest[0]))
    incident = chosen(store, rest[1])
    files = _files(store, incident)
    rows = _rows(Record(store.path), incident)
    if as_json:
        found = [{"file": name, "bytes": count} for name, count in files]
        print_json({**incident.to_json(), "bytes": held_bytes(store, [incident]),
                    "files": found, "items": rows})  # fmt: skip
        return
    print_lines(_described(incident, held_bytes(store, [incident])))
    print_lines(["files:", *in_columns([(name, in_bytes(count)) for name, count in files])])
    print_lines(["items:", *in_columns([(name, f"{n} rows") for name, n in rows.items()])])


def _release(rest: list[str], as_json: bool) -> None:
    released = release_incident(*rest)
    if as_json:
        print_json(released.to_json())
    else:
        print(f"{released.id} is released: its window is kept no longer than the rest")


_ACTIONS: dict[str, tuple[Callable[[list[str], bool], None], int]] = {
    "list": (_list, 1),
    "show": (_show, 2),
    "release": (_release, 2),
}


def _row(incident: Incident) -> tuple[Any, ...]:
    state = "confirmed" if incident.confirmed and incident.is_pinned else incident.state
    seconds = f"{(incident.to_ns - incident.from_ns) / NS:.1f}"
    start = format_time(incident.from_ns)[:19]
    return incident.id, state, start, seconds, incident.who, incident.text


def _range(incident: Incident) -> str:
    start, end = (format_time(at_ns)[:23] for at_ns in (incident.from_ns, incident.to_ns))
    return f"{start} to {end}"


def _described(incident: Incident, held: int) -> Iterator[str]:
    facts = [
        ("incident", incident.id),
        ("state", incident.state + (", confirmed" if incident.confirmed else "")),
        ("window", f"{_range(incident)} (UTC)"),
        ("made", format_time(incident.made_ns)[:19]),
        ("holds", in_bytes(held)),
        *((name, value) for name, value in incident.versions.items() if value),
    ]
    yield from in_columns(facts, "")
    yield "reasons:"
    yield from in_columns(
        (format_time(r.at_ns)[:23], r.who or r.trigger, r.text) for r in incident.reasons
    )


def _files(store: Store, incident: Incident) -> list[tuple[str, int]]:
    paths = sorted(held_files(store, [incident]))
    return [(str(path.relative_to(store.path)), path.stat().st_size) for path in paths]


def _rows(record: Record, incident: Incident) -> dict[str, int]:
    """Count the rows of each item in the window."""
    spans = windows_of(record, incident)
    items = [i for i in record.items() if not i.topic.startswith(PREFIX) and "__" not in i.name]
    counts = {
        item.name: sum(len(record.query(item.name, ["seq"], *span)) for span in spans)
        for item in items
    }
    return {name: count for name, count in counts.items() if count}
