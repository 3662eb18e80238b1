"""CAN: what the motor controllers and the battery send, with a DBC file that describes it."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.sim.base import READING_NOISE, WheelUnit
from amberbox.sim.buses import BusSetup
from amberbox.sim.noise import Noise
from amberbox.sim.robot import TICKS_PER_S, Robot
from amberbox.sim.topics import CELLS, STATUS, WHEELS

_DRIVES_HZ, _HEALTH_HZ = 50, 10
_VELOCITY, _CURRENT_Q, _TEMPERATURE = 1, 3, 11  # places in the numbers of a drive
_DRIVE_NUMBERS = len(READING_NOISE)


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal of whole bytes, lowest byte first; a number times ``scale`` is in ``unit``."""

    name: str
    bits: int
    scale: float
    unit: str = ""
    signed: bool = False

    def encode(self, value: float) -> bytes:
        """Return the bytes of the nearest number that fits."""
        low = -(1 << self.bits - 1) if self.signed else 0
        number = min(max(round(value / self.scale), low), low + (1 << self.bits) - 1)
        return number.to_bytes(self.bits // 8, "little", signed=self.signed)


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame: its identifier, its name, and its signals one after the other."""

    id: int
    name: str
    sender: str
    signals: Sequence[Signal]

    def encode(self, values: Sequence[float]) -> bytes:
        """Return the data of the frame."""
        return b"".join(s.encode(v) for s, v in zip(self.signals, values, strict=True))


def _drives(number: int, wheel: str) -> Frame:
    signals = [
        Signal(f"{name}_{drive}", 16, 0.01, unit, signed=True)
        for drive in (1, 2)
        for name, unit in (("VELOCITY", "rad/s"), ("CURRENT", "A"))
    ]
    return Frame(0x201 + number, f"DRIVES_{wheel.upper()}", f"UNIT_{number + 1}", signals)


def _health(number: int, wheel: str) -> Frame:
    signals = [
        Signal("STATUS", 16, 1.0), Signal("VOLTAGE_BUS", 16, 0.01, "V"),
        *(Signal(f"TEMPERATURE_{drive}", 16, 0.1, "degC", signed=True) for drive in (1, 2)),
    ]  # fmt: skip
    return Frame(0x211 + number, f"HEALTH_{wheel.upper()}", f"UNIT_{number + 1}", signals)


DRIVES = {wheel: _drives(number, wheel) for number, wheel in enumerate(WHEELS)}
HEALTH = {wheel: _health(number, wheel) for number, wheel in enumerate(WHEELS)}
BATTERY = Frame(
    0x301, "BATTERY", "BATTERY",
    [
        Signal("VOLTAGE", 16, 0.01, "V"), Signal("CURRENT", 16, 0.01, "A", signed=True),
        Signal("LEVEL", 16, 0.01, "%"), Signal("TEMPERATURE", 8, 1.0, "degC", signed=True),
        Signal("CHARGING", 8, 1.0),
    ],
)  # fmt: skip
CELL_FRAMES = [
    Frame(0x302 + page, f"CELLS_{page + 1}", "BATTERY",
          [Signal(f"CELL_{cell + 1}", 16, 0.001, "V")
           for cell in range(4 * page, min(4 * page + 4, CELLS))])
    for page in range((CELLS + 3) // 4)
]  # fmt: skip
FRAMES: Sequence[Frame] = (*DRIVES.values(), *HEALTH.values(), BATTERY, *CELL_FRAMES)


def dbc() -> str:
    """Return the DBC file that describes the frames."""
    senders = " ".join(dict.fromkeys(frame.sender for frame in FRAMES))
    lines = ['VERSION "1"', "NS_ :", "BS_:", f"BU_: {senders} COMPUTER"]
    for frame in FRAMES:
        size = sum(signal.bits for signal in frame.signals) // 8
        lines.append(f"BO_ {frame.id} {frame.name}: {size} {frame.sender}")
        lines += _signal_lines(frame)
    labels = " ".join(f'{value} "{name}"' for value, name in STATUS.items())
    lines += [f"VAL_ {frame.id} STATUS {labels} ;" for frame in HEALTH.values()]
    return "\n".join(lines) + "\n"


def _signal_lines(frame: Frame) -> Iterator[str]:
    start = 0
    for signal in frame.signals:
        sign = "-" if signal.signed else "+"
        place = f"{start}|{signal.bits}@1{sign} ({signal.scale:g},0) [0|0]"
        yield f' SG_ {signal.name} : {place} "{signal.unit}" COMPUTER'
        start += signal.bits


def write_dbc(path: Path) -> None:
    """Write the DBC file; raises AmberboxError."""
    try:
        path.write_text(dbc(), encoding="ascii")
    except OSError as error:
        raise AmberboxError(f"cannot write {path}: {error.strerror}", "--dbc FILE") from error


def open_bus(address: str, setup: BusSetup) -> CanBus:
    """Open a multicast group, or an interface of the computer; raises AmberboxError."""
    return CanBus(address, setup)


class CanBus:
    """The motor controllers and the battery, as nodes of a bus."""

    def __init__(self, channel: str, setup: BusSetup) -> None:
        arguments = _arguments(channel)
        try:
            import can
        except ImportError as error:
            what = "python-can is not installed"
            raise AmberboxError(what, "pip install 'amberbox[can]'") from error
        self._can = can
        try:
            self._bus: Any = can.Bus(**arguments, ignore_config=True)
        except (can.CanError, OSError, ValueError) as error:
            raise AmberboxError(f"cannot open {channel}: {error}", "--can 239.74.163.2") from error
        self._noise = Noise(setup.seed, "can")
        self._ticks = 0
        self.failed = 0

    def send(self, topic: str, message: Mapping[str, Any]) -> None:
        """Send the frames of the battery with each message about it."""
        if topic != "battery":
            return
        names = ("voltage", "current", "percentage", "temperature", "charging")
        self._send(BATTERY, [float(message[name]) for name in names])
        cells = message["cell_voltage"]
        for page, frame in enumerate(CELL_FRAMES):
            self._send(frame, cells[4 * page : 4 * page + 4])

    def tick(self, robot: Robot, due_ns: int) -> None:
        """Send the frames of the motor controllers that have power."""
        self._ticks += 1
        units = [(name, unit) for name, unit in robot.base.units.items() if unit.power > 0.5]
        if self._ticks % (TICKS_PER_S // _DRIVES_HZ) == 0:
            for name, unit in units:
                self._send(DRIVES[name], self._drives(unit))
        if self._ticks % (TICKS_PER_S // _HEALTH_HZ) == 0:
            for name, unit in units:
                self._send(HEALTH[name], self._health(unit))

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _drives(self, unit: WheelUnit) -> list[float]:
        return self._measured(unit, _places(_VELOCITY, _CURRENT_Q))

    def _health(self, unit: WheelUnit) -> list[float]:
        temperatures = self._measured(unit, _places(_TEMPERATURE))
        return [float(unit.status()), unit.voltage_v, *temperatures]

    def _measured(self, unit: WheelUnit, places: Sequence[int]) -> list[float]:
        numbers, noise = unit.numbers(0.0), self._noise.normal
        return [numbers[place] + noise(READING_NOISE[place % _DRIVE_NUMBERS]) for place in places]

    def _send(self, frame: Frame, values: Sequence[float]) -> None:
        message = self._can.Message(
            arbitration_id=frame.id, is_extended_id=False, data=frame.encode(values)
        )
        try:
            self._bus.send(message)
        except (self._can.CanError, OSError):  # the network is down, or has no room
            self.failed += 1


def _places(*of_drive: int) -> list[int]:
    return [place + drive * _DRIVE_NUMBERS for drive in (0, 1) for place in of_drive]


def _arguments(channel: str) -> dict[str, Any]:
    """Return the arguments of python-can: a multicast group stays on this computer."""
    try:
        parts = urlsplit(f"//{channel}")
        host, port = parts.hostname or "", parts.port
    except ValueError:
        raise UsageError(f"--can {channel} is no channel", "--can 239.74.163.2:43113") from None
    try:
        is_group = ipaddress.ip_address(host).is_multicast
    except ValueError:
        return {"channel": channel, "interface": "socketcan"}
    if not is_group:
        raise UsageError(f"{host} is no multicast group", "--can 239.74.163.2, or can0")
    arguments = {"channel": host, "interface": "udp_multicast", "hop_limit": 0}
    return {**arguments, "port": port} if port else arguments
