"""This computer: processor, memory, disks, network, temperatures, fans, battery, processes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from amberbox.core.errors import AmberboxError
from amberbox.core.host import (
    ALL_CORES,
    busy_percent,
    core_times,
    disk_usage,
    link_state,
    memory,
    running_processes,
    temperatures,
    usage,
)
from amberbox.core.names import identifier
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import unknown_topics
from amberbox.core.types import Schema, Topic

if TYPE_CHECKING:
    import psutil

SAMPLE = """\
- host:
    mounts: [/, /data]
    interfaces: [eth*, wlan0]
    processes: {master: rosmaster, planner: "*move_base*__name:=planner*"}
    topics:
      - topic: {name: cpu}
      - topic: {name: temperature, max_frequency: 0.2}
      - topic: {name: process}
"""
PASSIVE = "only reads counters of the kernel; it starts nothing and needs no privileges"

PEER = "this computer"
MOST = 64  # disks, interfaces, sensors of one row
_LEFT_OUT_INTERFACES = ("veth*",)  # of containers: each start makes another name
_LEFT_OUT_DEVICES = ("loop*", "ram*", "zram*")
_UNITS = {
    "percent": "%",
    "percent_of_cores": "%",
    "celsius": "degC",
    "bytes": "bytes",
    "per_s": "bytes/s",
    "mb": "MB",
    "mbit": "Mbit/s",
    "mhz": "MHz",
    "rpm": "1/min",
    "minutes_left": "min",
}
"""Units by the end of a name."""

Row: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class HostOptions:
    """The ``host`` block."""

    period_s: float = option(1.0, "interval of the measurements", unit="s")
    mounts: Sequence[str] = option(
        (), "folders whose disks are measured; all mounted local disks when absent"
    )
    interfaces: Sequence[str] = option(
        (), "network interfaces by name or pattern; all but veth* when absent"
    )
    processes: Mapping[str, str] = option(
        {}, "names for columns, and the program, script or pattern of a command line of each"
    )
    topics: Sequence[TopicOptions] = option((), "groups to record; all when absent")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if not 0.1 <= self.period_s <= 3600:
            yield "period_s", "must be between 0.1 s and an hour"
        yield from (
            ("mounts", f"'{path}' is no absolute path") for path in self.mounts if path[:1] != "/"
        )
        for name, subject in self.processes.items():
            if identifier(name) != name:
                yield "processes", f"'{name}' is no name of a column; write {identifier(name)}"
            if not subject.strip():
                yield "processes", f"'{name}' names no process; write rosmaster"
        yield from unknown_topics(self.topics, _GROUPS)


Config = HostOptions


class HostSource:
    """Measures this computer periodically; each group is a topic of its own."""

    lossless = False

    def __init__(self, config: HostOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Measure until ``stop`` is set; what cannot be read now is tried again."""
        wanted = [topic.name for topic in self.config.topics] or list(_GROUPS)
        computer = _Computer(self.config)
        groups = [_Group(name, _GROUPS[name], computer, sink) for name in wanted]
        for group in groups:  # from which rates are counted
            group.prepare()
        stop.wait(min(self.config.period_s, 1.0))
        due_s = time.monotonic()
        while not stop.is_set():
            for group in groups:
                group.step()
            due_s = max(due_s + self.config.period_s, time.monotonic())
            stop.wait(due_s - time.monotonic())
        for group in groups:
            group.down("stopped")


Source = HostSource


@dataclass
class _Group:
    """One topic: its state, and the streams of the shapes that its rows have had."""

    name: str
    read: Callable[[_Computer], Row | None]
    computer: _Computer
    sink: Sink
    _streams: dict[tuple[str, ...], int] = field(default_factory=dict)
    _is_up: bool = False
    _trouble: str = ""

    def prepare(self) -> None:
        """Read counters once, so that the first row has rates."""
        with suppress(Exception):  # ``step`` reports it
            self.read(self.computer)

    def step(self) -> None:
        """Measure once. A group without anything to measure is absent, or down if it was there."""
        try:
            row = self.read(self.computer)
        except Exception as error:  # drivers and psutil raise all kinds of errors
            trouble = f"{self.name} cannot be read: {error or type(error).__name__}"
            if trouble != self._trouble:
                self.sink.event("host_unreadable", " ".join(trouble.split()), group=self.name)
            self._trouble = trouble
            self.down(trouble)
            return
        self._trouble = ""
        if not row:
            self.down("it is not there any more")
            return
        shape = tuple(_leaves(row))
        if shape not in self._streams:  # another disk or interface: its columns have units, too
            self._streams[shape] = self.sink.topic(_topic(self.name, row))
        if not self._is_up:
            self._is_up = True
            self.sink.link_up(self.name, PEER)
        self.sink.message(self._streams[shape], msgspec.json.encode(row), self.sink.now_ns())

    def down(self, reason: str) -> None:
        """Report the link as down if it is up."""
        if self._is_up:
            self._is_up = False
            self.sink.link_down(self.name, PEER, reason)


def _leaves(row: Row, above: str = "") -> Iterator[str]:
    for name, value in row.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{above}{name}/")
        else:
            yield f"{above}{name}"


def _topic(name: str, row: Row) -> Topic:
    document = msgspec.json.encode(_described(row))
    return Topic(name, "json", Schema(f"amberbox/host_{name}", "jsonschema", document))


def _described(row: Row) -> Row:
    described = {
        key: _described(value) if isinstance(value, Mapping) else {"unit": _unit(key)}
        for key, value in row.items()
    }
    return {"type": "object", "properties": described}


def _unit(name: str) -> str:
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")


def _some(rows: Mapping[str, Row]) -> Row:
    """Return the first rows, by names that columns can have."""
    return {identifier(name): rows[name] for name in sorted(rows)[:MOST]}


class _Computer:
    """What is needed from one measurement to the next: counters, and the processes seen."""

    def __init__(self, config: HostOptions) -> None:
        self.config = config
        self._cores = core_times()
        self._counters: dict[str, tuple[float, Mapping[str, int]]] = {}
        self._busy: dict[int, float] = {}
        self._busy_s = 0.0
        self._seen: dict[str, set[psutil.Process]] = {}
        self._restarts: dict[str, int] = {}

    def cpu(self) -> Row:
        """Return how busy all cores and each of them were since the last call."""
        import psutil

        before, self._cores = self._cores, core_times()
        spent = {name: (before.get(name), now) for name, now in self._cores.items()}
        busy = {
            name: busy_percent(old, now) for name, (old, now) in spent.items() if old is not None
        }
        whole = busy.pop(ALL_CORES)
        first, last = before[ALL_CORES], self._cores[ALL_CORES]
        seconds = sum(last[:8]) - sum(first[:8])
        parts = {"user": 0, "system": 2, "waiting": 4, "stolen": 7}
        load = os.getloadavg()
        frequency = psutil.cpu_freq()
        return {
            "percent": whole,
            **{
                f"{name}_percent": 100 * (last[n] - first[n]) / seconds if seconds > 0 else None
                for name, n in parts.items()
            },
            "percent_of_cores": [percent for percent in busy.values() if percent is not None],
            "load_1m": load[0],
            "load_5m": load[1],
            "load_15m": load[2],
            "cores": len(self._cores) - 1,
            "frequency_mhz": frequency.current if frequency else None,
        }

    def memory(self) -> Row:
        """Return the use of memory and swap."""
        ram, swap = memory("ram"), memory("swap")
        return {
            "total_bytes": ram.total,
            "available_bytes": ram.available,
            "used_percent": ram.used_percent,
            "swap_total_bytes": swap.total,
            "swap_used_bytes": swap.total - swap.available,
            "swap_used_percent": swap.used_percent,
        }

    def disk(self) -> Row:
        """Return how full disks are, each once."""
        import psutil

        mounts = {path: path for path in self.config.mounts}
        if not mounts:
            found = psutil.disk_partitions()
            local = [part for part in found if "/loop" not in part.device]
            mounts = {part.device: part.mountpoint for part in reversed(local)}
        rows = {}
        for mount in mounts.values():
            try:
                now = disk_usage(Path(mount))._asdict()
            except (OSError, AmberboxError):
                if self.config.mounts:
                    raise
                continue  # mounted where this user may not look
            del now["mount"]
            rows[mount.strip("/").replace("/", "_") or "root"] = now
        return _some(rows)

    def disk_io(self) -> Row:
        """Return what was read from and written to each disk, and how busy it was."""
        import psutil

        found = psutil.disk_io_counters(perdisk=True) or {}
        disks = {
            name: now
            for name, now in found.items()
            if Path("/sys/block", name).exists() and not _fits(name, _LEFT_OUT_DEVICES)
        }
        self._forget("disk_io", disks)
        return _some({name: self._disk(name, now._asdict()) for name, now in disks.items()})

    def _disk(self, name: str, now: Mapping[str, int]) -> Row:
        counted = {key: now[key] for key in ("read_bytes", "write_bytes")}
        spent = self._rates(f"disk_io {name}", {**counted, "busy": now.get("busy_time", 0)})
        busy_ms = spent.pop("busy_per_s")
        return {
            **counted,
            **spent,
            "busy_percent": None if busy_ms is None else min(100.0, busy_ms / 10),
        }

    def network(self) -> Row:
        """Return what each interface has received and sent, and what went wrong."""
        import psutil

        found = psutil.net_io_counters(pernic=True)
        chosen = {name: now for name, now in found.items() if self._records(name)}
        self._forget("network", chosen)
        rows: dict[str, dict[str, Any]] = {}
        for name, now in chosen.items():
            counted = {"rx_bytes": now.bytes_recv, "tx_bytes": now.bytes_sent}
            rows[name] = {
                **counted,
                **self._rates(f"network {name}", counted),
                "rx_packets": now.packets_recv,
                "tx_packets": now.packets_sent,
                "rx_errors": now.errin,
                "tx_errors": now.errout,
                "rx_dropped": now.dropin,
                "tx_dropped": now.dropout,
            }
            with suppress(OSError):  # just pulled out
                rows[name] |= link_state(Path("/sys/class/net", name))._asdict()
        return _some(rows)

    def _records(self, interface: str) -> bool:
        if self.config.interfaces:
            return _fits(interface, self.config.interfaces)
        return not _fits(interface, _LEFT_OUT_INTERFACES)

    def _rates(self, key: str, counted: Mapping[str, int]) -> dict[str, float | None]:
        """Return how fast counters grew since the last call; None at first and after a reset."""
        now_s = time.monotonic()
        before_s, before = self._counters.get(key, (now_s, {}))
        self._counters[key] = now_s, counted
        return {
            f"{name}_per_s": (value - before[name]) / (now_s - before_s)
            if now_s > before_s and value >= before[name]
            else None
            for name, value in counted.items()
        }

    def _forget(self, group: str, present: Mapping[str, Any]) -> None:
        """Drop counters of what is gone, so that names that change do not add up."""
        gone = [
            key
            for key in self._counters
            if key.partition(" ")[0] == group and key.partition(" ")[2] not in present
        ]
        for key in gone:
            del self._counters[key]

    def temperature(self) -> Row:
        """Return the temperature of each sensor, and the highest."""
        sensors = {sensor.name: sensor.celsius for sensor in temperatures()}
        if not sensors:
            return {}
        named = {identifier(name): {"celsius": sensors[name]} for name in sorted(sensors)[:MOST]}
        return {"hottest_celsius": max(sensors.values()), **named}

    def fan(self) -> Row:
        """Return the speed of each fan."""
        import psutil

        rows = {}
        for chip, fans in psutil.sensors_fans().items():
            for number, fan in enumerate(fans, start=1):
                rows[f"{chip}_{fan.label or f'fan{number}'}"] = {"rpm": fan.current}
        return _some(rows)

    def battery(self) -> Row | None:
        """Return the battery of this computer; None without one."""
        import psutil

        now = psutil.sensors_battery()
        if now is None:
            return None
        left_s = now.secsleft
        return {
            "percent": now.percent,
            "plugged": now.power_plugged,
            "minutes_left": left_s / 60 if left_s >= 0 else None,
        }

    def process(self) -> Row | None:
        """Return the use of each group of processes; None if none is configured."""
        if not self.config.processes:
            return None
        seen, is_hidden = running_processes()
        now_s = time.monotonic()
        busy: dict[int, float] = {}
        rows = {}
        for name, subject in self.config.processes.items():
            found = {running.process for running in seen if running.is_called(subject)}
            rows[name] = self._processes(name, found, busy, now_s, is_hidden=is_hidden)
        self._busy, self._busy_s = busy, now_s
        return rows

    def _processes(
        self,
        name: str,
        found: set[psutil.Process],
        busy: dict[int, float],
        now_s: float,
        *,
        is_hidden: bool,
    ) -> Row:
        used = usage(found)
        busy |= {pid: now.cpu_s for pid, now in used.items()}
        alive = {process for process in found if process.pid in used}
        before = self._seen.get(name)
        if before is not None:
            self._restarts[name] = self._restarts.get(name, 0) + len(alive - before)
        self._seen[name] = alive
        spent_s = sum(busy[pid] - self._busy[pid] for pid in used if pid in self._busy)
        passed_s = now_s - self._busy_s
        return {
            "count": None if is_hidden and not used else len(used),
            "cpu_percent": 100 * spent_s / passed_s if self._busy_s else None,
            "rss_mb": sum(now.rss_mb for now in used.values()),
            "threads": sum(now.threads for now in used.values()),
            "open_files": _open_files(alive),
            "restarts": self._restarts.get(name, 0),
        }


def _open_files(processes: set[psutil.Process]) -> int | None:
    """Return the descriptors that processes have open; None where that is not allowed."""
    import psutil

    total = 0
    for process in processes:
        try:
            total += process.num_fds()
        except psutil.NoSuchProcess:
            continue
        except psutil.AccessDenied:
            return None
    return total


def _fits(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


_GROUPS: Mapping[str, Callable[[_Computer], Row | None]] = {
    "cpu": _Computer.cpu,
    "memory": _Computer.memory,
    "disk": _Computer.disk,
    "disk_io": _Computer.disk_io,
    "network": _Computer.network,
    "temperature": _Computer.temperature,
    "fan": _Computer.fan,
    "battery": _Computer.battery,
    "process": _Computer.process,
}
