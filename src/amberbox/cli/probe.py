"""Look at what only the robot's computer can see, and publish it for a box elsewhere."""

from __future__ import annotations

import argparse
import queue
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli._output import in_columns, print_json, print_lines, print_notes
from amberbox.core.errors import UsageError
from amberbox.core.interrupt import called_by_signals
from amberbox.core.probe import ProbeOrder, sorted_orders
from amberbox.monitoring.probe_runner import (
    HERE,
    ProbePublisher,
    ProbeRunner,
    Put,
    Row,
    encode,
    is_open,
    known_probes,
    load_probe,
)

if TYPE_CHECKING:
    from types import ModuleType

_EXIT = "exit status with --once or --probe: 0 all are ok, 1 something is not, or is unknown"
_POLL_S = 0.2  # how soon a signal is noticed, in seconds

_Found: TypeAlias = "queue.SimpleQueue[tuple[ProbeOrder, Row]]"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "folder", nargs="?", metavar="FOLDER", help="robot folder: the probes its monitors need"
    )
    parser.add_argument(
        "--probe", nargs=2, action="append", default=[], metavar=("KIND", "SUBJECT"),
        help="this probe, such as: --probe path_exists /dev/ttyUSB0; again for more",
    )  # fmt: skip
    parser.add_argument("--once", action="store_true", help="look once and stop")
    parser.add_argument(
        "--publish", nargs="?", const=HERE, metavar="ADDRESS",
        help=f"publish over ZeroMQ, such as tcp://*:5561; without ADDRESS {HERE}",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.add_argument(
        "--list", action="store_true", help="only list the folder's probes; without FOLDER all"
    )
    parser.epilog = _EXIT


def run(args: argparse.Namespace) -> int:
    """Run the probes; print or publish their rows."""
    if args.list and not (args.folder or args.probe):
        _list_kinds(args.json)
        return 0
    orders, extra_dirs = _orders(args)
    if args.list:
        _list_orders(orders, args.json)
        return 0
    if not orders:
        raise UsageError("there is nothing to probe", "name a FOLDER, or --probe KIND SUBJECT")
    if args.publish is None and (args.once or not args.folder):
        found: _Found = queue.SimpleQueue()
        rows: dict[ProbeOrder, Row] = {}
        with _running(orders, lambda order, row: found.put((order, row)), extra_dirs):
            while len(rows) < len(orders):
                order, row = found.get()
                rows.setdefault(order, row)
        ordered = [(order, rows[order]) for order in orders]
        if args.json:
            for order, row in ordered:
                print(_line(order, row))
        else:
            _print_table(
                ("probe", "subject", "ok", "measured"), [_cells(*entry) for entry in ordered]
            )
        return 0 if all(row["ok"] for row in rows.values()) else 1
    if args.once:
        raise UsageError("--once does not go with --publish: nobody would be listening yet")
    stop = threading.Event()
    with called_by_signals(stop.set):
        if args.publish is None:
            _print_on(orders, extra_dirs, args.json, stop)
        else:
            _publish(orders, extra_dirs, args, stop)
    return 0


def _orders(args: argparse.Namespace) -> tuple[Sequence[ProbeOrder], Sequence[Path]]:
    """Return the probes to run, and extra folders with probes."""
    orders: list[ProbeOrder] = []
    extra_dirs: list[Path] = []
    if args.folder:
        from amberbox.monitoring.plan_loader import load_plan

        folder = load_folder(args.folder)
        plan, problems = load_plan(folder)
        count = sum(problem.is_error for problem in problems)
        if count:
            print_notes(
                [f"{count} errors in the monitors; amberbox check {args.folder} shows them"]
            )
        orders, extra_dirs = list(plan.probes()), [folder.path / "probes"]
    for kind, subject in args.probe:
        load_probe(kind, extra_dirs)
        orders.append(ProbeOrder(kind, subject))
    return sorted_orders(orders), extra_dirs


@contextmanager
def _running(
    orders: Sequence[ProbeOrder], put: Put, extra_dirs: Sequence[Path]
) -> Iterator[ProbeRunner]:
    runner = ProbeRunner(orders, put, extra_dirs)
    runner.start()
    try:
        yield runner
    finally:
        runner.close()


def _print_on(
    orders: Sequence[ProbeOrder],
    extra_dirs: Sequence[Path],
    as_json: bool,
    stop: threading.Event,
) -> None:
    """Print rows as they arrive; as text only when ``ok`` or the error changes."""
    found: _Found = queue.SimpleQueue()
    printed: dict[ProbeOrder, tuple[Any, Any]] = {}
    with _running(orders, lambda order, row: found.put((order, row)), extra_dirs):
        while not stop.is_set():
            try:
                order, row = found.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if as_json:
                print(_line(order, row), flush=True)
            elif printed.get(order) != (row["ok"], row["error"]):
                printed[order] = row["ok"], row["error"]
                print("  ".join(_cells(order, row)), flush=True)


def _publish(
    orders: Sequence[ProbeOrder],
    extra_dirs: Sequence[Path],
    args: argparse.Namespace,
    stop: threading.Event,
) -> None:
    with ProbePublisher(args.publish) as publisher:
        who = "whoever reaches this computer" if is_open(args.publish) else "only this computer"
        count = f"{len(orders)} probe{'s' if len(orders) > 1 else ''}"
        text = f"{count}, published at {publisher.endpoint}; {who} can read them"
        print(text, file=sys.stderr, flush=True)

        def put(order: ProbeOrder, row: Row) -> None:
            publisher.put(order, row)
            if args.json:
                print(_line(order, row), flush=True)

        with _running(orders, put, extra_dirs) as runner:
            while runner.failure is None and not stop.is_set():
                stop.wait(_POLL_S)


def _line(order: ProbeOrder, row: Row) -> str:
    return encode({"item": order.item, "kind": order.kind, **row}).decode()


def _cells(order: ProbeOrder, row: Row) -> tuple[str, str, str, str]:
    return order.kind, order.subject, _word(row["ok"]), _measured(row)


def _print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table without shortened cells."""
    print_lines(in_columns([header, *rows], indent=""))


def _word(ok: bool | None) -> str:
    return "unknown" if ok is None else "ok" if ok else "not ok"


def _measured(row: Row) -> str:
    left_out = ("subject", "ok", "error")
    values = [f"{k}={_short(v)}" for k, v in row.items() if k not in left_out and v is not None]
    return " ".join([*values, f"({row['error']})"] if row["error"] else values)


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _list_orders(orders: Sequence[ProbeOrder], as_json: bool) -> None:
    rows = [(order.kind, order.subject, order.item) for order in orders]
    if as_json:
        print_json([dict(zip(("kind", "subject", "item"), row, strict=True)) for row in rows])
    elif rows:
        _print_table(("probe", "subject", "item"), rows)
    else:
        print("no monitor of this folder needs a probe")


def _list_kinds(as_json: bool) -> None:
    """List all probes: purpose, subject, and measured values."""
    modules = {name: plugin.load() for name, plugin in known_probes().items()}
    if as_json:
        print_json([_described(name, module) for name, module in modules.items()])
        return
    for name, module in modules.items():
        print_lines([f"{name}: {(module.__doc__ or '').partition(chr(10))[0]}"])
        print_lines(in_columns(_explained(module)))


def _described(name: str, module: ModuleType) -> Mapping[str, Any]:
    measures = [
        {"name": column, "type": kind, "unit": unit, "doc": doc}
        for column, (kind, unit, doc) in module.MEASURES.items()
    ]
    return {"name": name, "subject": module.SUBJECT, "measures": measures}


def _explained(module: ModuleType) -> Iterator[tuple[str, str]]:
    yield "subject", module.SUBJECT
    for name, (_, unit, doc) in module.MEASURES.items():
        yield name, f"{doc} [{unit}]" if unit else doc
