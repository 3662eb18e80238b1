"""EtherCAT: the cyclic frames of the four wheel units at 1 kHz, out and back, on a veth pair.

Each cycle is a frame with two datagrams: an LRW of the process image, and a BRD of the AL status.
It is sent as it leaves the master, with working counters of 0, and again as it returns: with bit
0x02 of the source address set, inputs and working counters filled in by the connected units.
"""

from __future__ import annotations

import heapq
import socket
import struct
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.sim.base import SENSOR_NOISE, WheelUnit
from amberbox.sim.buses import BusSetup
from amberbox.sim.fieldbus import COUNTS_PER_DEVICE, CYCLES_PER_S, command_fields
from amberbox.sim.noise import Noise
from amberbox.sim.robot import TICK_NS, Robot
from amberbox.sim.topics import TOPIC_BY_NAME, WHEELS

LOGICAL_ADDRESS = 0x10000
ETHERTYPE = 0x88A4
CYCLE_NS = NS // CYCLES_PER_S
CYCLES = TICK_NS // CYCLE_NS  # in a tick
_MASTER = bytes.fromhex("101010101010")
_RETURNED = bytes.fromhex("121010101010")
_BROADCAST = b"\xff" * 6
_BRD, _LRW = 7, 12
_AL_STATUS, _OPERATIONAL = 0x0130, 8
_MORE = 0x8000  # a further datagram follows
_MOST_WAITING = 20_000  # frames; a robot that is faster than the interface waits
_DATAGRAM = struct.Struct("<BBIHH")


def _types(part: str) -> dict[str, str]:
    shape = TOPIC_BY_NAME["wheels"].body["properties"][part]["properties"][WHEELS[0]]
    return {name: _type(name, one["type"]) for name, one in shape["properties"].items()}


def _type(name: str, kind: str) -> str:
    if kind == "number":
        return "float"
    return "uint64" if name.endswith("_ts") else "uint16"


# the elements of a unit, in their order: as the paper's ``ethercat`` block has them
INPUT_ELEMENTS: Mapping[str, str] = {**_types("commands"), "timestamp": "uint64"}
OUTPUT_ELEMENTS: Mapping[str, str] = _types("sensors")


def _record(elements: Mapping[str, str]) -> np.dtype[Any]:
    numpy_types = {"float": "<f4", "uint16": "<u2", "uint64": "<u8"}
    return np.dtype([(name, numpy_types[kind]) for name, kind in elements.items()])


COMMANDS, SENSORS = _record(INPUT_ELEMENTS), _record(OUTPUT_ELEMENTS)
_NUMBERS = [name for name, kind in OUTPUT_ELEMENTS.items() if kind == "float"]
_SIGMA = np.array(SENSOR_NOISE)


def open_bus(address: str, setup: BusSetup) -> EthercatBus:
    """Open a raw socket on an interface; raises AmberboxError without it, or without the right."""
    return EthercatBus(address, setup)


class EthercatBus:
    """The master's frames and what returns of them, sent by a thread of their own."""

    def __init__(self, interface: str, setup: BusSetup) -> None:
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
            self._socket.bind((interface, 0))
        except PermissionError:
            raise AmberboxError(
                "raw frames need the right CAP_NET_RAW", "run it as root, or in a user namespace"
            ) from None
        except OSError as error:
            raise AmberboxError(
                f"cannot send on {interface}: {error.strerror or error}",
                "ip link add ecat0 type veth peer name ecat1; ip link set ecat0 up",
            ) from error
        self._noise = Noise(setup.seed, "ethercat")
        self._speed = setup.speed
        self._image = np.zeros(len(WHEELS), SENSORS)
        self._cycle = 0
        self.failed = 0
        self._waiting: list[tuple[int, int, bytes]] = []
        self._order = 0
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._send_due, name="ethercat", daemon=True)
        self._thread.start()

    def send(self, topic: str, message: Mapping[str, Any]) -> None:
        """Do nothing: the fieldbus carries process data, no messages."""

    def tick(self, robot: Robot, due_ns: int) -> None:
        """Queue the cycles of a tick, unless the bus master does not work."""
        if not robot.host.is_working("bus_master"):
            return
        units = list(robot.base.units.values())
        present = [unit.connected > 0.5 for unit in units]
        commands = _commands(units, robot.device_time_us)
        sensors = self._sensors(robot, units)
        for cycle in range(CYCLES):
            after_ns = cycle * CYCLE_NS + abs(self._noise.normal(robot.bus.cycle_jitter_us * 1e3))
            at_ns = due_ns + round(after_ns / self._speed) if self._speed else due_ns
            self._queue(at_ns, _frame(_MASTER, self._cycle, commands, self._image, 0, 0))
            if self._noise.uniform() >= robot.bus.frame_loss:
                self._image[present] = sensors[cycle][present]
                count = sum(present)
                answer = _frame(
                    _RETURNED, self._cycle, commands, self._image, COUNTS_PER_DEVICE * count, count
                )
                self._queue(at_ns, answer)
            self._cycle += 1
        with self._changed:
            self._changed.notify()
        while len(self._waiting) > _MOST_WAITING:
            time.sleep(CYCLE_NS / NS)

    def close(self) -> None:
        """Send what waits, and close the socket."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join()
        self._socket.close()

    def _sensors(self, robot: Robot, units: list[WheelUnit]) -> NDArray[Any]:
        """Return what the units measure: a record for each cycle of the tick and each unit."""
        found = np.zeros((CYCLES, len(units)), SENSORS)
        exact = np.array([unit.numbers(robot.pressure_hpa) for unit in units])
        size = CYCLES * exact.size
        noisy = exact + self._noise.normals(size, 1.0).reshape(CYCLES, *exact.shape) * _SIGMA
        for place, name in enumerate(_NUMBERS):
            found[name] = noisy[:, :, place]
        found["status1"] = [unit.status() for unit in units]
        cycles = self._cycle + np.arange(CYCLES)[:, None]
        found["status2"] = cycles % 65536
        times_us = robot.device_time_us + np.arange(CYCLES)[:, None] * (CYCLE_NS // 1000)
        found["sensor_ts"], found["imu_ts"] = times_us - 200, times_us - 700
        found["setpoint_ts"] = times_us - 1000
        return found

    def _queue(self, at_ns: int, frame: bytes) -> None:
        with self._changed:
            self._order += 1
            heapq.heappush(self._waiting, (at_ns, self._order, frame))

    def _send_due(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._is_closed:
                    self._changed.wait()
                if not self._waiting:
                    return
                at_ns, _, frame = heapq.heappop(self._waiting)
            wait_ns = at_ns - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns / NS)
            try:
                self._socket.send(frame)
            except OSError:  # the interface is down, or has no room
                self.failed += 1


def _commands(units: list[WheelUnit], time_us: int) -> bytes:
    found = np.zeros(len(units), COMMANDS)
    for place, unit in enumerate(units):
        for name, value in command_fields(unit).items():
            found[place][name] = value
    found["timestamp"] = time_us
    return found.tobytes()


def _frame(
    source: bytes, cycle: int, commands: bytes, image: NDArray[Any], counter: int, devices: int
) -> bytes:
    """Return an Ethernet frame: outputs of all units and then their inputs, and the AL status."""
    data = commands + image.tobytes()
    index = cycle % 256
    lrw = _DATAGRAM.pack(_LRW, index, LOGICAL_ADDRESS, len(data) | _MORE, 0) + data
    status = _OPERATIONAL if devices else 0
    brd = _DATAGRAM.pack(_BRD, index, devices | _AL_STATUS << 16, 2, 0)
    body = lrw + counter.to_bytes(2, "little") + brd + struct.pack("<HH", status, devices)
    head = _BROADCAST + source + ETHERTYPE.to_bytes(2)
    return head + (len(body) | 0x1000).to_bytes(2, "little") + body
