"""ULog files written record by record, for tests of the reader."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

MAGIC = b"ULog\x01\x12\x35\x01"
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"
START_US = 5_000_000
GPS_US = 1_700_000_000_000_000
"""GPS time at which the autopilot's clock was 0."""
FORMATS = {
    "vector": "float x;float y;uint8_t[4] _padding0",
    "sensor_accel": "uint64_t timestamp;uint32_t device_id;float x;float[2] yz;bool clipped",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;uint8_t fix",
    "airspeed_text": "uint64_t timestamp;char[12] word;int8_t level;uint8_t[3] _padding0",
    "nested": "uint64_t timestamp;vector[2] wind;double sum",
}


@dataclass
class UlogFile:
    """The bytes of a log under construction."""

    start_us: int = START_US
    data: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        self.data += MAGIC + struct.pack("<Q", self.start_us)

    def add(self, kind: str, payload: bytes) -> int:
        """Append a record; returns where it begins."""
        at = len(self.data)
        self.data += struct.pack("<HB", len(payload), ord(kind)) + payload
        return at

    def flags(self, incompatible: int = 0, offsets: tuple[int, ...] = ()) -> int:
        """Append the flag bits, which must come first."""
        padded = (*offsets, 0, 0, 0)[:3]
        return self.add(
            "B", bytes(8) + bytes([incompatible]) + bytes(7) + struct.pack("<3Q", *padded)
        )

    def formats(self, *names: str) -> None:
        """Append formats, all when none is named."""
        for name in names or FORMATS:
            self.add("F", f"{name}:{FORMATS[name]};".encode())

    def subscribe(self, number: int, name: str, instance: int = 0) -> None:
        """Append which number the data of a topic have."""
        self.add("A", struct.pack("<BH", instance, number) + name.encode())

    def value(self, kind: str, key: str, value: bytes) -> None:
        """Append an info or parameter record."""
        self.add(kind, bytes([len(key)]) + key.encode() + value)

    def put(self, number: int, data: bytes) -> int:
        """Append data."""
        return self.add("D", struct.pack("<H", number) + data)

    def log(self, level: str, time_us: int, text: str) -> None:
        """Append a line of the autopilot's log."""
        self.add("L", level.encode() + struct.pack("<Q", time_us) + text.encode())

    def write(self, path: Path) -> Path:
        """Write the file."""
        path.write_bytes(self.data)
        return path


def accel(time_us: int, n: int) -> bytes:
    """Make data of ``sensor_accel``."""
    return struct.pack("<QI3f?", time_us, 1000 + n, n / 2, -n / 4, n * 8.0, n % 3 == 0)


def gps(time_us: int, utc_us: int) -> bytes:
    """Make data of ``vehicle_gps_position``; 0 is no fix."""
    return struct.pack("<QQiB", time_us, utc_us, 480_000_000, 3)


def text(time_us: int, word: bytes, level: int) -> bytes:
    """Make data of ``airspeed_text``."""
    return struct.pack("<Q12sb", time_us, word, level)


def nested(time_us: int, n: int) -> bytes:
    """Make data of ``nested``, padding inside its structures included."""
    return struct.pack("<Qff4xff4xd", time_us, n, n + 1, n + 2, n + 3, n / 3)


def flight(count: int = 200, with_gps: bool = True) -> UlogFile:
    """Make a log with everything a flight has: two sensors, GPS, texts, parameters, a dropout."""
    log = UlogFile()
    log.flags()
    log.formats()
    log.value("I", "char[4] sys_name", b"PX4\0")
    log.value("I", "uint32_t ver_sw_release", struct.pack("<I", 0x010E00FF))
    log.value("P", "float MC_ROLL_P", struct.pack("<f", 6.5))
    log.value("P", "int32_t SYS_AUTOSTART", struct.pack("<i", 4001))
    for number, (name, instance) in enumerate(
        [("sensor_accel", 0), ("sensor_accel", 1), ("vehicle_gps_position", 0),
         ("airspeed_text", 0), ("nested", 0)]
    ):  # fmt: skip
        log.subscribe(number, name, instance)
    for n in range(count):
        now_us = START_US + n * 10_000
        log.put(0, accel(now_us, n))
        log.put(1, accel(now_us + 3, -n % 50))
        log.put(4, nested(now_us + 5, n))
        if n % 10 == 0:
            log.put(2, gps(now_us + 7, GPS_US + now_us + 7 if with_gps and n > 20 else 0))
            log.put(3, text(now_us + 8, b"go %d" % n, -n % 100))
        if n == count // 2:
            log.log("4", now_us, "battery is low")
            log.value("P", "float MC_ROLL_P", struct.pack("<f", 7.25))
            log.add("O", struct.pack("<H", 250))
            log.add("S", SYNC)
    return log
