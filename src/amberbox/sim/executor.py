"""The task executor: carries out one stage after the other and reports events."""

from __future__ import annotations

from typing import Any, Protocol

from amberbox.sim.geometry import Pose2D
from amberbox.sim.mission import Planner, Stage, Task
from amberbox.sim.navigation import Navigation
from amberbox.sim.software import ERROR, INFO, WARNING, LogLine
from amberbox.sim.world import PLACES, way_from

_DRIVE_LIMIT_S = 45.0
_SLOWEST = 0.25  # m/s that a drive may take on average before it is given up
_HELD_UP_S = 4.0


class Body(Protocol):
    """What the executor can do to the robot beyond driving."""

    has_cart: bool


class Executor:
    """Knows the task, its stage and the floor; drives navigation; collects events and log."""

    def __init__(self, planner: Planner, navigation: Navigation, body: Body) -> None:
        self._planner = planner
        self._navigation = navigation
        self._body = body
        self.task: Task | None = None
        self.floor = 0
        self.floor_height = 0.0
        self.is_blocked = False
        self.events: list[dict[str, Any]] = []
        self.log: list[LogLine] = []
        self._held_up_s = 0.0
        self._held_up_reported = False

    @property
    def stage(self) -> Stage | None:
        """The stage that is going on."""
        return self.task.stages[0] if self.task and self.task.stages else None

    @property
    def is_charging_place(self) -> bool:
        """Whether the robot stands in the charging station to charge."""
        return self.stage is not None and self.stage.kind == "charge"

    @property
    def in_elevator(self) -> bool:
        """Whether the robot rides."""
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
            self._rise(stage, elapsed)
        if stage.kind == "drive" and elapsed > task.limit_s:
            self.abort(now_s, "not there in time")
        elif self._navigation.is_idle if stage.kind == "drive" else elapsed >= stage.seconds:
            self._finish_stage(stage, now_s, pose)

    def abort(self, now_s: float, why: str) -> None:
        """Give the task up."""
        if self.task is None:
            return
        self._navigation.stop()
        self._event("aborted", now_s)
        self._say(ERROR, f"{self.task.id} given up: {why}")
        self.task = None
        self._body.has_cart = False

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

    def _begin(self, task: Task, now_s: float, pose: Pose2D) -> None:
        self.task = task
        self._event("started", now_s)
        self._say(INFO, f"{task.id} started: {task.kind}")
        self._begin_stage(now_s, pose)

    def _begin_stage(self, now_s: float, pose: Pose2D) -> None:
        task, stage = self.task, self.stage
        if task is None or stage is None:
            return
        task.stage_started_s = now_s
        self._event("stage", now_s)
        self._say(INFO, f"{task.id} stage {stage.name} at {stage.place}")
        if stage.kind == "drive":
            self._navigation.go(pose, way_from((pose.x, pose.y), PLACES[stage.place]))
            task.limit_s = _DRIVE_LIMIT_S + self._navigation.distance_to_goal(pose) / _SLOWEST

    def _finish_stage(self, stage: Stage, now_s: float, pose: Pose2D) -> None:
        task = self.task
        if task is None:
            return
        if stage.kind in ("dock", "undock"):
            self._body.has_cart = stage.kind == "dock"
        task.stages.pop(0)
        if task.stages:
            self._begin_stage(now_s, pose)
            return
        self._event("finished", now_s)
        self._say(INFO, f"{task.id} finished after {now_s - task.started_s:.0f} s")
        self.task = None

    def _rise(self, stage: Stage, elapsed: float) -> None:
        share = min(1.0, max(0.0, (elapsed - 4.0) / (stage.seconds - 6.0)))
        self.floor_height = self.floor + (stage.floor - self.floor) * share
        if elapsed >= stage.seconds:
            self.floor, self.floor_height = stage.floor, float(stage.floor)

    def _watch(self, dt: float) -> None:
        """Say when the way is not free for some time, or when no scan comes."""
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

    def _say(self, level: int, text: str) -> None:
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
