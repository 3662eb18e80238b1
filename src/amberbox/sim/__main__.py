"""Let a simulated robot loose: ``python -m amberbox.sim --zmq tcp://127.0.0.1:5556``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import queue
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.interrupt import called_by_signals
from amberbox.core.timestamps import parse_time
from amberbox.core.units import parse_duration_s
from amberbox.sim.buses import BUSES, BusSetup, RobotBus, open_bus, write_can_definition
from amberbox.sim.command_socket import CommandSocket
from amberbox.sim.disturbances import (
    CONVERSIONS,
    KINDS,
    Disturbance,
    Disturber,
    address_problems,
    kinds_as_rows,
    load_disturbances,
    parse_disturbance,
)
from amberbox.sim.faults import catalogue
from amberbox.sim.live import LiveRun, listen, open_publisher, publish, wait_for_subscriber
from amberbox.sim.missions import SCENARIOS
from amberbox.sim.random_disturbances import draw, simulated_variables
from amberbox.sim.robot import Robot

_SURVEY_S = 30.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        if options.list_faults:
            faults = [dataclasses.asdict(fault) for fault in catalogue().values()]
            print(json.dumps(faults, indent=2) if options.json else _faults_as_table())
            return 0
        if options.list_disturbances:
            print(_disturbances_as_json() if options.json else _disturbances_as_table())
            return 0
        return _run(options)
    except AmberboxError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m amberbox.sim", description=__doc__)
    add = parser.add_argument
    add("--zmq", metavar="ENDPOINT", help="publish [topic, JSON] here, such as tcp://127.0.0.1:*")
    for name, address in BUSES.items():
        add(f"--{name}", metavar=address, help=f"speak {name} there as well")
    add("--dbc", type=Path, metavar="FILE", help="write the DBC file of --can")
    add("--commands", metavar="ENDPOINT", help="take requests here, as tcp://127.0.0.1:5557")
    add("--seed", type=int, default=1, help="same seed, same robot (default 1)")
    add("--robot", default="ropod_001", help="name of the robot")
    add("--scenario", choices=list(SCENARIOS), default="transport")
    add("--speed", default="1", help="times real time, or max (default 1)")
    add("--start", help="virtual start, RFC 3339 (default: now)")
    add("--fault", action="append", default=[], metavar="ID[=MAGNITUDE][@20s]", help="repeatable")
    add(
        "--disturb",
        action="append",
        default=[],
        metavar="KIND:TOPIC[.VARIABLE][=AMOUNT][@20s[..40s]]",
        help="repeatable; random[=NUMBER][@20s[..40s]] draws one",
    )
    add("--disturbances", type=Path, metavar="FILE", help="disturbances of a YAML file")
    add("--for", dest="for_time", metavar="30s", help="end after this much robot time")
    add("--truth", type=Path, metavar="FILE", help="one JSON line per message published")
    add("--wait", action="store_true", help="begin when the first subscriber is there")
    add("--list-faults", action="store_true", help="show the fault catalogue and end")
    add("--list-disturbances", action="store_true", help="show the kinds and end")
    add("--json", action="store_true", help="with a list: as JSON")
    parser.epilog = "While it runs, lines on standard input: fault ID [magnitude], heal ID"
    return parser


def _run(options: argparse.Namespace) -> int:
    if options.dbc:
        write_can_definition(options.dbc)
    chosen = {name: getattr(options, name) for name in BUSES if getattr(options, name)}
    if not options.zmq and not chosen:
        if options.dbc:
            return 0
        raise UsageError("nowhere to publish", "--zmq tcp://127.0.0.1:5556, or --list-faults")
    if options.wait and not options.zmq:
        raise UsageError("--wait waits for a subscriber of --zmq", "add --zmq, or leave it out")
    return _run_robot(options, chosen)


def _run_robot(options: argparse.Namespace, chosen: Mapping[str, str]) -> int:
    for_s = float("inf") if options.for_time is None else parse_duration_s(options.for_time)
    plan = LiveRun(_speed(options.speed), for_s, options.truth)
    faults = [parse_fault(text) for text in options.fault]
    disturbances = _disturbances(options)
    with ExitStack() as stack:
        buses = _open_buses(options, chosen, plan, stack)
        return _publish(options, plan, faults, disturbances, buses)


def _publish(
    options: argparse.Namespace,
    plan: LiveRun,
    faults: Sequence[tuple[str, float, float | None]],
    disturbances: Sequence[Disturbance],
    buses: Sequence[RobotBus],
) -> int:
    publisher = open_publisher(options.zmq) if options.zmq else None
    commands = CommandSocket(options.commands) if options.commands else None
    if commands is not None:
        print(f"commands on {commands.endpoint}", flush=True)
    stop = threading.Event()
    orders: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(sys.stdin, orders), daemon=True).start()
    with called_by_signals(stop.set):
        if options.wait:
            wait_for_subscriber(publisher, stop)
        catalogue()  # before the robot's time begins: at the first order it would stand still
        start_ns = parse_time(options.start or "now", time.time_ns, lambda: None)
        robot = Robot(options.seed, options.robot, options.scenario, start_ns)
        for fault in faults:
            robot.inject(*fault)
        disturber = Disturber(disturbances, start_ns, options.seed) if disturbances else None
        sent = publish(robot, publisher, plan, orders, stop, commands, buses, disturber)
    if commands is not None:
        commands.close("the simulation has ended")
    if publisher is not None:
        publisher.close()
    print(f"published {sent} messages in {robot.now_s:.2f} s of robot time", flush=True)
    return 0


def _open_buses(
    options: argparse.Namespace, chosen: Mapping[str, str], plan: LiveRun, stack: ExitStack
) -> list[RobotBus]:
    """Join the chosen buses; they are left when the stack ends."""
    speed = None if plan.speed == "max" else plan.speed
    setup = BusSetup(options.robot, options.seed, speed)
    buses: list[RobotBus] = []
    for name, address in chosen.items():
        buses.append(open_bus(name, address, setup))
        stack.callback(buses[-1].close)
        print(f"{name} at {address}", flush=True)
    return buses


def parse_fault(text: str) -> tuple[str, float, float | None]:
    """Read ``ID``, ``ID@20s`` or ``ID=0.5@20s``; return id, begin in seconds, magnitude."""
    name, _, when = text.partition("@")
    fault_id, _, magnitude = name.partition("=")
    try:
        at_s = parse_duration_s(when) if when else 0.0
        return fault_id, at_s, float(magnitude) if magnitude else None
    except ValueError as error:
        raise UsageError(f"cannot read --fault {text}", "ID[=MAGNITUDE][@20s]") from error


def _disturbances(options: argparse.Namespace) -> list[Disturbance]:
    """Read the disturbances of file and command line, and draw those that are to be random."""
    found = list(load_disturbances(options.disturbances)) if options.disturbances else []
    for text in options.disturb:
        if text.split("=")[0].split("@")[0] == "random":
            found.append(_drawn(text, options))
            print(f"disturbance {found[-1]}", file=sys.stderr, flush=True)
        else:
            found.append(parse_disturbance(text))
    for each in found:
        for _, what in address_problems(each):
            raise UsageError(
                f"{each}: {what}", "python -m amberbox.sim.tables prints all topics and variables"
            )
    return found


def _drawn(text: str, options: argparse.Namespace) -> Disturbance:
    """Draw a disturbance of what the robot says in its first seconds."""
    name, _, when = text.partition("@")
    number = name.partition("=")[2] or str(options.seed)
    at, _, until = when.partition("..")
    at_s = parse_duration_s(at) if at else 0.0
    until_s = parse_duration_s(until) if until else None
    said = Robot(options.seed, scenario=options.scenario).step_until(_SURVEY_S)
    found = draw(number, simulated_variables(said), at_s, until_s)
    for key, what in found.check():
        raise UsageError(f"{text}: {key} {what}", "random[=NUMBER][@20s[..40s]]")
    return found


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


def _disturbances_as_json() -> str:
    kinds = {name: dataclasses.asdict(facts) for name, facts in KINDS.items()}
    for facts in kinds.values():  # JSON has no infinity
        for end in ("low", "high"):
            facts[end] = facts[end] if math.isfinite(facts[end]) else None
    conversions = {name: dataclasses.asdict(to) for name, to in CONVERSIONS.items()}
    return json.dumps({"kinds": kinds, "conversions": conversions}, indent=2, ensure_ascii=False)


def _disturbances_as_table() -> str:
    rows = [("KIND", "OF", "AMOUNT", "DESCRIPTION"), *kinds_as_rows()]
    return "\n".join([*_aligned(rows), "", f"CONVERSIONS OF unit: {', '.join(CONVERSIONS)}"])


def _faults_as_table() -> str:
    rows = [("ID", "DOMAIN", "MAGNITUDE", "ONSET", "DESCRIPTION")]
    for fault in catalogue().values():
        size = fault.magnitude
        amount = f"{size.default:g} ({size.low:g}..{size.high:g}) {size.unit}"
        rows.append((fault.id, fault.domain, amount, str(fault.onset), fault.description))
    return "\n".join(_aligned(rows))


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=True))
        for row in rows
    ]


if __name__ == "__main__":
    sys.exit(main())
