"""The robot's software: its processes, the supervisor that restarts them, computer and log."""

from __future__ import annotations

from typing import Any, NamedTuple

from amberbox.sim.noise import Noise
from amberbox.sim.topics import NODES

MEMORY_TOTAL_MB, DISK_TOTAL_MB = 8192.0, 61440.0
_USUAL = {  # CPU in percent of a core, memory in MB
    "base_controller": (9.0, 38.0),
    "bus_master": (14.0, 22.0),
    "laser_front": (4.0, 31.0),
    "laser_rear": (4.0, 31.0),
    "imu_driver": (3.0, 18.0),
    "localisation": (38.0, 240.0),
    "navigation": (46.0, 410.0),
    "task_executor": (3.0, 96.0),
    "power_monitor": (1.0, 15.0),
    "supervisor": (2.0, 27.0),
}
_RESTART_AFTER_S = 4.0
_OUT_OF_MEMORY_MB = 0.97 * MEMORY_TOTAL_MB
INFO, WARNING, ERROR = 20, 30, 40


class LogLine(NamedTuple):
    """One line of the robot's log."""

    level: int
    name: str
    msg: str


class SimulatedNode:
    """A process.

    Knobs (nominal value): ``killed`` (0) above 0.5 it dies and is not restarted, ``stalled`` (0)
    above 0.5 it exists but does nothing, ``leak_mb_s`` (0).
    """

    def __init__(self, name: str, noise: Noise) -> None:
        self.name = name
        self._noise = noise
        self.killed = 0.0
        self.stalled = 0.0
        self.leak_mb_s = 0.0
        self.pid = 1000 + noise.integer(0, 900)
        self.beats = 0
        self.restarts = 0
        self.leaked_mb = 0.0
        self._down_s = 0.0

    @property
    def is_working(self) -> bool:
        """Return whether it works now."""
        return self.killed < 0.5 and self.stalled < 0.5 and self.pid != 0

    @property
    def rss_mb(self) -> float:
        """Return the memory it holds, MB."""
        return _USUAL[self.name][1] + self.leaked_mb if self.pid else 0.0

    def die(self) -> None:
        """End now; the supervisor will start it again."""
        self.pid, self.leaked_mb, self._down_s = 0, 0.0, 0.0

    def step(self, dt: float) -> list[LogLine]:
        """Advance by ``dt``; return the supervisor's log lines."""
        if self.pid and self.killed > 0.5:
            self.die()
            return [LogLine(ERROR, "supervisor", f"process {self.name} ended with code -11")]
        if not self.pid:
            self._down_s += dt
            if self._down_s < _RESTART_AFTER_S:
                return []
            self._down_s = 0.0
            self.restarts += 1
            self.pid = 1000 + self._noise.integer(1000, 30000)
            return [LogLine(WARNING, "supervisor", f"process {self.name} started, pid {self.pid}")]
        self.leaked_mb += self.leak_mb_s * dt
        if self.is_working:
            self.beats += 1
        return []

    def fields(self) -> dict[str, Any]:
        """Return this process's part of a ``nodes`` message."""
        cpu = _USUAL[self.name][0] * (1.0 + self._noise.normal(0.06))
        busy = {True: 0.0, False: cpu}[self.pid == 0]
        if self.pid and self.stalled > 0.5:
            busy = 99.0 + self._noise.normal(0.4)
        return {
            "pid": self.pid,
            "beats": self.beats,
            "restarts": self.restarts,
            "cpu_percent": round(busy, 2),
            "rss_mb": round(self.rss_mb + (self._noise.normal(0.3) if self.pid else 0.0), 2),
        }


class HostComputer:
    """The computer. Knobs (nominal value): ``load_percent`` (0) processor time that others use,
    ``disk_fill_mb_s`` (0), ``clock_shift_s`` (0) how far its clock is off."""

    def __init__(self, noise: Noise) -> None:
        self._noise = noise
        self.load_percent = 0.0
        self.disk_fill_mb_s = 0.0
        self.clock_shift_s = 0.0
        self.nodes = {name: SimulatedNode(name, noise) for name in NODES}
        self.disk_used_mb = 21000.0 + noise.uniform(0.0, 4000.0)
        self.uptime_s = 120.0 + noise.uniform(0.0, 600.0)
        self._load_1min = 1.2

    @property
    def memory_used_mb(self) -> float:
        """Return the memory in use by all, MB."""
        return 1350.0 + sum(node.rss_mb for node in self.nodes.values())

    @property
    def slowness(self) -> float:
        """Return how many times longer than usual a message waits for the processor."""
        return 1.0 + 0.25 * max(0.0, self.load_percent)

    def is_working(self, name: str) -> bool:
        """Return whether a process works."""
        return self.nodes[name].is_working

    def step(self, dt: float) -> list[LogLine]:
        """Advance by ``dt``; return new log lines."""
        self.uptime_s += dt
        self.disk_used_mb = min(
            DISK_TOTAL_MB, self.disk_used_mb + dt * (0.004 + self.disk_fill_mb_s)
        )
        lines = [line for node in self.nodes.values() for line in node.step(dt)]
        return lines + self._run_out()

    def fields(self) -> dict[str, Any]:
        """Return the body of a ``host`` message."""
        draw = self._noise.normal
        busy = sum(_USUAL[n.name][0] for n in self.nodes.values() if n.pid) / 4.0
        stalled = sum(25.0 for n in self.nodes.values() if n.pid and n.stalled > 0.5)
        cpu = min(100.0, max(0.0, busy + stalled + self.load_percent + draw(1.5)))
        self._load_1min += (cpu / 25.0 - self._load_1min) / 20.0
        used = self.memory_used_mb + draw(4.0)
        return {
            "cpu_percent": round(cpu, 2),
            "cpu_temperature": round(44.0 + 0.25 * cpu + draw(0.4), 1),
            "memory_used_mb": round(used, 1),
            "memory_total_mb": MEMORY_TOTAL_MB,
            "disk_used_mb": round(self.disk_used_mb, 1),
            "disk_total_mb": DISK_TOTAL_MB,
            "load_1min": round(self._load_1min, 2),
            "uptime": round(self.uptime_s, 1),
        }

    def node_fields(self) -> dict[str, Any]:
        """Return the body of a ``nodes`` message."""
        return {name: node.fields() for name, node in self.nodes.items()}

    def _run_out(self) -> list[LogLine]:
        lines = []
        if self.memory_used_mb > _OUT_OF_MEMORY_MB:
            victim = max(self.nodes.values(), key=lambda node: node.rss_mb)
            victim.die()
            lines.append(LogLine(ERROR, "kernel", f"out of memory, ended process {victim.name}"))
        if self.disk_used_mb >= DISK_TOTAL_MB and self._noise.uniform() < 0.2:
            lines.append(LogLine(ERROR, "supervisor", "write: no space left on device"))
        return lines
