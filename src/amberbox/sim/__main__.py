"""Let a simulated robot loose: ``python -m amberbox.sim --zmq tcp://127.0.0.1:5556``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import queue
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timestamps import parse_time
from amberbox.core.units import parse_duration_s
from amberbox.sim.command_socket import CommandSocket
from amberbox.sim.faults import catalogue
from amberbox.sim.live import LiveRun, listen, open_publisher, publish, wait_for_subscriber
from amberbox.sim.missions import SCENARIOS
from amberbox.sim.robot import Robot


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        if options.list_faults:
            faults = [dataclasses.asdict(fault) for fault in catalogue().values()]
            print(json.dumps(faults, indent=2) if options.json else _faults_as_table())
            return 0
        return _run(options)
    except AmberboxError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m amberbox.sim", description=__doc__)
    add = parser.add_argument
    add("--zmq", metavar="ENDPOINT", help="publish [topic, JSON] here, such as tcp://127.0.0.1:*")
    add("--commands", metavar="ENDPOINT", help="take requests here, as tcp://127.0.0.1:5557")
    add("--seed", type=int, default=1, help="same seed, same robot (default 1)")
    add("--robot", default="ropod_001", help="name of the robot")
    add("--scenario", choices=list(SCENARIOS), default="transport")
    add("--speed", default="1", help="times real time, or max (default 1)")
    add("--start", help="virtual start, RFC 3339 (default: now)")
    add("--fault", action="append", default=[], metavar="ID[=MAGNITUDE][@20s]", help="repeatable")
    add("--for", dest="for_time", metavar="30s", help="end after this much robot time")
    add("--truth", type=Path, metavar="FILE", help="one JSON line per message published")
    add("--wait", action="store_true", help="begin when the first subscriber is there")
    add("--list-faults", action="store_true", help="show the fault catalogue and end")
    add("--json", action="store_true", help="with --list-faults: as JSON")
    parser.epilog = "While it runs, lines on standard input: fault ID [magnitude], heal ID"
    return parser


def _run(options: argparse.Namespace) -> int:
    if not options.zmq:
        raise UsageError("nowhere to publish", "--zmq tcp://127.0.0.1:5556, or --list-faults")
    for_s = float("inf") if options.for_time is None else parse_duration_s(options.for_time)
    plan = LiveRun(_speed(options.speed), for_s, options.truth)
    faults = [parse_fault(text) for text in options.fault]
    publisher = open_publisher(options.zmq)
    commands = CommandSocket(options.commands) if options.commands else None
    if commands is not None:
        print(f"commands on {commands.endpoint}", flush=True)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    orders: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(sys.stdin, orders), daemon=True).start()
    if options.wait:
        wait_for_subscriber(publisher, stop)
    catalogue()  # before the robot's time begins: at the first order it would stand still for it
    start_ns = parse_time(options.start or "now", time.time_ns, lambda: None)
    robot = Robot(options.seed, options.robot, options.scenario, start_ns)
    for fault in faults:
        robot.inject(*fault)
    sent = publish(robot, publisher, plan, orders, stop, commands)
    if commands is not None:
        commands.close("the simulation has ended")
    publisher.close()
    print(f"published {sent} messages in {robot.now_s:.2f} s of robot time", flush=True)
    return 0


def parse_fault(text: str) -> tuple[str, float, float | None]:
    """Read ``ID``, ``ID@20s`` or ``ID=0.5@20s``; return id, begin in seconds, magnitude."""
    name, _, when = text.partition("@")
    fault_id, _, magnitude = name.partition("=")
    try:
        at_s = parse_duration_s(when) if when else 0.0
        return fault_id, at_s, float(magnitude) if magnitude else None
    except ValueError as error:
        raise UsageError(f"cannot read --fault {text}", "ID[=MAGNITUDE][@20s]") from error


def _speed(text: str) -> float | Literal["max"]:
    if text == "max":
        return "max"
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0 < speed < float("inf"):
        raise UsageError(f"--speed {text} is no speed", "a number above 0, or max")
    return speed


def _faults_as_table() -> str:
    rows = [("ID", "DOMAIN", "MAGNITUDE", "ONSET", "DESCRIPTION")]
    for fault in catalogue().values():
        size = fault.magnitude
        amount = f"{size.default:g} ({size.low:g}..{size.high:g}) {size.unit}"
        rows.append((fault.id, fault.domain, amount, str(fault.onset), fault.description))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=True))
        for row in rows
    )


if __name__ == "__main__":
    sys.exit(main())
