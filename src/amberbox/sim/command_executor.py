"""Commands that the simulated robot carries out: one at a time, by its own navigation and wheels.

Until the first command the robot follows its own tasks; from then on it only does what it is
commanded, until it is told to resume its tasks. A command ends done, failed or aborted, and says
why. All decisions use what the robot measures, never the true state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any

from amberbox.sim.base import BatteryPack, MovingBase, Odometry, SafetyLine
from amberbox.sim.maneuvers import (
    STATION,
    UNDOCKING_M,
    DockingMarker,
    Straight,
    Turn,
    Wish,
    approach_point,
    final_approach,
    way_to,
)
from amberbox.sim.missions import Executor
from amberbox.sim.navigation import CYCLE_S, OLD_SCAN_NS, Localisation, Navigation, free_ahead
from amberbox.sim.noise import wrap
from amberbox.sim.requests import RobotRequest
from amberbox.sim.sensors import Laser
from amberbox.sim.software import INFO, WARNING, HostComputer, LogLine
from amberbox.sim.world import CART_PLACES, PLACES, HospitalWorld, Point

KEPT_COMMANDS = 100
"""How many ended commands can be asked for by their id."""

_NEEDED = ("base_controller", "navigation", "task_executor")
_BY_THE_MAP = ("go_to", "dock", "load", "unload")
_MODES = {
    "rotate": "rotate",
    "dock": "dock",
    "undock": "undock",
    "load": "dock",
    "unload": "undock",
}
_BLOCKED_S = 10.0
_HELD_UP_S = 4.0
_UNPOWERED_S = 0.3
_LOW_AT_START, _LOW_ON_THE_WAY = 15.0, 10.0  # percent
_NEAR_M = 0.6
_STANDS_M_S, _STANDS_RAD_S = 0.01, 0.02
_SETTLE_S = 3.0
_CURRENT_FLOWS_A, _CURRENT_FOR_S, _CURRENT_WITHIN_S = 0.2, 3.0, 6.0
_FULL = 0.98
_LASER_M = 0.35
_BESIDE_M = 0.3

Course = Generator[None, None, dict[str, Any]]


class CommandFailedError(Exception):
    """A command cannot be carried out; the text says why."""


@dataclass(slots=True)
class RobotCommand:
    """A command and what became of it."""

    id: str
    request: RobotRequest
    started_s: float
    state: str = "running"
    reason: str = ""
    result: dict[str, Any] = field(default_factory=dict)
    phase: str = ""
    seconds: float = 0.0

    def fields(self) -> dict[str, Any]:
        """Return it as an answer."""
        answer = {
            "ok": self.state in ("running", "done"),
            "do": self.request.do,
            "id": self.id,
            "state": self.state,
            "reason": self.reason,
            "seconds": round(self.seconds, 2),
        }
        return answer | ({"result": self.result} if self.result else {})


@dataclass(frozen=True, slots=True)
class CommandedParts:
    """The parts of the robot that commands act on or are decided by."""

    tasks: Executor
    navigation: Navigation
    localisation: Localisation
    odometry: Odometry
    base: MovingBase
    battery: BatteryPack
    safety: SafetyLine
    host: HostComputer
    laser_rear: Laser
    world: HospitalWorld
    marker: DockingMarker
    restart: Callable[[str], None]


class CommandExecutor:
    """Takes requests and steers the robot, in cycles of 0.1 s.

    ``wish`` is what the present maneuver wants; None while navigation follows a path or nothing
    moves. ``is_braking`` is set from a stop or a failure until the next motion.
    """

    def __init__(self, parts: CommandedParts) -> None:
        self._parts = parts
        self.has_control = False
        self.is_braking = False
        self.wish: Wish | None = None
        self._running: RobotCommand | None = None
        self._course: Course | None = None
        self._straight: Straight | None = None
        self._ended: dict[str, RobotCommand] = {}
        self._count = 0
        self._now_s = 0.0
        self._now_ns = 0
        self._held_up_s = 0.0
        self._unpowered_s = 0.0
        self._stop_s: float | None = None
        self._stopped_after_s: float | None = None

    @property
    def is_in_charge(self) -> bool:
        """Return whether commands move the robot now: not its tasks, and not the elevator."""
        return self.has_control and not self._parts.tasks.in_elevator

    @property
    def is_standing(self) -> bool:
        """Return whether the robot stands still, by its odometry."""
        vx, vy, yaw_rate = self._parts.odometry.twist
        return math.hypot(vx, vy) < _STANDS_M_S and abs(yaw_rate) < _STANDS_RAD_S

    def request(self, now_s: float, request: RobotRequest) -> dict[str, Any]:
        """Carry out or begin what a request asks for; return the answer as it is now."""
        self._now_s = now_s
        if request.do == "status":
            return self._status(request.text("id"))
        if request.do == "stop":
            return self._stop()
        if request.do == "restart":
            self._parts.restart(request.text("process"))
            return _answer("restart")
        if self._running is not None:
            first = self._running
            reason = f"{first.request.do} ({first.id}) runs"
            return _refusal(request.do, reason) | {"runs": first.id}
        if request.do == "resume":
            self.has_control = False
            self._release_brakes()
            return _answer("resume")
        if self._parts.tasks.in_elevator:
            return _refusal(request.do, "the robot rides in the elevator")
        return self._begin(request).fields()

    def find(self, command_id: str) -> RobotCommand | None:
        """Return a command by its id: the running one, or one of the last that ended."""
        if self._running is not None and self._running.id == command_id:
            return self._running
        return self._ended.get(command_id)

    def step(self, now_s: float, now_ns: int) -> None:
        """Advance by one cycle."""
        self._now_s, self._now_ns = now_s, now_ns
        if self._stop_s is not None and self.is_standing:
            self._stopped_after_s = round(now_s - self._stop_s, 2)
            self._log(INFO, f"stands still {self._stopped_after_s:.1f} s after the stop")
            self._stop_s = None
        command, course = self._running, self._course
        if command is None or course is None:
            return
        command.seconds = now_s - command.started_s
        try:
            self._watch(command.request.do)
            next(course)
        except StopIteration as end:
            command.result = end.value
            self._end(command, "done")
        except CommandFailedError as error:
            self._halt()
            self._end(command, "failed", str(error))

    def fields(self) -> dict[str, Any]:
        """Return the body of a ``state`` message while the robot is commanded."""
        parts, command = self._parts, self._running
        mode = "charge" if parts.battery.is_charging else "idle"
        goal = stage = ""
        remaining_m = self._straight.remaining_m if self._straight else 0.0
        if command is not None:
            do = command.request.do
            mode = _MODES.get(do, "drive")
            stage = f"{do}_{command.phase}" if command.phase else do
            goal = STATION.name if do == "dock" else command.request.text("area")
        elif self._stop_s is not None:
            mode = "stop"
        if not parts.navigation.is_idle:
            remaining_m = parts.navigation.distance_to_goal(parts.localisation.estimate)
        return {
            "mode": mode,
            "task_id": command.id if command else "",
            "stage": stage,
            "floor": parts.tasks.floor,
            "cart_attached": parts.base.has_cart,
            "goal": goal,
            "distance_to_goal": round(remaining_m, 3),
        }

    # -- beginning and ending -----------------------------------------------------------------

    def _begin(self, request: RobotRequest) -> RobotCommand:
        self._take_control()
        self._release_brakes()
        self._count += 1
        command = RobotCommand(f"command_{self._count:04d}", request, self._now_s)
        self._running = command
        self._course = self._make_course(command)
        self._held_up_s = self._unpowered_s = 0.0
        self._event(command, "started")
        self._log(INFO, f"{command.id} started: {request.do}")
        return command

    def _make_course(self, command: RobotCommand) -> Course:
        courses = {
            "linear": self._linear, "rotate": self._rotate, "go_to": self._go_to,
            "dock": self._dock, "undock": self._undock, "load": self._load, "unload": self._unload,
        }  # fmt: skip
        return courses[command.request.do](command)

    def _end(self, command: RobotCommand, state: str, reason: str = "") -> None:
        command.state, command.reason = state, reason
        command.seconds = self._now_s - command.started_s
        self._running = self._course = self._straight = self.wish = None
        self._ended[command.id] = command
        if len(self._ended) > KEPT_COMMANDS:
            del self._ended[next(iter(self._ended))]
        self._event(command, "finished" if state == "done" else "aborted")
        level = INFO if state == "done" else WARNING
        self._log(level, f"{command.id} {state}: {command.request.do} {reason}".rstrip())

    def _take_control(self) -> None:
        self.has_control = True
        self._parts.tasks.hand_over(self._now_s)

    def _release_brakes(self) -> None:
        self.is_braking, self._stop_s = False, None
        self._parts.base.brake(False)

    def _halt(self) -> None:
        """Brake at once, and stay so until the next motion."""
        self.is_braking, self.wish = True, None
        self._parts.navigation.stop()
        self._parts.base.brake(True)

    def _stop(self) -> dict[str, Any]:
        self._take_control()
        self._halt()
        self._stop_s, self._stopped_after_s = self._now_s, None
        if self.is_standing:
            self._stop_s, self._stopped_after_s = None, 0.0
        command = self._running
        if command is not None:
            self._end(command, "aborted", "stopped by command")
        return _answer("stop") | {"stopped": command.id if command else ""} | self._motion()

    def _status(self, command_id: str) -> dict[str, Any]:
        if command_id:
            command = self.find(command_id)
            if command is None:
                return _refusal("status", f"there is no command {command_id!r}")
            return command.fields() | self._motion()
        parts, running = self._parts, self._running
        pose = parts.localisation.estimate
        return _answer("status") | {
            "control": "commands" if self.has_control else "tasks",
            "running": running.fields() if running else None,
            "area": self._area_here(),
            "pose": [round(pose.x, 3), round(pose.y, 3), round(pose.yaw, 4)],
            "cart": parts.base.has_cart,
            "charging": parts.battery.is_charging,
            "battery_percent": round(100.0 * parts.battery.gauge, 1),
            **self._motion(),
        }

    def _motion(self) -> dict[str, Any]:
        return {
            "standstill": self.is_standing and self._stop_s is None,
            "stopped_after_s": self._stopped_after_s,
        }

    # -- what every command waits for ---------------------------------------------------------

    def _watch(self, do: str) -> None:
        """Raise CommandFailedError if something keeps the robot from moving at all."""
        parts = self._parts
        needed = (*_NEEDED, "localisation") if do in _BY_THE_MAP else _NEEDED
        if dead := [name for name in needed if not parts.host.is_working(name)]:
            raise CommandFailedError(f"{dead[0]} does not work")
        safety = parts.safety.fields()
        if safety["e_stop_pressed"]:
            raise CommandFailedError("emergency stop pressed")
        if ends := [end for end in ("front", "rear") if safety[f"bumper_{end}"]]:
            raise CommandFailedError(f"the {ends[0]} of the robot touches something")
        percent = 100.0 * parts.battery.gauge
        begins = self._running is not None and self._now_s - self._running.started_s < 2 * CYCLE_S
        if do != "dock" and percent < (_LOW_AT_START if begins else _LOW_ON_THE_WAY):
            raise CommandFailedError(f"battery low: {percent:.0f} %")
        off = [name for name, unit in parts.base.units.items() if not unit.status() & 0b10]
        self._unpowered_s = self._unpowered_s + CYCLE_S if off else 0.0
        if self._unpowered_s > _UNPOWERED_S:
            raise CommandFailedError(f"wheels without power: {', '.join(off)}")

    def _watch_way(self, is_held_up: bool, is_backward: bool = False) -> None:
        """Wait while the way is not free; raise CommandFailedError after ten seconds."""
        before_s, self._held_up_s = self._held_up_s, self._held_up_s + CYCLE_S
        if not is_held_up:
            self._held_up_s = 0.0
        elif self._held_up_s > _BLOCKED_S:
            raise CommandFailedError(self._obstacle(is_backward))
        elif before_s <= _HELD_UP_S < self._held_up_s:
            line = f"{self._obstacle(is_backward)}, waiting since 4 s"
            self._parts.tasks.log.append(LogLine(WARNING, "navigation", line))

    def _obstacle(self, is_backward: bool) -> str:
        """Describe what is in the way, by the scan and the map."""
        free_m, pose = self._free_m(is_backward), self._parts.localisation.estimate
        if free_m is None:
            return f"no scan of the {'rear' if is_backward else 'front'} laser"
        yaw = wrap(pose.yaw + math.pi) if is_backward else pose.yaw
        cos, sin = math.cos(yaw), math.sin(yaw)
        lines = [(_LASER_M, side * _BESIDE_M) for side in (-1, 0, 1)]
        expected_m = min(
            self._parts.world.wall_ahead(
                (pose.x + x * cos - y * sin, pose.y + x * sin + y * cos), yaw
            )
            for x, y in lines
        )
        kind = "a wall or furniture" if free_m > expected_m - 0.3 else "a person or thing"
        where = "behind" if is_backward else "ahead"
        return f"blocked by {kind} {free_m:.2f} m {where}"

    def _free_m(self, is_backward: bool) -> float | None:
        """Return how far the way is free, m; None when there is no fresh scan."""
        navigation, scan = self._parts.navigation, self._parts.laser_rear.last
        if not is_backward:
            return navigation.free_m if navigation.has_scan else None
        is_fresh = scan is not None and self._now_ns - scan.stamp_ns < OLD_SCAN_NS
        return free_ahead(scan.ranges) if scan is not None and is_fresh else None

    def _time_out(self, began_s: float, limit_s: float) -> None:
        if self._now_s - began_s > limit_s:
            raise CommandFailedError(f"not there after {limit_s:.0f} s")

    def _area_here(self) -> str:
        pose = self._parts.localisation.estimate
        here = (pose.x, pose.y)
        names = (name for name, p in PLACES.items() if math.dist(p.spot, here) < _NEAR_M)
        return next(names, "")

    # -- pieces of commands -------------------------------------------------------------------

    def _drive(self, line: Straight, limit_s: float, *, by_map: bool = False) -> Generator[None]:
        """Drive a line to its end, by odometry or by the map, and come to rest."""
        parts, began_s = self._parts, self._now_s
        self._straight = line
        while True:
            pose = parts.localisation.estimate if by_map else parts.odometry.pose
            wish = line.step(pose, self._free_m(line.is_backward) or 0.0)
            if wish is None:
                break
            self._watch_way(abs(wish[0]) < 0.02, line.is_backward)
            self._time_out(began_s, limit_s)
            self.wish = wish
            yield
        yield from self._settle()

    def _turn(self, turn: Turn, limit_s: float) -> Generator[None]:
        began_s = self._now_s
        while (wish := turn.step(self._parts.odometry.pose)) is not None:
            self._time_out(began_s, limit_s)
            self.wish = wish
            yield
        yield from self._settle()
        turn.step(self._parts.odometry.pose)

    def _follow(self, path: list[Point]) -> Generator[None]:
        """Let navigation follow a path, and come to rest."""
        navigation, began_s = self._parts.navigation, self._now_s
        pose = self._parts.localisation.estimate
        self.wish = None
        navigation.go(pose, path)
        limit_s = 45.0 + navigation.distance_to_goal(pose) / 0.25
        while not navigation.is_idle:
            speed, _, turn = navigation.command
            self._watch_way(abs(speed) < 0.02 and abs(turn) < 0.05)
            self._time_out(began_s, limit_s)
            yield
        yield from self._settle()

    def _settle(self) -> Generator[None]:
        """Wait until the robot stands still."""
        began_s = self._now_s
        self.wish = 0.0, 0.0
        calm = 0
        while calm < 2:
            yield
            calm = calm + 1 if self.is_standing else 0
            if self._now_s - began_s > _SETTLE_S:
                raise CommandFailedError("the robot does not come to rest")

    def _pause(self, seconds: float) -> Generator[None]:
        until_s = self._now_s + seconds
        while self._now_s < until_s:
            yield

    # -- the commands -------------------------------------------------------------------------

    def _linear(self, command: RobotCommand) -> Course:
        distance_m = command.request.number("distance_m")
        speed = command.request.number("speed_m_s")
        parts = self._parts
        if distance_m < 0 and parts.base.has_cart:
            raise CommandFailedError("cannot look behind the cart")
        line = Straight(parts.odometry.pose, distance_m, speed)
        yield from self._drive(line, 30.0 + 3.0 * abs(distance_m) / speed)
        line.step(parts.odometry.pose, 0.0)
        return {"distance_m": round(line.travelled_m, 3)}

    def _rotate(self, command: RobotCommand) -> Course:
        angle, rate = command.request.number("angle_rad"), command.request.number("speed_rad_s")
        turn = Turn(self._parts.odometry.pose, angle, rate)
        yield from self._turn(turn, 15.0 + 3.0 * abs(angle) / rate)
        return {"angle_rad": round(turn.turned_rad, 4)}

    def _go_to(self, command: RobotCommand) -> Course:
        area = command.request.text("area")
        yield from self._drive_to(area)
        pose = self._parts.localisation.estimate
        return {"area": area, "off_m": round(math.dist(PLACES[area].spot, (pose.x, pose.y)), 3)}

    def _drive_to(self, area: str) -> Generator[None]:
        yield from self._follow(way_to(self._parts.localisation.estimate, PLACES[area]))
        if self._area_here() != area:
            raise CommandFailedError(f"ended beside {area}")

    def _dock(self, command: RobotCommand) -> Course:
        """Drive to the charging station and onto its contacts; no current means a miss."""
        parts = self._parts
        if parts.base.has_cart:
            raise CommandFailedError("carries a cart: unload it first")
        if parts.tasks.floor != 0:
            raise CommandFailedError("the charging station is on floor 0")
        if not parts.battery.is_charging:
            command.phase = "way"
            pose = parts.localisation.estimate
            yield from self._follow([*way_to(pose, STATION)[:-1], approach_point()])
            command.phase = "align"
            pose = parts.localisation.estimate
            turn = Turn(parts.odometry.pose, wrap(-math.pi / 2 - pose.yaw), 0.3)
            yield from self._turn(turn, 30.0)
            command.phase = "approach"
            line = final_approach(parts.localisation.estimate, parts.marker.see())
            yield from self._drive(line, 60.0, by_map=True)
        command.phase = "contact"
        yield from self._wait_for_current()
        return {"current_a": round(parts.battery.charge_a, 1)}

    def _wait_for_current(self) -> Generator[None]:
        battery, began_s, since_s = self._parts.battery, self._now_s, self._now_s
        while self._now_s - since_s < _CURRENT_FOR_S:
            yield
            enough = battery.charge_a > _CURRENT_FLOWS_A or battery.gauge > _FULL
            if not (battery.is_charging and enough):
                since_s = self._now_s
            if self._now_s - began_s > _CURRENT_WITHIN_S:
                raise CommandFailedError("docking missed: no charging current")

    def _undock(self, command: RobotCommand) -> Course:
        """Leave the charging station, whichever way round the robot stands in it."""
        pose = self._parts.localisation.estimate
        if self._area_here() != STATION.name:
            raise CommandFailedError("is not in the charging station")
        if self._parts.base.has_cart:
            raise CommandFailedError("cannot look behind the cart")
        distance_m = math.copysign(UNDOCKING_M, math.sin(pose.yaw))
        line = Straight(self._parts.odometry.pose, distance_m, 0.2)
        yield from self._drive(line, 60.0)
        return {"distance_m": round(line.travelled_m, 3)}

    def _load(self, command: RobotCommand) -> Course:
        if self._parts.base.has_cart:
            raise CommandFailedError("carries a cart already")
        area = yield from self._at_cart_place(command)
        command.phase = "couple"
        yield from self._pause(2.0)
        if area not in self._parts.tasks.carts:
            raise CommandFailedError(f"no cart at {area}")
        yield from self._pause(4.0)
        self._parts.base.has_cart = True
        self._parts.tasks.carts.discard(area)
        return {"area": area}

    def _unload(self, command: RobotCommand) -> Course:
        if not self._parts.base.has_cart:
            raise CommandFailedError("carries no cart")
        area = yield from self._at_cart_place(command)
        if area in self._parts.tasks.carts:
            raise CommandFailedError(f"another cart stands at {area}")
        command.phase = "release"
        yield from self._pause(5.0)
        self._parts.base.has_cart = False
        self._parts.tasks.carts.add(area)
        return {"area": area}

    def _at_cart_place(self, command: RobotCommand) -> Generator[None, None, str]:
        """Drive to the place of the command unless the robot stands there; return where it is."""
        wanted, here = command.request.text("area"), self._area_here()
        if wanted and wanted != here:
            command.phase = "way"
            yield from self._drive_to(wanted)
        area = wanted or here
        if area not in CART_PLACES:
            raise CommandFailedError("is at no place for carts")
        return area

    # -- what is published --------------------------------------------------------------------

    def _event(self, command: RobotCommand, event: str) -> None:
        self._parts.tasks.events.append(
            {
                "task_id": command.id,
                "kind": f"command_{command.request.do}",
                "event": event,
                "stage": command.phase,
                "location": command.request.text("area"),
                "cart": "",
                "elapsed_s": round(command.seconds, 3),
            }
        )

    def _log(self, level: int, text: str) -> None:
        self._parts.tasks.log.append(LogLine(level, "task_executor", text))


def _answer(do: str) -> dict[str, Any]:
    return {"ok": True, "do": do, "state": "done", "reason": ""}


def _refusal(do: str, reason: str) -> dict[str, Any]:
    return {"ok": False, "do": do, "state": "refused", "reason": reason}
