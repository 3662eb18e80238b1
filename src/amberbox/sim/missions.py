"""Missions: transport tasks as a chain of stages with charging and waiting, and their executor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from amberbox.sim.navigation import Navigation
from amberbox.sim.noise import Noise, Pose2D
from amberbox.sim.software import ERROR, INFO, WARNING, LogLine
from amberbox.sim.world import CART_PLACES, CARTS_AT_START, PLACES, way_from

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
class MissionStage:
    """One step: ``kind`` is drive, dock, undock, ride, charge or wait."""

    kind: str
    name: str
    place: str = ""
    seconds: float = 0.0
    floor: int = 0


@dataclass(slots=True)
class MissionTask:
    """A task with its remaining stages."""

    id: str
    kind: str
    cart: str
    stages: list[MissionStage]
    started_s: float
    stage_started_s: float = 0.0
    limit_s: float = field(default=0.0)
    is_interrupted: bool = False


class Planner:
    """Generates the next task, as a hospital's dispatcher would."""

    def __init__(self, scenario: str, noise: Noise) -> None:
        self._kind = SCENARIOS[scenario]["tasks"]
        self._noise = noise
        self._count = 0

    def next_task(self, now_s: float, battery_percent: float, floor: int) -> MissionTask:
        """Return a new task; the robot recharges when it is low and after every third one."""
        self._count += 1
        number = f"task_{self._count:04d}"
        kind = self._choose(battery_percent)
        stages = {
            "transport": self._transport, "charging": _charge, "standing": _stand, "ready": _ready,
            "delivery": self._deliver,
        }[kind](floor)  # fmt: skip
        cart = f"cart_{self._noise.integer(1, 20):02d}" if kind == "transport" else ""
        return MissionTask(number, f"cart_{kind}" if cart else kind, cart, stages, now_s)

    def _choose(self, battery_percent: float) -> str:
        if self._kind in ("shift", "shuttle") and self._count == 1:
            return "ready"
        if self._kind not in ("transport", "shift", "shuttle"):
            return str(self._kind)
        low = battery_percent < _LOW_BATTERY_PERCENT
        if self._kind == "shuttle":
            return "charging" if low else "delivery"
        return "charging" if low or self._count % 4 == 0 else "transport"

    def _transport(self, floor: int) -> list[MissionStage]:
        pick_up = self._noise.pick(list(CART_PLACES))
        deliver = self._noise.pick([place for place in CART_PLACES if place != pick_up])
        stages = [
            MissionStage("drive", "drive_to_pick_up", pick_up),
            MissionStage("dock", "dock_cart", pick_up, 6.0),
        ]
        if self._noise.uniform() < 0.4:
            other = self._noise.pick([level for level in FLOORS if level != floor])
            stages += _ride(other)
        return [
            *stages,
            MissionStage("drive", "drive_to_delivery", deliver),
            MissionStage("undock", "undock_cart", deliver, 5.0),
            MissionStage("wait", "wait_for_task", deliver, self._noise.uniform(2.0, 8.0)),
        ]

    def _deliver(self, floor: int) -> list[MissionStage]:
        """Return the stages of a delivery between two places near each other."""
        goal = _SHUTTLE[self._count % 2]
        return [
            MissionStage("drive", "drive_to_delivery", goal),
            MissionStage("wait", "hand_over", goal, 2.0, floor),
        ]


def _ride(floor: int) -> list[MissionStage]:
    return [
        MissionStage("drive", "enter_elevator", "elevator"),
        MissionStage("ride", "ride_elevator", "elevator", 16.0, floor),
    ]


def _charge(floor: int) -> list[MissionStage]:
    ground = _ride(0) if floor != 0 else []
    return [
        *ground,
        MissionStage("drive", "drive_to_charger", "charging_station"),
        MissionStage("charge", "charge", "charging_station", 150.0),
    ]


def _stand(floor: int) -> list[MissionStage]:
    return [MissionStage("wait", "stand_by", "ward_a", 60.0, floor)]


def _ready(floor: int) -> list[MissionStage]:
    return [MissionStage("wait", "get_ready", "charging_station", 8.0, floor)]


_DRIVE_LIMIT_S = 45.0
_SLOWEST = 0.25  # m/s that a drive may take on average before it is given up
_HELD_UP_S = 4.0


class Body(Protocol):
    """The actions of the executor on the robot beyond driving."""

    has_cart: bool


class Executor:
    """The task executor: knows the task, its stage and the floor, controls navigation, writes the
    log.
    """

    def __init__(self, planner: Planner, navigation: Navigation, body: Body) -> None:
        self._planner = planner
        self._navigation = navigation
        self._body = body
        self.task: MissionTask | None = None
        self.floor = 0
        self.floor_height = 0.0
        self.is_blocked = False
        self.carts = set(CARTS_AT_START)
        """Places where a cart stands. Tasks of the robot's own find one wherever they look."""
        self.events: list[dict[str, Any]] = []
        self.log: list[LogLine] = []
        self._held_up_s = 0.0
        self._held_up_reported = False

    @property
    def stage(self) -> MissionStage | None:
        """Return the present stage."""
        return self.task.stages[0] if self.task and self.task.stages else None

    @property
    def is_charging_place(self) -> bool:
        """Return whether the robot stands in the charging station to charge."""
        return self.stage is not None and self.stage.kind == "charge"

    @property
    def in_elevator(self) -> bool:
        """Return whether the robot rides in the elevator."""
        return self.stage is not None and self.stage.kind == "ride"

    def step(self, dt: float, now_s: float, pose: Pose2D, battery_percent: float) -> None:
        """Advance by ``dt``."""
        if self.task is None:
            self._begin(self._planner.next_task(now_s, battery_percent, self.floor), now_s, pose)
        self._watch(dt)
        task, stage = self.task, self.stage
        if task is None or stage is None:
            return
        elapsed = now_s - task.stage_started_s
        if stage.kind == "ride":
            share = min(1.0, max(0.0, (elapsed - 4.0) / (stage.seconds - 6.0)))
            self.floor_height = self.floor + (stage.floor - self.floor) * share
            if elapsed >= stage.seconds:
                self.floor, self.floor_height = stage.floor, float(stage.floor)
        if stage.kind == "drive" and elapsed > task.limit_s:
            self.abort(now_s, "not there in time")
        elif self._navigation.is_idle if stage.kind == "drive" else elapsed >= stage.seconds:
            self._finish_stage(stage, now_s, pose)

    def abort(self, now_s: float, why: str) -> None:
        """Abort the task, and log the reason."""
        if self.task is None:
            return
        self._navigation.stop()
        self._event("aborted", now_s)
        self._log(ERROR, f"{self.task.id} given up: {why}")
        self.task = None
        if self._body.has_cart:
            self._body.has_cart = False
            self.carts.add("storage")  # a person brings it there

    def hand_over(self, now_s: float) -> None:
        """Abort the task because the robot is commanded; in the elevator it first rides on."""
        if self.task is None:
            return
        if self.in_elevator:
            self.task.is_interrupted = True
            del self.task.stages[1:]
            return
        self._navigation.stop()
        self._event("aborted", now_s)
        self._log(WARNING, f"{self.task.id} interrupted: the robot is commanded")
        self.task = None

    def fields(self, pose: Pose2D) -> dict[str, Any]:
        """Return the body of a ``state`` message."""
        stage = self.stage
        return {
            "mode": stage.kind if stage else "idle",
            "task_id": self.task.id if self.task else "",
            "stage": stage.name if stage else "",
            "floor": self.floor,
            "cart_attached": self._body.has_cart,
            "goal": stage.place if stage else "",
            "distance_to_goal": round(self._navigation.distance_to_goal(pose), 3),
        }

    def _begin(self, task: MissionTask, now_s: float, pose: Pose2D) -> None:
        self.task = task
        self._event("started", now_s)
        self._log(INFO, f"{task.id} started: {task.kind}")
        self._begin_stage(now_s, pose)

    def _begin_stage(self, now_s: float, pose: Pose2D) -> None:
        task, stage = self.task, self.stage
        if task is None or stage is None:
            return
        task.stage_started_s = now_s
        self._event("stage", now_s)
        self._log(INFO, f"{task.id} stage {stage.name} at {stage.place}")
        if stage.kind == "drive":
            self._navigation.go(pose, way_from((pose.x, pose.y), PLACES[stage.place]))
            task.limit_s = _DRIVE_LIMIT_S + self._navigation.distance_to_goal(pose) / _SLOWEST

    def _finish_stage(self, stage: MissionStage, now_s: float, pose: Pose2D) -> None:
        task = self.task
        if task is None:
            return
        if stage.kind in ("dock", "undock"):
            self._body.has_cart = stage.kind == "dock"
            move_cart = self.carts.discard if stage.kind == "dock" else self.carts.add
            move_cart(stage.place)
        task.stages.pop(0)
        if task.stages:
            self._begin_stage(now_s, pose)
            return
        self._event("aborted" if task.is_interrupted else "finished", now_s)
        self._log(INFO, f"{task.id} finished after {now_s - task.started_s:.0f} s")
        self.task = None

    def _watch(self, dt: float) -> None:
        """Log when the path has been blocked for some time, or when no scan is received."""
        navigation = self._navigation
        held_up = not navigation.is_idle and abs(navigation.command[0]) < 0.02
        held_up = held_up and abs(navigation.command[2]) < 0.05
        self._held_up_s = self._held_up_s + dt if held_up else 0.0
        if not held_up:
            self._held_up_reported = False
        elif self._held_up_s > _HELD_UP_S and not self._held_up_reported:
            self._held_up_reported = True
            why = "way not free" if navigation.has_scan else "waiting for a new scan"
            self.log.append(LogLine(WARNING, "navigation", f"{why}, standing since 4 s"))

    def _log(self, level: int, text: str) -> None:
        self.log.append(LogLine(level, "task_executor", text))

    def _event(self, event: str, now_s: float) -> None:
        task, stage = self.task, self.stage
        if task is None:
            return
        self.events.append(
            {
                "task_id": task.id,
                "kind": task.kind,
                "event": event,
                "stage": stage.name if stage else "",
                "location": stage.place if stage else "",
                "cart": task.cart,
                "elapsed_s": round(now_s - task.started_s, 3),
            }
        )
