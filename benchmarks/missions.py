"""Missions of the simulated robot with random faults, as a reader of the record would see them."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import getitem
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.types import Batch, Column, ItemSchema, Ragged
from amberbox.sim.disturbances import Disturbance, Disturber
from amberbox.sim.faults import SimulatedFault, catalogue
from amberbox.sim.random_disturbances import Variable
from amberbox.sim.random_disturbances import draw as draw_disturbance
from amberbox.sim.robot import START_NS, Message, Robot

ONSET_S = (25.0, 60.0)
"""When the first fault begins; before, the robot drives and the windows of monitors fill."""
LATER_S = (0.0, 40.0)
"""How much later the second fault begins."""
AFTER_S = 90.0
"""How long a mission goes on after its last fault has begun."""
CHUNK_S = 30.0
NOMINAL = ("transport", "shift", "shuttle", "transport", "charging", "standing", "transport")
"""The drives of nominal hours, in turns."""
NAMES = {
    "load_loose": "base#load_loose",
    "e_stop_line_loose": "safety#e_stop_line_loose",
    "bumper_switch_closed": "safety#bumper_switch_closed",
}
"""Failure modes whose ids do not follow from the fault's; others are ``component_mode``."""


@dataclass(frozen=True, slots=True)
class Planted:
    """A fault that is to begin ``at_s``, and how strong; at ``until_s`` it is repaired."""

    fault: SimulatedFault
    magnitude: float
    at_s: float
    until_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Mission:
    """What happens on a mission: it follows from the seed alone.

    ``seed`` makes the route and the noise, ``cart`` is whether the robot starts with a cart.
    """

    seed: int
    scenario: str
    cart: bool
    faults: tuple[Planted, ...]
    seconds: float
    disturbances: tuple[Disturbance, ...] = ()

    @property
    def onset_s(self) -> float:
        """When the first fault or disturbance begins."""
        return min(self._onsets_s(), default=math.inf)

    @property
    def last_onset_s(self) -> float:
        """When the last fault or disturbance begins."""
        return max(self._onsets_s(), default=math.inf)

    def _onsets_s(self) -> Iterator[float]:
        yield from (planted.at_s for planted in self.faults)
        yield from (disturbance.at_s for disturbance in self.disturbances)


def draw(seed: int, count: int) -> Mission:
    """Draw a mission with so many faults of the catalogue."""
    chance = random.Random(f"mission {seed} {count}")
    faults = [chance.choice(list(catalogue().values()))]
    while len(faults) < count:
        other = chance.choice(list(catalogue().values()))
        if other not in faults:
            faults.append(other)
    return with_faults(seed, faults, chance)


def with_faults(seed: int, faults: Sequence[SimulatedFault], chance: random.Random) -> Mission:
    """Draw magnitudes, times and load for a mission with given faults."""
    at_s = chance.uniform(*ONSET_S)
    planted = []
    for fault in faults:
        planted.append(Planted(fault, magnitude(fault, chance), at_s))
        at_s += chance.uniform(*LATER_S)
    scenario = next((f.scenario for f in faults if f.scenario != "transport"), "transport")
    cart = scenario == "transport" and chance.random() < 0.5
    return Mission(seed, scenario, cart, tuple(planted), planted[-1].at_s + AFTER_S)


def disturbed(seed: int, variables: Sequence[Variable]) -> Mission:
    """Draw a mission in which no part is faulty, but one disturbance of some variable begins."""
    chance = random.Random(f"disturbed {seed}")
    at_s = chance.uniform(*ONSET_S)
    drawn = draw_disturbance(f"mission {seed}", variables, at_s)
    return Mission(seed, "transport", chance.random() < 0.5, (), at_s + AFTER_S, (drawn,))


def nominal(seed: int, seconds: float) -> Mission:
    """Draw a mission without any fault, in all scenarios one after the other: most transport."""
    scenario = NOMINAL[seed % len(NOMINAL)]
    return Mission(seed, scenario, scenario == "transport" and seed % 2 == 0, (), seconds)


def magnitude(fault: SimulatedFault, chance: random.Random) -> float:
    """Draw how strong a fault is: evenly on a scale of factors, over all of its range."""
    low, high = fault.magnitude.low, fault.magnitude.high
    if low == high:
        return low
    if low > 0:
        return min(high, max(low, low * math.pow(high / low, chance.random())))
    size = math.pow(high, chance.random())
    return size if chance.random() < 0.5 else -size


def mode_of(fault: SimulatedFault, modes: Collection[str]) -> str:
    """Return the failure mode that a fault of the catalogue means, empty if there is none."""
    if fault.id in NAMES:
        return NAMES[fault.id]
    return next((mode for mode in modes if mode.replace("#", "_") == fault.id), "")


def live(mission: Mission) -> Iterator[tuple[float, list[Message]]]:
    """Yield what the robot says in pieces: (until so many seconds, messages)."""
    robot = Robot(mission.seed, scenario=mission.scenario)
    for planted in mission.faults:
        robot.inject(planted.fault, planted.at_s, planted.magnitude, planted.until_s)
    disturber = Disturber(mission.disturbances, robot.start_ns, mission.seed)
    until_s = 0.0
    while until_s < mission.seconds:
        first = until_s == 0.0
        until_s = min(until_s + CHUNK_S, mission.seconds)
        messages = list(robot.step_until(1.0)) if first else []
        if first:
            robot.base.has_cart = mission.cart
        messages += robot.step_until(until_s)
        yield until_s, list(disturber.feed(messages, robot.now_ns))


class Batches:
    """Makes batches of messages, with no more of them than somebody reads.

    ``wanted`` are the columns of each item, without their elements.
    """

    def __init__(self, wanted: Mapping[str, Collection[str]]) -> None:
        self._wanted = wanted
        self._getters: dict[str, list[tuple[str, Callable[[Any], Any]]]] = {}

    def of(self, messages: Sequence[Message]) -> Iterator[Batch]:
        """Make one batch for each item."""
        by_topic: dict[str, list[tuple[int, dict[str, Any]]]] = {}
        for topic, sent_ns, message in messages:
            if f"sim_{topic}" in self._wanted:
                by_topic.setdefault(topic, []).append((sent_ns, message))
        for topic, rows in by_topic.items():
            yield self._batch(topic, rows)

    def _batch(self, topic: str, rows: Sequence[tuple[int, dict[str, Any]]]) -> Batch:
        if topic not in self._getters:
            self._getters[topic] = list(_getters(rows[0][1], self._wanted[f"sim_{topic}"]))
        columns, data = [], {}
        for name, get in self._getters[topic]:
            kind, data[name] = _column([get(message) for _, message in rows])
            columns.append(Column(name, name, kind))
        log_ns = np.array([sent_ns for sent_ns, _ in rows], np.int64)
        stamps = (message["header"]["stamp"] for _, message in rows)
        stamp_ns = np.array([stamp["sec"] * NS + stamp["nanosec"] for stamp in stamps], np.int64)
        schema = ItemSchema("sim", tuple(columns), stamp="header/stamp")
        places = np.arange(len(rows))
        return Batch(f"sim_{topic}", schema, "main", 1, places, log_ns, log_ns, stamp_ns, data)


def seconds_of(time_ns: int) -> float:
    """Return seconds since the robot was switched on."""
    return (time_ns - START_NS) / NS


def _getters(
    message: Mapping[str, Any], wanted: Collection[str]
) -> Iterator[tuple[str, Callable[[Any], Any]]]:
    for path in _leaves((), message):
        name = "_".join(path)
        if name in wanted:
            yield name, partial(_at, path)


def _at(path: tuple[str, ...], message: Mapping[str, Any]) -> Any:
    return reduce(getitem, path, message)


def _leaves(path: tuple[str, ...], message: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for key, value in message.items():
        if isinstance(value, dict):
            yield from _leaves((*path, key), value)
        else:
            yield (*path, key)


def _column(values: list[Any]) -> tuple[str, Any]:
    if isinstance(values[0], str):
        return "string", np.array(values, object)
    if isinstance(values[0], list):
        rows = np.array(values, np.float64)
        return "list<float64>", Ragged(np.arange(0, rows.size + 1, rows.shape[1]), rows.ravel())
    column = np.array(values)
    return {"b": "bool", "i": "int64", "f": "float64"}[column.dtype.kind], column
