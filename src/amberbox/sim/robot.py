"""A simulated hospital transport robot, put together from its parts, on a virtual clock."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.sim.base import (
    CONTACT_M,
    BatteryPack,
    MovingBase,
    Odometry,
    SafetyLine,
    slower,
    twist_fields,
)
from amberbox.sim.command_executor import CommandedParts, CommandExecutor
from amberbox.sim.faults import ActiveFault, Injector, SimulatedFault
from amberbox.sim.fieldbus import Fieldbus
from amberbox.sim.maneuvers import DockingMarker, is_on_contacts
from amberbox.sim.missions import SCENARIOS, Executor, Planner
from amberbox.sim.navigation import Localisation, Navigation
from amberbox.sim.noise import Noise, Pose2D
from amberbox.sim.requests import check_request
from amberbox.sim.sensors import Imu, Laser, Wifi, cast_views
from amberbox.sim.software import HostComputer, LogLine, SimulatedNode
from amberbox.sim.topics import TOPICS, TopicSpec
from amberbox.sim.world import PLACES, HospitalWorld

TICK_NS = 10_000_000
TICKS_PER_S = NS // TICK_NS
START_NS = 1_767_600_000 * NS  # 2026-01-05T08:00:00Z
_FOR_EVER_S = 1e9
_WATCHDOG_NS = 500_000_000
_FREED_AFTER_S = 30.0
_HPA_PER_FLOOR = 0.42
_LASERS_AND_SENSORS = ("laser_front", "laser_rear", "imu", "localisation")
_PARTS = ("base", "bus", "battery", "wifi", "host", "safety", "docking", *_LASERS_AND_SENSORS)
_STOP_M_S2, _STOP_RAD_S2 = 4.0, 8.0  # how fast the setpoints of the wheels fall at a stop
_CART_BEHIND_M, _CART_RADIUS_M = 0.95, 0.3

Message = tuple[str, int, dict[str, Any]]
Reading = tuple[int, dict[str, Any]]


@dataclass(slots=True)
class _Outlet:
    """The output of one topic: its publishing node, message count and delays."""

    topic: str
    frame_id: str
    node: SimulatedNode
    noise: Noise
    count: int = 0
    last_sent_ns: int = 0


class Robot:
    """A robot and its software; ``step_until`` yields its messages, in order of time.

    The same seed, scenario and faults give the same messages byte for byte. Messages contain the
    measurements of sensors; ``truth()`` is never published.
    """

    def __init__(
        self,
        seed: int = 1,
        robot_id: str = "ropod_001",
        scenario: str = "transport",
        start_ns: int = START_NS,
    ) -> None:
        if scenario not in SCENARIOS:
            raise UsageError(f"unknown scenario {scenario!r}", f"one of {', '.join(SCENARIOS)}")
        self.robot_id, self.seed, self.start_ns = robot_id, seed, start_ns
        self._build(scenario)
        self._ticks = 0
        self._order = 0
        self._waiting: list[tuple[int, int, str, dict[str, Any]]] = []
        self._command = (0.0, 0.0, 0.0)
        self._wanted = (0.0, 0.0, 0.0)
        self._command_ns = 0
        self._stuck_s = 0.0
        self._log: list[LogLine] = []
        self._injector = Injector(seed, self.parts)
        self._outlets = {spec.name: self._outlet(spec) for spec in TOPICS}
        self._plan = _plan(self._outlets)

    def _build(self, scenario: str) -> None:
        setting = SCENARIOS[scenario]
        where = PLACES[setting["place"]].spot
        start = Pose2D(where[0], where[1], 1.5708)
        noise = self._noise
        self.world = HospitalWorld(noise("world"))
        self.base = MovingBase(noise, start)
        self.odometry = Odometry(start)
        self.bus = Fieldbus(self.base.units, noise("bus"))
        charge = noise("mission").uniform(*setting["charge"])
        self.battery = BatteryPack(charge, noise("battery"))
        self.laser_front = Laser(0.35, 0.0, noise("laser_front"))
        self.laser_rear = Laser(-0.35, 3.14159265, noise("laser_rear"))
        self.imu = Imu(start.yaw, noise("imu"))
        self.localisation = Localisation(noise("localisation"))
        self.wifi = Wifi(noise("wifi"))
        self.host = HostComputer(noise("host"))
        self.safety = SafetyLine()
        self.navigation = Navigation()
        self.executor = Executor(Planner(scenario, noise("tasks")), self.navigation, self.base)
        self.docking = DockingMarker(noise("docking"))
        self.commands = CommandExecutor(
            CommandedParts(
                tasks=self.executor,
                navigation=self.navigation,
                localisation=self.localisation,
                odometry=self.odometry,
                base=self.base,
                battery=self.battery,
                safety=self.safety,
                host=self.host,
                laser_rear=self.laser_rear,
                world=self.world,
                marker=self.docking,
                restart=self.restart,
            )
        )

    def _noise(self, name: str) -> Noise:
        return Noise(self.seed, name)

    def _outlet(self, spec: TopicSpec) -> _Outlet:
        node = self.host.nodes[spec.node or "supervisor"]
        return _Outlet(spec.name, spec.frame_id, node, self._noise(f"timing {spec.name}"))

    @property
    def now_ns(self) -> int:
        """Return virtual time: nanoseconds since the Unix epoch."""
        return self.start_ns + self._ticks * TICK_NS

    @property
    def now_s(self) -> float:
        """Return seconds since the robot was switched on."""
        return self._ticks / TICKS_PER_S

    @property
    def device_time_us(self) -> int:
        """Return the time of the clock that the devices of the fieldbus share, microseconds."""
        return (self._ticks * TICK_NS + 77_000_000_000) // 1000

    @property
    def pressure_hpa(self) -> float:
        """Return the air pressure where the robot is."""
        return 1013.2 - _HPA_PER_FLOOR * self.executor.floor_height

    @property
    def parts(self) -> dict[str, object]:
        """Return every part that a fault can affect, by name."""
        units = {f"wheel_{name}": unit for name, unit in self.base.units.items()}
        drives = {f"{name}.drive_1": unit.drive_1 for name, unit in units.items()} | {
            f"{name}.drive_2": unit.drive_2 for name, unit in units.items()
        }
        nodes = {f"node_{name}": node for name, node in self.host.nodes.items()}
        names = _PARTS
        return {name: getattr(self, name) for name in names} | units | drives | nodes

    def inject(
        self,
        fault: str | SimulatedFault,
        at_s: float | None = None,
        magnitude: float | None = None,
        until_s: float | None = None,
    ) -> None:
        """Inject a fault of the catalogue, or one of your own, at a time (now when not given).

        ``magnitude`` is the catalogue's default when not given, and must lie in its range.
        Raises UsageError for an unknown fault, a magnitude out of range or a time in the past.
        """
        at_s = self.now_s if at_s is None else at_s
        if at_s < self.now_s:
            name = fault if isinstance(fault, str) else fault.id
            raise UsageError(f"{name}: {at_s} s is over, it is {self.now_s} s", "take later")
        self._injector.add(fault, at_s, magnitude, until_s)

    def heal(self, fault_id: str) -> None:
        """End a fault now; UsageError if it was never injected."""
        self._injector.heal(fault_id, self.now_s)

    def restart(self, process: str) -> None:
        """Restart a process: what has killed it, or holds it up, is over."""
        self._injector.heal_part(f"node_{process}", self.now_s)
        self.host.nodes[process].die()

    def command(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Take a request such as ``{"do": "linear", "distance_m": 1.0}``; return the answer now.

        A motion answers ``running`` with its id; ``{"do": "status", "id": ...}`` tells later what
        became of it. Raises UsageError for a request that is wrong.
        """
        return self.commands.request(self.now_s, check_request(dict(request)))

    def truth(self) -> dict[str, Any]:
        """Return the ground truth: pose, twist and the active faults. Never published."""
        pose = self.base.pose
        return {
            "time_ns": self.now_ns,
            "pose": (pose.x, pose.y, pose.yaw),
            "twist": self.base.twist,
            "faults": self.active_faults(),
        }

    def active_faults(self) -> list[ActiveFault]:
        """Return the active faults with their present level."""
        return self._injector.active(self.now_s)

    def step_until(self, t_s: float) -> Iterator[Message]:
        """Simulate until ``t_s`` (seconds since switched on).

        Yields (topic, time of publication in ns, message) in order of time. Faults injected
        while the caller iterates act from the next tick (10 ms) on.
        """
        end_ns = self.start_ns + round(min(t_s, _FOR_EVER_S) * NS)
        while self.now_ns < end_ns:
            self._tick()
            self._ticks += 1
            yield from self._due(min(self.now_ns, end_ns))

    def _due(self, before_ns: int) -> Iterator[Message]:
        waiting = self._waiting
        while waiting and waiting[0][0] < before_ns:
            sent_ns, _, topic, message = heapq.heappop(waiting)
            yield topic, sent_ns, message

    def _tick(self) -> None:
        self._injector.apply(self.now_s)
        phase = self._ticks % TICKS_PER_S
        if phase % 2 == 0:
            self._move(0.02)
        if phase % 10 == 0:
            self._feel(0.1)
        for outlet, make in self._plan[phase]:
            self._publish(outlet, make(self))
        if self.executor.events or self.executor.log or self._log:
            self._speak()

    def _move(self, dt: float) -> None:
        """Step drives and body, at 50 Hz."""
        has_command = self.now_ns - self._command_ns < _WATCHDOG_NS
        controls = self.host.is_working("base_controller")
        wanted = self._command if has_command and controls else (0.0, 0.0, 0.0)
        if self.commands.is_braking:
            wanted = slower(self._wanted, _STOP_M_S2 * dt, _STOP_RAD_S2 * dt)
        self._wanted = wanted
        self.base.step(dt, wanted)
        if self.safety.touches:
            self.base.halt()
        motions = self.bus.step(dt)
        if controls:
            self.odometry.step(dt, motions)

    def _feel(self, dt: float) -> None:
        """Step the slow parts, at 10 Hz: people, battery, contact, software."""
        pose = self.base.pose
        self.world.step(dt, (pose.x, pose.y))
        for unit in self.base.units.values():
            unit.supply(dt, self.battery.voltage_v, self.safety.is_stopped)
        at_charger = self.executor.is_charging_place
        if self.commands.is_in_charge:
            at_charger = is_on_contacts(pose)
        self.battery.step(dt, self.base.power_w, at_charger)
        self._scan()
        if self._ticks % TICKS_PER_S == 0:
            self._log += self.host.step(1.0)
        if self.host.is_working("localisation"):
            lasers = [self.laser_front, self.laser_rear]
            self.localisation.step(pose, self.odometry.pose, lasers, self.now_ns)
        if self.commands.is_in_charge:
            self.commands.step(self.now_s, self.now_ns)
        elif self.host.is_working("task_executor"):
            self._work(dt)
        if self.host.is_working("navigation"):
            self._navigate()
        self._free(dt)

    def _scan(self) -> None:
        lasers = {"laser_front": self.laser_front, "laser_rear": self.laser_rear}
        views = cast_views(list(lasers.values()), self.base.pose, self.world.scene)
        front_m, rear_m = (float(view.expected.min()) for view in views)
        if self.base.has_cart and self.commands.is_in_charge:
            rear_m = min(rear_m, self._cart_clearance_m() + CONTACT_M)
        self.safety.feel(front_m, rear_m)
        for (name, laser), view in zip(lasers.items(), views, strict=True):
            if self.host.is_working(name):
                laser.turn(view, self.now_ns, self.base.has_cart and laser is self.laser_rear)

    def _cart_clearance_m(self) -> float:
        """Return how far the end of the cart is from the nearest obstacle, m."""
        pose = self.base.pose
        x = pose.x - _CART_BEHIND_M * math.cos(pose.yaw)
        y = pose.y - _CART_BEHIND_M * math.sin(pose.yaw)
        return self.world.clearance((x, y)) - _CART_RADIUS_M

    def _work(self, dt: float) -> None:
        estimate = self.localisation.estimate
        self.executor.step(dt, self.now_s, estimate, 100.0 * self.battery.gauge)

    def _navigate(self) -> None:
        self.navigation.look(self.laser_front.last, self.now_ns)
        if self.commands.wish is None:
            self.navigation.step(self.localisation.estimate)
        else:
            self.navigation.ramp(*self.commands.wish)
        self._command, self._command_ns = self.navigation.command, self.now_ns

    def _free(self, dt: float) -> None:
        """Move a robot that has been blocked by an obstacle for a while back to the corridor."""
        self._stuck_s = self._stuck_s + dt if self.safety.touches else 0.0
        if self._stuck_s < _FREED_AFTER_S:
            return
        self._stuck_s = 0.0
        self.executor.abort(self.now_s, "robot stands against something")
        pose = self.base.pose
        pose.x, pose.y = min(PLACES.values(), key=lambda p: _distance(p.spot, pose)).way_in[0]
        self.localisation.reset()
        self._log.append(LogLine(20, "supervisor", "robot moved by hand to the corridor"))

    def _publish(self, outlet: _Outlet, reading: Reading | None) -> None:
        if reading is None or not outlet.node.is_working:
            return
        acquired_ns, body = reading
        slowness = self.host.slowness
        delay_ns = 300_000 + int(abs(outlet.noise.normal(250_000.0 * slowness)) * slowness)
        sent_ns = max(self.now_ns + delay_ns, outlet.last_sent_ns + 1000)
        outlet.last_sent_ns = sent_ns
        outlet.count += 1
        self._order += 1
        sec, nanosec = divmod(acquired_ns + round(self.host.clock_shift_s * NS), NS)
        header = {
            "seq": outlet.count,
            "stamp": {"sec": sec, "nanosec": nanosec},
            "frame_id": outlet.frame_id,
        }
        message = {"header": header, **body}
        heapq.heappush(self._waiting, (sent_ns, self._order, outlet.topic, message))

    def _speak(self) -> None:
        """Publish the events and log lines since the last tick."""
        events, self.executor.events = self.executor.events, []
        lines, self._log, self.executor.log = self._log + self.executor.log, [], []
        for event in events:
            self._publish(self._outlets["tasks"], (self.now_ns, event))
        for line in lines:
            self._publish(self._outlets["log"], (self.now_ns, line._asdict()))

    def _read_imu(self) -> Reading:
        vx, _, yaw_rate = self.base.twist
        body = self.imu.read(1 / TICKS_PER_S, vx, yaw_rate, self.base.acceleration)
        return self.now_ns - 1_000_000, body

    def _read_odom(self) -> Reading:
        return self.now_ns, self.odometry.fields()

    def _read_cmd_vel(self) -> Reading:
        return self.now_ns, dict(twist_fields(*self._command))

    def _read_wheels(self) -> Reading:
        return self.now_ns, self.bus.wheels(self.device_time_us, self.pressure_hpa)

    def _read_bus(self) -> Reading:
        return self.now_ns, self.bus.counters()

    def _read_scan_front(self) -> Reading | None:
        return _scan_reading(self.laser_front)

    def _read_scan_rear(self) -> Reading | None:
        return _scan_reading(self.laser_rear)

    def _read_localisation(self) -> Reading:
        return self.now_ns, self.localisation.fields()

    def _read_battery(self) -> Reading:
        return self.now_ns, self.battery.fields()

    def _read_safety(self) -> Reading:
        return self.now_ns, self.safety.fields()

    def _read_state(self) -> Reading:
        if self.commands.is_in_charge:
            return self.now_ns, self.commands.fields()
        return self.now_ns, self.executor.fields(self.localisation.estimate)

    def _read_wifi(self) -> Reading:
        pose = self.base.pose
        return self.now_ns, self.wifi.fields(pose.x, pose.y, self.executor.in_elevator)

    def _read_host(self) -> Reading:
        return self.now_ns, self.host.fields()

    def _read_nodes(self) -> Reading:
        return self.now_ns, self.host.node_fields()


Make = Callable[[Robot], "Reading | None"]


def _scan_reading(laser: Laser) -> Reading | None:
    scan = laser.take()
    return None if scan is None else (scan.stamp_ns, scan.fields)


def _distance(point: tuple[float, float], pose: Pose2D) -> float:
    return (point[0] - pose.x) ** 2 + (point[1] - pose.y) ** 2


def _plan(outlets: Mapping[str, _Outlet]) -> list[list[tuple[_Outlet, Make]]]:
    """Return the messages to publish in each tick of a second; slow topics are spread out."""
    plan: list[list[tuple[_Outlet, Make]]] = [[] for _ in range(TICKS_PER_S)]
    for index, spec in enumerate(TOPICS):
        if spec.rate_hz == 0:
            continue
        make: Make = getattr(Robot, f"_read_{spec.name}")
        period = round(TICKS_PER_S / spec.rate_hz)
        for tick in range(index % period, TICKS_PER_S, period):
            plan[tick].append((outlets[spec.name], make))
    return plan
