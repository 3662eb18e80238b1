"""Incidents, on a robot or a server: windows of the record that are kept; mark, list, release."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.blackbox.journal.channels import PREFIX
from amberbox.blackbox.query.record import LocalRecord, Record, windows_of
from amberbox.blackbox.retention.pins import held_bytes, held_files, mark, release_incident
from amberbox.blackbox.store.incident import StoredIncident, damaged_files, incident_named, load_all
from amberbox.blackbox.store.store import open_store, store_path
from amberbox.cli._arguments import PAGE, Window, add_actions, add_robot, remote_record
from amberbox.cli._output import (
    in_columns,
    print_json,
    print_lines,
    print_listing,
    print_notes,
)
from amberbox.client.address import is_url
from amberbox.client.models import time_ns
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.timestamps import format_time
from amberbox.core.units import bytes_text, parse_duration_s

if TYPE_CHECKING:
    from amberbox.client.models import Incident
    from amberbox.client.remote import RemoteRecord

_USAGE = "amberbox incident [mark] WHERE, list WHERE, show WHERE ID, release WHERE ID"
_HEADER = ("id", "state", "from (UTC)", "seconds", "who", "reason")
_NONE = "there are no incidents"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE + " [options]"
    words = {"mark": (), **{name: ("ID",)[:count] for name, (_, _, count) in _ACTIONS.items()}}
    add_actions(parser, words, "mark", f"robot folder or store, or {PAGE}")
    add_robot(parser)
    parser.add_argument("--before", default="60s", metavar="TIME", help="kept from before: 60s")
    parser.add_argument("--after", default="20s", metavar="TIME", help="kept from now on: 20s")
    parser.add_argument("--reason", default="", metavar="TEXT", help="why it is kept")
    parser.add_argument("--who", default="", metavar="NAME", help="who wants it; else the user")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the action; without one, mark an incident."""
    first, rest = args.action, args.rest
    if first == "mark":
        if rest:
            raise UsageError(f"what is '{rest[0]}'?", _USAGE)
        before_s, after_s = parse_duration_s(args.before), parse_duration_s(args.after)
        if is_url(args.where):
            _mark_on_server(args, before_s, after_s)
            return 0
        made = mark(
            args.where, before_s=before_s, after_s=after_s, reason=args.reason, who=args.who
        )
        if args.json:
            print_json(made.to_json())
        else:
            print(f"{made.id}: {_range(made)} is kept")
        return 0
    local, on_server, count = _ACTIONS[first]
    if len(rest) != count:
        needed = " ".join(("WHERE", "ID")[: count + 1])
        raise UsageError(
            f"incident {first} needs {needed}", f"{_USAGE}; a folder called {first}: ./{first}"
        )
    if is_url(args.where):
        with remote_record(args.where) as record:
            on_server(record, *rest, as_json=args.json)
    else:
        local(args.where, *rest, as_json=args.json)
    return 0


def _list(where: str, *, as_json: bool) -> None:
    store = open_store(store_path(where))
    incidents = load_all(store)
    print_notes(f"{path} cannot be read" for path in damaged_files(store))
    print_listing(incidents, StoredIncident.to_json, _HEADER, _row, _NONE, as_json=as_json)
    if incidents and not as_json:
        print(f"they hold {bytes_text(held_bytes(store, incidents))}")


def _list_on_server(record: RemoteRecord, *, as_json: bool) -> None:
    found = record.fleet.incidents(record.robot)[::-1]
    print_listing(found, msgspec.to_builtins, _HEADER, _server_row, _NONE, as_json=as_json)


def _show(where: str, name: str, *, as_json: bool) -> None:
    store = open_store(store_path(where))
    incident = incident_named(store, name)
    paths = sorted(held_files(store, [incident]))
    files = [(str(path.relative_to(store.path)), path.stat().st_size) for path in paths]
    record = LocalRecord(store.path)
    rows = _row_counts(record, windows_of(store.path, incident), "seq")
    if as_json:
        found = [{"file": name, "bytes": count} for name, count in files]
        print_json({**incident.to_json(), "bytes": held_bytes(store, [incident]),
                    "files": found, "items": rows})  # fmt: skip
        return
    print_lines(_described(incident, held_bytes(store, [incident])))
    print_lines(["files:", *in_columns([(name, bytes_text(count)) for name, count in files])])
    _print_items(rows)


def _show_on_server(record: RemoteRecord, name: str, *, as_json: bool) -> None:
    incident = _server_incident(record, name)
    rows = _row_counts(record, [(time_ns(incident.from_), time_ns(incident.to))], "timestamp")
    if as_json:
        print_json({**msgspec.to_builtins(incident), "items": rows})
        return
    facts = [
        ("incident", incident.id), ("state", incident.state), ("origin", incident.origin),
        ("window", f"{_server_range(incident)} (UTC)"),
        ("who", incident.who or incident.trigger), ("reason", incident.reason),
    ]  # fmt: skip
    print_lines(in_columns(facts, ""))
    _print_items(rows)


def _row_counts(record: Record, spans: Sequence[Window], column: str) -> dict[str, int]:
    """Return the number of rows of each recorded item in some windows; zeros are left out."""
    items = [i for i in record.items() if not i.topic.startswith(PREFIX) and "__" not in i.name]
    counts = {
        item.name: sum(len(record.query(item.name, [column], *span)) for span in spans)
        for item in items
    }
    return {name: count for name, count in counts.items() if count}


def _print_items(rows: Mapping[str, int]) -> None:
    print_lines(["items:", *in_columns([(name, f"{n} rows") for name, n in rows.items()])])


def _release(where: str, name: str, *, as_json: bool) -> None:
    released = release_incident(where, name)
    _print_released(released.id, released.to_json(), as_json=as_json)


def _release_on_server(record: RemoteRecord, name: str, *, as_json: bool) -> None:
    incident = _server_incident(record, name)
    if incident.origin == "robot":
        raise UsageError(f"{incident.id} was marked on the robot", "it is released there")
    released = record.fleet.release_incident(record.robot, incident.id)
    _print_released(released.id, msgspec.to_builtins(released), as_json=as_json)


def _print_released(name: str, document: Any, *, as_json: bool) -> None:
    if as_json:
        print_json(document)
    else:
        print(f"{name} is released: its window is kept no longer than the rest")


# per action: on a robot's store, on a server, number of words after WHERE
_ACTIONS: dict[str, tuple[Callable[..., None], Callable[..., None], int]] = {
    "list": (_list, _list_on_server, 0),
    "show": (_show, _show_on_server, 1),
    "release": (_release, _release_on_server, 1),
}


def _row(incident: StoredIncident) -> tuple[Any, ...]:
    state = "confirmed" if incident.confirmed and incident.is_pinned else incident.state
    seconds = f"{(incident.to_ns - incident.from_ns) / NS:.1f}"
    start = format_time(incident.from_ns)[:19]
    return incident.id, state, start, seconds, incident.who, incident.text


def _range(incident: StoredIncident) -> str:
    start, end = (format_time(at_ns)[:23] for at_ns in (incident.from_ns, incident.to_ns))
    return f"{start} to {end}"


def _described(incident: StoredIncident, held: int) -> Iterator[str]:
    facts = [
        ("incident", incident.id),
        ("state", incident.state + (", confirmed" if incident.confirmed else "")),
        ("window", f"{_range(incident)} (UTC)"),
        ("made", format_time(incident.made_ns)[:19]),
        ("holds", bytes_text(held)),
        *((name, value) for name, value in incident.versions.items() if value),
    ]
    yield from in_columns(facts, "")
    yield "reasons:"
    yield from in_columns(
        (format_time(r.at_ns)[:23], r.who or r.trigger, r.text) for r in incident.reasons
    )


def _mark_on_server(args: argparse.Namespace, before_s: float, after_s: float) -> None:
    """Mark a window around now as an incident on the server."""
    if not args.reason:
        raise UsageError("on a server others read why it is kept", "--reason TEXT")
    if args.who:
        raise UsageError("on a server it is who the token belongs to", "leave out --who")
    now_ns = time.time_ns()
    span = now_ns - round(before_s * NS), now_ns + round(after_s * NS)
    with remote_record(args.where) as record:
        made = record.fleet.mark_incident(record.robot, *span, args.reason)
    if args.json:
        print_json(msgspec.to_builtins(made))
    else:
        print(f"{made.id}: {_server_range(made)} is kept; what is still on the robot: "
              f"amberbox fetch {args.where} all {made.from_[:19]} {made.to[:19]}")  # fmt: skip


def _server_incident(record: RemoteRecord, name: str) -> Incident:
    known = {one.id: one for one in record.fleet.incidents(record.robot)}
    found = next(iter(known.values()), None) if name == "last" else known.get(name)
    if found is None:
        near = did_you_mean(name, known)
        raise UsageError(f"there is no incident '{name}'{near}", "amberbox incident list URL")
    return found


def _server_row(incident: Incident) -> tuple[str, ...]:
    seconds = f"{(time_ns(incident.to) - time_ns(incident.from_)) / NS:.1f}"
    who = incident.who or incident.trigger
    return incident.id, incident.state, incident.from_[:19], seconds, who, incident.reason


def _server_range(incident: Incident) -> str:
    return f"{incident.from_[:23]} to {incident.to[:23]}"
