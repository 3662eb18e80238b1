"""The missions: transport tasks as a chain of stages, with charging and waiting in between."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from amberbox.sim.noise import Noise
from amberbox.sim.world import CART_PLACES

FLOORS = (0, 1, 2)
SCENARIOS: dict[str, dict[str, Any]] = {
    "transport": {"place": "charging_station", "charge": (0.7, 0.95), "tasks": "transport"},
    "charging": {"place": "charging_station", "charge": (0.3, 0.4), "tasks": "charging"},
    "shift": {"place": "charging_station", "charge": (0.7, 0.95), "tasks": "shift"},
    "shuttle": {"place": "charging_station", "charge": (0.7, 0.95), "tasks": "shuttle"},
    "standing": {"place": "ward_a", "charge": (0.7, 0.95), "tasks": "standing"},
}
_LOW_BATTERY_PERCENT = 30.0
_SHUTTLE = ("ward_a", "charging_station")


@dataclass(frozen=True, slots=True)
class Stage:
    """One step: ``kind`` is drive, dock, undock, ride, charge or wait."""

    kind: str
    name: str
    place: str = ""
    seconds: float = 0.0
    floor: int = 0


@dataclass(slots=True)
class Task:
    """A task with what is left of it."""

    id: str
    kind: str
    cart: str
    stages: list[Stage]
    started_s: float
    stage_started_s: float = 0.0
    limit_s: float = field(default=0.0)


class Planner:
    """Makes up the next task, as a hospital's dispatcher would."""

    def __init__(self, scenario: str, noise: Noise) -> None:
        self._kind = SCENARIOS[scenario]["tasks"]
        self._noise = noise
        self._count = 0

    def next_task(self, now_s: float, battery_percent: float, floor: int) -> Task:
        """Return a new task; the robot recharges when it is low and after every third one."""
        self._count += 1
        number = f"task_{self._count:04d}"
        kind = self._choose(battery_percent)
        stages = {
            "transport": self._transport, "charging": _charge, "standing": _stand, "ready": _ready,
            "delivery": self._deliver,
        }[kind](floor)  # fmt: skip
        cart = f"cart_{self._noise.integer(1, 20):02d}" if kind == "transport" else ""
        return Task(number, f"cart_{kind}" if cart else kind, cart, stages, now_s)

    def _choose(self, battery_percent: float) -> str:
        if self._kind in ("shift", "shuttle") and self._count == 1:
            return "ready"
        if self._kind not in ("transport", "shift", "shuttle"):
            return str(self._kind)
        low = battery_percent < _LOW_BATTERY_PERCENT
        if self._kind == "shuttle":
            return "charging" if low else "delivery"
        return "charging" if low or self._count % 4 == 0 else "transport"

    def _transport(self, floor: int) -> list[Stage]:
        pick_up = self._noise.pick(list(CART_PLACES))
        deliver = self._noise.pick([place for place in CART_PLACES if place != pick_up])
        stages = [
            Stage("drive", "drive_to_pick_up", pick_up),
            Stage("dock", "dock_cart", pick_up, 6.0),
        ]
        if self._noise.uniform() < 0.4:
            other = self._noise.pick([level for level in FLOORS if level != floor])
            stages += _ride(other)
        return [
            *stages,
            Stage("drive", "drive_to_delivery", deliver),
            Stage("undock", "undock_cart", deliver, 5.0),
            Stage("wait", "wait_for_task", deliver, self._noise.uniform(2.0, 8.0)),
        ]

    def _deliver(self, floor: int) -> list[Stage]:
        """Take something to the other of two places that are near each other."""
        goal = _SHUTTLE[self._count % 2]
        return [
            Stage("drive", "drive_to_delivery", goal),
            Stage("wait", "hand_over", goal, 2.0, floor),
        ]


def _ride(floor: int) -> list[Stage]:
    return [
        Stage("drive", "enter_elevator", "elevator"),
        Stage("ride", "ride_elevator", "elevator", 16.0, floor),
    ]


def _charge(floor: int) -> list[Stage]:
    ground = _ride(0) if floor != 0 else []
    return [
        *ground,
        Stage("drive", "drive_to_charger", "charging_station"),
        Stage("charge", "charge", "charging_station", 150.0),
    ]


def _stand(floor: int) -> list[Stage]:
    return [Stage("wait", "stand_by", "ward_a", 60.0, floor)]


def _ready(floor: int) -> list[Stage]:
    return [Stage("wait", "get_ready", "charging_station", 8.0, floor)]
